"""The cameras of the lantern garden: what the renderer uses and what the COLMAP model states. numpy only.

A photographer walks three arcs round the table, to and fro: close and low, in the middle, far and high.
The walk starts a quarter along the first arc, so that every 8th view (held out) has neighbours on both sides.
"""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 480, 320
FOCAL = 400.0  # pixels; 62 degrees across
VIEWS_PER_ARC = 16
# radius and height in metres, half opening of the arc in degrees, and the point looked at: one row an arc
ARCS = [
    (2.15, 1.30, 52.0, (0.0, 0.35, 1.12)),
    (2.75, 1.70, 58.0, (0.0, 0.40, 1.32)),
    (3.50, 2.15, 54.0, (0.0, 0.60, 1.46)),
]
LANTERN = np.array([-0.44, 0.16, 0.97])  # the heart of the lit lantern on the table: a landmark


def eyes_and_targets() -> tuple[np.ndarray, np.ndarray]:
    """Camera positions and the points they look at, (V, 3) float64 each, metres, in the order of views."""
    eyes, targets = [], []
    for arc, (radius, height, half_opening, target) in enumerate(ARCS):
        sweep = np.linspace(-1.0, 1.0, VIEWS_PER_ARC) * (-1.0 if arc % 2 else 1.0)
        azimuth = np.radians(half_opening) * sweep
        bob = 0.10 * np.sin(5.0 * azimuth + arc)  # a hand does not keep a compass's distance
        eyes.append(
            np.stack(
                [(radius + bob) * np.sin(azimuth), -(radius + bob) * np.cos(azimuth), height + 0.8 * bob],
                axis=1,
            )
        )
        targets.append(np.tile(target, (VIEWS_PER_ARC, 1)))
    start = VIEWS_PER_ARC // 4
    return np.roll(np.concatenate(eyes), -start, axis=0), np.roll(np.concatenate(targets), -start, axis=0)


def world_to_cameras() -> np.ndarray:
    """Rigid transforms from the world (z up) to each camera (x right, y down, z forward), (V, 4, 4)."""
    eyes, targets = eyes_and_targets()
    forward = targets - eyes
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    rotation = np.stack([right, down, forward], axis=1)
    matrices = np.tile(np.eye(4), (len(eyes), 1, 1))
    matrices[:, :3, :3] = rotation
    matrices[:, :3, 3] = -np.einsum("vij,vj->vi", rotation, eyes)
    return matrices


def view_name(index: int) -> str:
    """Name of a view without its ending: view_00, view_01, ..."""
    return f"view_{index:02d}"


def project(points: np.ndarray, world_to_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel positions (N, 2), centres at +0.5, and depths (N,) of world points (N, 3) in one view."""
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = local[:, 2]
    safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)[:, None]
    return FOCAL * local[:, :2] / safe + np.array([WIDTH / 2, HEIGHT / 2]), depth
