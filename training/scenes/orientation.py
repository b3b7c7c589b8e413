"""Estimate of the up direction, which COLMAP's world does not define. numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .cameras import Camera

_AGREEMENT = 0.5
"""Minimum length of the mean of unit vectors: 1 if all agree, 0 if they cancel out."""


def up_rotation(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the rotation from COLMAP's world to a z-up world, (3, 3) float64; the identity without cameras.

    Up is the mean of the cameras' up directions: -y, corrected by EXIF orientation. If these cancel out while
    the view directions agree, the cameras look straight down, as on a drone; up is then the normal of their
    plane of flight or, without such a plane, opposite to the mean view direction. The horizontal part of the
    mean view direction becomes +y, so that Blender's front view matches the cameras. Without a horizontal
    part, the top of the first image becomes +y.
    """
    if not cameras:
        return np.eye(3)
    axes = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    turns = np.array([camera.turns for camera in cameras])
    tops = np.array([[0, -1, 0], [-1, 0, 0], [0, 1, 0], [1, 0, 0]])[turns]
    ups = np.einsum("ni,nij->nj", tops, axes)
    view = axes[:, 2].mean(axis=0)
    image_up = ups.mean(axis=0)
    up = image_up
    if np.linalg.norm(image_up) < _AGREEMENT <= np.linalg.norm(view):
        up = _flight_normal(np.stack([camera.center for camera in cameras]), -view)
    if not np.any(up):
        up = ups[0]
    up = up / np.linalg.norm(up)
    # The last candidate always works: two axes of one camera are not both vertical.
    for front in (view, ups[0], np.cross(axes[0, 2], ups[0])):
        front = front - up * (front @ up)
        if np.linalg.norm(front) > 0.3:
            break
    front = front / np.linalg.norm(front)
    return np.stack([np.cross(front, up), front, up])


def _flight_normal(centers: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the normal of the centres' plane if they are flat and it is within 30 degrees of up, else up."""
    _, spread, directions = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    if len(spread) < 3 or spread[2] > 0.25 * spread[1]:
        return up
    normal = directions[2] * np.sign(directions[2] @ up)
    return normal if normal @ up > np.cos(np.radians(30)) * np.linalg.norm(up) else up
