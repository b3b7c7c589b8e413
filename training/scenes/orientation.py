"""Which way is up: COLMAP's world has no up of its own. numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .cameras import Camera

# Mean of unit vectors: 1 where all agree, 0 where they cancel out.
_AGREE = 0.5


def up_rotation(cameras: Sequence[Camera]) -> np.ndarray:
    """Rotation from COLMAP's world to a z-up world, (3, 3) float64.

    Up is the mean of the cameras' up directions: -y, or where EXIF turns the photograph what is then above.
    Where these cancel out and the cameras look one way, they look straight down, as drones do: up is then the
    normal of the plane that they fly in, or without such a plane the opposite of the mean view. The mean
    view, where it has a horizontal part, turns to +y, so that Blender's front view sees what the cameras
    see; otherwise the top of the first image does.

    No cameras give the identity.
    """
    if not cameras:
        return np.eye(3)
    axes = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    turns = np.array([camera.turns for camera in cameras])
    tops = np.array([[0, -1, 0], [-1, 0, 0], [0, 1, 0], [1, 0, 0]])[turns]
    ups = np.einsum("ni,nij->nj", tops, axes)
    view, image_up = axes[:, 2].mean(axis=0), ups.mean(axis=0)
    up = image_up
    if np.linalg.norm(image_up) < _AGREE <= np.linalg.norm(view):
        up = _flight_normal(np.stack([camera.center for camera in cameras]), -view)
    if not np.any(up):
        up = ups[0]
    up = up / np.linalg.norm(up)
    # The last cannot fail: two axes of one camera are not both vertical.
    for front in (view, ups[0], np.cross(axes[0, 2], ups[0])):
        front = front - up * (front @ up)
        if np.linalg.norm(front) > 0.3:
            break
    front = front / np.linalg.norm(front)
    return np.stack([np.cross(front, up), front, up])


def _flight_normal(centers: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Normal of the plane through the centres where they are flat and it is within 30 degrees of up."""
    _, spread, directions = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    if len(spread) < 3 or spread[2] > 0.25 * spread[1]:
        return up
    normal = directions[2] * np.sign(directions[2] @ up)
    return normal if normal @ up > np.cos(np.radians(30)) * np.linalg.norm(up) else up
