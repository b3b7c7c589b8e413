"""Recording of views where viewports rested, for training images. They are not saved."""

from __future__ import annotations

import time

import bpy
import numpy as np

from ...training.scenes.cameras import Camera

REST = 0.5
"""Seconds without movement after which a view counts."""
MAX_VIEWS = 256
"""Maximum number of views of a Blender scene; the oldest are dropped."""
DISTANCE, COSINE = 0.1, 0.966
"""A view is new if its distance from each recorded view is at least this share of its distance from its orbit
point, or if it is turned by more than 15° (cosine) from that view."""
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

_matrices: dict[int, np.ndarray] = {}
"""World to clip space of each viewport's region at its last redraw."""
_pending: tuple[int, Camera, float, float] | None = None
"""Last moved view: ``session_uid`` of its scene, camera, near depth and distance from the orbit point."""
_due = 0.0
"""Time to record it."""
_visits: dict[int, list[tuple[Camera, float]]] = {}
"""Cameras of 2x2 pixels with their near depths, oldest first, by ``session_uid`` of the scene."""


def track(region: bpy.types.Region, scene: bpy.types.Scene, view: bpy.types.RegionView3D) -> None:
    """Track the perspective view of a viewport that is being drawn; after a movement, record it at rest."""
    global _pending, _due
    if view.view_perspective != "PERSP":
        return
    projection, pose = (np.array(matrix, np.float64) for matrix in (view.window_matrix, view.view_matrix))
    matrix, previous = projection @ pose, _matrices.get(region.as_pointer())
    _matrices[region.as_pointer()] = matrix
    if previous is None or np.array_equal(matrix, previous):
        return
    focal, near = projection[0, 0], projection[2, 3] / (projection[2, 2] - 1)
    camera = Camera("", 2, 2, focal, focal, 1.0, 1.0, _TO_OPENCV @ pose)
    _pending = scene.session_uid, camera, float(near), view.view_distance
    _due = time.monotonic() + REST
    if not bpy.app.timers.is_registered(_record_at_rest):
        bpy.app.timers.register(_record_at_rest, first_interval=REST)


def _record_at_rest() -> float | None:
    """Record the last moved view. Return the remaining seconds if it has not rested for long enough."""
    global _pending
    remaining = _due - time.monotonic()
    if remaining > 0:
        return remaining
    if _pending is not None:
        scene, camera, near, distance = _pending
        visits = _visits.setdefault(scene, [])
        if not any(_resembles(camera, other, DISTANCE * distance) for other, _ in visits):
            visits.append((camera, near))
            del visits[:-MAX_VIEWS]
        _pending = None
    return None


def _resembles(first: Camera, second: Camera, distance: float) -> bool:
    """Return True if two views are closer than a distance and look in almost the same direction."""
    turned = first.world_to_camera[2, :3] @ second.world_to_camera[2, :3] < COSINE
    return not turned and float(np.linalg.norm(first.center - second.center)) < distance


def visited_views(scene: bpy.types.Scene, width: int, height: int) -> list[tuple[Camera, float]]:
    """Return the recorded views of a scene, oldest first, with their near depths, in Blender's world.

    Args:
        width, height: size of the images in pixels. They show the width of the viewport.
    """
    middle = width / 2, height / 2
    return [
        (Camera(f"visit_{number:03}.png", width, height, focal, focal, *middle, camera.world_to_camera), near)
        for number, (camera, near) in enumerate(_visits.get(scene.session_uid, []))
        for focal in [camera.fx * width / 2]
    ]


def count(scene: bpy.types.Scene) -> int:
    """Return the number of recorded views of a scene."""
    return len(_visits.get(scene.session_uid, ()))


def clear() -> None:
    """Forget all views, also one that has not rested yet."""
    global _pending
    if bpy.app.timers.is_registered(_record_at_rest):
        bpy.app.timers.unregister(_record_at_rest)
    _pending = None
    _visits.clear()
    _matrices.clear()
