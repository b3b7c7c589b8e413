"""Tracking of the viewport's view as the camera for levels of detail.

Drivers cannot read a viewport's view. The draw handler therefore records it here, and a timer stores the most
recently moved view in the splat scenes whose camera is the viewport; a draw handler may not change data.
Splats drawn as Gaussians use the view at once (:func:`current_camera`). Modifiers, which take long for
millions of splats, follow when the view rests; if points are displayed, they follow several times per second.
"""

from __future__ import annotations

import time
from dataclasses import replace
from math import inf

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..data import roots, selection, shown
from ..data.placement import axes_of

Position = tuple[float, float, float]

PAUSE = 0.08
"""Seconds between two updates of modifiers while the view moves, if points are displayed."""
REST = 0.25
"""Seconds without movement after which a view rests."""

_matrices: dict[int, dict[int, Matrix]] = {}
"""World to clip space of each viewport's region at its last redraw, by ``session_uid`` of the scene: windows
may show different ones."""
_pending: tuple[str, Position, float] | None = None
"""Most recently moved view that is not stored yet: scene name, camera position in the world, focal length."""
_due = 0.0
"""Time to store it."""


def camera_of_view(view: Matrix, projection: Matrix, width: int, distance: float) -> tuple[Position, float]:
    """Return a view's camera position in the world and its focal length in pixels.

    An orthographic view gets the scale that a perspective one has at the orbit point. Blender places its
    camera behind that point.

    Args:
        view: matrix from the world to camera space.
        projection: matrix from camera space to clip space.
        width: width of the region in pixels.
        distance: distance of the camera from the orbit point.
    """
    position = tuple(view.inverted().translation)
    focal = projection[0][0] * width / 2
    if projection[3][3] != 0:
        focal *= distance
    return position, focal


def active_camera(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the camera that the viewport looks through; None outside camera view."""
    camera = context.space_data.camera or context.scene.camera
    if context.region_data.view_perspective != "CAMERA" or camera is None or camera.type != "CAMERA":
        return None
    return camera


def camera_frame(
    camera: bpy.types.Object, scene: bpy.types.Scene, projection: Matrix
) -> tuple[float, float, float, float]:
    """Return the left, bottom, right and top of a camera's frame in clip space.

    Args:
        projection: matrix from camera space to clip space. That from the world would not do: Blender does
            not update ``matrix_world`` of hidden cameras after an undo.
    """
    corners = [projection @ corner.to_4d() for corner in camera.data.view_frame(scene=scene)]  # type: ignore[union-attr]
    xs, ys = ([corner[axis] / corner.w for corner in corners] for axis in (0, 1))
    return min(xs), min(ys), max(xs), max(ys)


def track(
    region: bpy.types.Region, scene: bpy.types.Scene, view: bpy.types.RegionView3D, *, splats: bool = False
) -> None:
    """Record the view of a viewport that is being drawn; if it has moved, it becomes the camera.

    Args:
        splats: the viewport draws Gaussians.
    """
    global _pending, _due
    if not any(_follows(root) for root in roots.roots(scene)):
        _matrices.pop(scene.session_uid, None)
        return
    matrix = view.window_matrix @ view.view_matrix
    key, matrices = region.as_pointer(), _matrices.setdefault(scene.session_uid, {})
    if key in matrices and matrices[key] == matrix:
        return
    newly_opened = bool(matrices) and key not in matrices
    matrices[key] = matrix
    if newly_opened:  # it has not moved
        return
    _pending = (
        scene.name, *camera_of_view(view.view_matrix, view.window_matrix, region.width, view.view_distance)
    )  # fmt: skip
    waiting = bpy.app.timers.is_registered(_store_pending)
    if splats or not waiting:
        _due = time.monotonic() + (REST if splats else PAUSE)
    if not waiting:
        bpy.app.timers.register(_store_pending, first_interval=PAUSE)


def current_camera(scene: bpy.types.Scene, root: bpy.types.Object) -> tuple[Position, float] | None:
    """Return the view's camera position in a splat scene's space and its focal length in pixels.

    Returns:
        None if the modifiers already use them.
    """
    if _pending is None or _pending[0] != scene.name or not _follows(root):
        return None
    _, position, focal_px = _pending
    local = axes_of(root).matrix_world.inverted_safe() @ Vector(position)
    x, y, z = map(float, np.float32(local))
    return (x, y, z), float(np.float32(focal_px))  # rounded like the properties


def view_query(
    instance: shown.SplatInstance, depsgraph: bpy.types.Depsgraph, moving: bool = True
) -> selection.LodQuery | None:
    """Return the query of an instance's splats for the current camera; None if all are drawn.

    Args:
        moving: see ``views.prepare``.
    """
    if not selection.only_lodgs_modifiers(instance.evaluated, depsgraph):
        return None
    if not moving:
        return shown.camera_query(instance, depsgraph)
    query = selection.evaluated_query(instance.evaluated, depsgraph)
    root = roots.root_of(instance.object)
    camera = current_camera(depsgraph.scene, root) if root is not None else None
    if query is not None and query.rule and camera is not None:
        query = replace(query, position=camera[0], focal_px=camera[1])
    return query and shown.at_instance(query, instance)


def nearest_streamed(
    instances: list[shown.SplatInstance], depsgraph: bpy.types.Depsgraph, moving: bool
) -> list[tuple[shown.SplatInstance, selection.LodQuery | None]]:
    """Return the nearest instance of each streamed scene with its query; it needs the finest pages."""
    nearest: dict[int, tuple[float, shown.SplatInstance, selection.LodQuery | None]] = {}
    for instance in shown.drop_streamed_levels(instances):
        if instance.source is None:
            continue
        query = view_query(instance, depsgraph, moving)
        center = np.mean(instance.object.bound_box, axis=0)
        distance = inf if query is None else float(np.linalg.norm(np.subtract(query.position, center)))
        if instance.source.scene not in nearest or distance < nearest[instance.source.scene][0]:
            nearest[instance.source.scene] = distance, instance, query
    return [(instance, query) for _, instance, query in nearest.values()]


def store_view(scene: bpy.types.Scene, position: Position, focal_px: float) -> None:
    """Store a camera position in the world in all splat scenes whose camera is the viewport."""
    for root in roots.roots(scene):
        if _follows(root):
            local = tuple(axes_of(root).matrix_world.inverted_safe() @ Vector(position))
            selection.store_camera(root, local, focal_px)


def _follows(root: bpy.types.Object) -> bool:
    return root.lodgs.follows_viewport


def _store_pending() -> float | None:
    global _pending
    if (wait := _due - time.monotonic()) > 0:
        return wait
    pending, _pending = _pending, None
    if pending is not None and (scene := bpy.data.scenes.get(pending[0])) is not None:
        store_view(scene, *pending[1:])
    return None


def clear() -> None:
    """Clear the records of all views."""
    global _pending
    _matrices.clear()
    _pending = None
