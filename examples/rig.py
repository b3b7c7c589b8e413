"""Cameras of the lantern garden, for the renderer and the COLMAP models. Uses numpy only.

Three sets, named by the prefix of their image names:

- ``view``   Three arcs around the table, back and forth: close and low, in the middle, far and high. The
  first view is a quarter along the first arc, so that every 8th view (held out) has neighbours on both sides.
- ``aside``  Some of these views, moved sideways and turned: views off the photographed path.
- ``walk``   A walk around the table and along the path at eye height, with objects close by on all sides.
"""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 480, 320
FOCAL = 400.0  # pixels; horizontal field of view 62 degrees
VIEWS_PER_ARC = 16
# one row per arc: radius and height in metres, half its angle in degrees, and the target point
ARCS = [
    (2.15, 1.30, 52.0, (0.0, 0.35, 1.12)),
    (2.75, 1.70, 58.0, (0.0, 0.40, 1.32)),
    (3.50, 2.15, 54.0, (0.0, 0.60, 1.46)),
]
# view number; metres to the right, up and forward; metres that the target moves to the right and up
ASIDE = [
    (3, (0.0, -0.40, 0.10), (-0.15, -0.10)),
    (0, (0.25, 0.0, 0.55), (-0.20, 0.0)),
    (8, (-0.15, 0.45, 0.40), (0.25, -0.10)),
    (11, (0.55, 0.05, 0.0), (-0.30, 0.0)),
    (44, (-0.55, 0.05, 0.0), (0.30, -0.10)),
    (20, (0.10, 0.80, -0.10), (0.30, -0.20)),
    (16, (0.20, -0.65, 0.20), (-0.40, 0.0)),
    (30, (-0.30, 0.15, -0.75), (0.50, 0.10)),
    (41, (0.20, -0.80, -0.20), (-0.50, 0.0)),
    (36, (0.10, 0.60, 0.45), (0.40, -0.20)),
]
# position (x, y) and target (x, y, z) in metres, at equal time intervals
WALK = [
    ((-2.35, 0.30), (0.2, 0.2, 0.95)),
    ((-2.15, -0.75), (0.2, 0.3, 0.95)),
    ((-1.20, -1.30), (0.2, 0.3, 0.95)),
    ((0.00, -1.30), (0.0, 0.6, 1.00)),
    ((1.30, -1.20), (0.0, 0.4, 1.00)),
    ((2.15, -0.55), (0.2, 0.4, 1.00)),
    ((2.35, 0.55), (0.4, 0.7, 1.10)),
    ((1.95, 1.65), (0.0, 1.0, 1.20)),
    ((1.05, 1.95), (-1.0, 2.2, 1.20)),
    ((0.65, 2.70), (0.0, 6.0, 1.20)),
    ((0.95, 3.80), (1.4, 8.0, 1.20)),
    ((1.12, 5.10), (1.0, 9.0, 1.20)),
]
WALK_VIEWS = 30
EYE_HEIGHT = 1.6
LANTERN = np.array([-0.44, 0.16, 0.97])  # centre of the lit lantern on the table, a landmark


def arcs() -> tuple[np.ndarray, np.ndarray]:
    """Return positions and targets of the set ``view``, (48, 3) float64 each, in metres."""
    positions, targets = [], []
    for arc, (radius, height, half_opening, target) in enumerate(ARCS):
        sweep = np.linspace(-1.0, 1.0, VIEWS_PER_ARC) * (-1.0 if arc % 2 else 1.0)
        azimuth = np.radians(half_opening) * sweep
        bob = 0.10 * np.sin(5.0 * azimuth + arc)  # hand-held, so not a perfect circle
        positions.append(
            np.stack(
                [(radius + bob) * np.sin(azimuth), -(radius + bob) * np.cos(azimuth), height + 0.8 * bob],
                axis=1,
            )
        )
        targets.append(np.tile(target, (VIEWS_PER_ARC, 1)))
    start = VIEWS_PER_ARC // 4
    return np.roll(np.concatenate(positions), -start, axis=0), np.roll(
        np.concatenate(targets), -start, axis=0
    )


def aside() -> tuple[np.ndarray, np.ndarray]:
    """Return positions and targets of the set ``aside``, (10, 3) float64 each, in metres."""
    views, steps, shifts = (np.array(column) for column in zip(*ASIDE, strict=True))
    positions, targets = (points[views] for points in arcs())
    right, down, ahead = np.moveaxis(
        look_at(positions, targets)[:, :3, :3], 1, 0
    )  # each view's axes, (10, 3)
    positions = positions + steps[:, :1] * right - steps[:, 1:2] * down + steps[:, 2:] * ahead
    return positions, targets + shifts[:, :1] * right - shifts[:, 1:] * down


def walk() -> tuple[np.ndarray, np.ndarray]:
    """Return positions and targets of the set ``walk``, (30, 3) float64 each, in metres."""
    time = np.linspace(0, len(WALK) - 1, WALK_VIEWS)
    knots = np.arange(len(WALK))
    positions, targets = (
        np.stack([np.interp(time, knots, column) for column in np.array(rows).T], axis=1)
        for rows in zip(*WALK, strict=True)
    )
    height = EYE_HEIGHT + 0.06 * np.sin(2.3 * time)  # walking motion
    return np.column_stack([positions, height]), targets


def look_at(positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return transforms from the world (z up) to cameras (x right, y down, z forward), (V, 4, 4)."""
    forward = (targets - positions) / np.linalg.norm(targets - positions, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    rotation = np.stack([right, down, forward], axis=1)
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    matrices[:, :3, :3] = rotation
    matrices[:, :3, 3] = -np.einsum("vij,vj->vi", rotation, positions)
    return matrices


SETS = {"view": arcs, "aside": aside, "walk": walk}


def world_to_cameras(name: str) -> np.ndarray:
    """Return the cameras of a set in the order of its views, as from :func:`look_at`."""
    return look_at(*SETS[name]())


def view_name(name: str, index: int) -> str:
    """Return the name of an image of a set without suffix: view_00, view_01, ..."""
    return f"{name}_{index:02d}"


def project(points: np.ndarray, world_to_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel positions (N, 2), centres at +0.5, and depths (N,) of world points (N, 3) in a view."""
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = local[:, 2]
    safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)[:, None]
    return FOCAL * local[:, :2] / safe + np.array([WIDTH / 2, HEIGHT / 2]), depth
