"""Alignment of a splat scene with its ground, and its scale."""

from __future__ import annotations

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.scenes.ground import (
    find_ground,
    fit_plane,
    ground_placement,
    points_near_cameras,
    scaling_about,
)
from ..attributes import BASE, read_attribute
from .metadata import meta_of
from .photographs import views
from .placement import axes_of, move, placement_of

MIN_DISTANCE = 1e-6
"""Minimum distance of two positions, as a fraction of their largest coordinate."""


def align_to_ground(root: bpy.types.Object, positions: np.ndarray | None = None, flip: bool = False) -> float:
    """Move a splat scene so that its ground is z = 0 of Blender's world, with the normal up.

    Args:
        positions: (P, 3) three or more points of the ground in Blender's world; None detects the plane below
            the scene.
        flip: turn the other side of the ground up.

    Returns:
        The rotation of the scene in degrees.

    Raises:
        LodgsError: the points define no plane, no ground is detected, or the root is scaled differently along
            its axes.
    """
    placement, up = placement_of(root), np.array([0.0, 0.0, 1.0])
    if positions is None:
        normal, center = find_ground(placement.transform_points(ground_points(root)), up)
    else:
        normal, center = fit_plane(positions, up)
    _leave_edit_mode()
    up = -normal if flip else normal
    move(root, ground_placement(up, center))
    return float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))


def scale(root: bpy.types.Object, factor: float) -> None:
    """Scale a splat scene about the projection of its root on z = 0.

    The clip distances of its cameras are scaled along.

    Raises:
        LodgsError: the root is scaled differently along its axes.
    """
    _leave_edit_mode()
    x, y, _ = root.matrix_world.translation
    move(root, scaling_about(np.array([x, y, 0.0]), factor))
    for view in views(root):
        if view.data.lodgs.width:
            for name in ("clip_start", "clip_end", "display_size"):
                setattr(view.data, name, factor * getattr(view.data, name))


def picked_positions(context: bpy.types.Context) -> np.ndarray:
    """Return the positions (P, 3) float64 of the selection in Blender's world.

    In Edit Mode these are the selected points; in Object Mode the origins of selected empties and meshes that
    do not belong to a splat scene.
    """
    if context.mode == "OBJECT":
        axes = {axes_of(obj) for obj in bpy.data.objects if obj.lodgs.is_root}
        positions = [
            np.array(obj.matrix_world.translation, np.float64)
            for obj in context.selected_objects
            if obj.type in ("EMPTY", "MESH") and not obj.lodgs.is_root and obj not in axes
        ]
        return np.array(positions).reshape(-1, 3)
    selection = [np.zeros((0, 3))]
    for obj in context.objects_in_mode:
        if obj.type == "POINTCLOUD" and (positions := read_attribute(obj.data, "position")) is not None:
            matrix = np.array(obj.matrix_world, np.float64)
            selection.append(positions[_selected(obj.data)] @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(selection)


def _leave_edit_mode() -> None:
    """Switch to Object Mode: Blender undoes changes of objects only there."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def _selected(cloud: bpy.types.PointCloud) -> np.ndarray:
    """Return the (N,) bool mask of points selected in Edit Mode."""
    selected = np.ones(len(cloud.points), bool)
    if attribute := cloud.attributes.get(".selection"):  # without the attribute, all points are selected
        attribute.data.foreach_get("value", selected)
    return selected


def measure_distance(positions: np.ndarray) -> float:
    """Return the distance between two selected positions.

    Raises:
        LodgsError: the number of positions is not two, or they coincide.
    """
    if len(positions) != 2:
        raise LodgsError(
            f"Cannot measure a length: it needs two selected points, not {len(positions):,}.",
            "Select two points in Edit Mode, or two empties.",
        )
    distance = float(np.linalg.norm(positions[1] - positions[0]))
    if distance <= MIN_DISTANCE * float(np.abs(positions).max()):
        raise LodgsError(
            "Cannot measure a length: both selected points have the same position.",
            "Select two other points.",
        )
    return distance


def finest_levels(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the object of the finest level, with those of coarser ones if levels add up."""
    objects = [item.object for item in root.lodgs.existing_levels]
    return objects if root.lodgs.cumulative else objects[-1:]


def ground_points(root: bpy.types.Object) -> np.ndarray:
    """Return the points (P, 3) for ground detection, in the scene's coordinates.

    These are COLMAP's points, or the means of the finest level's opaque splats, with coarser ones if levels
    add up. If the median depth is known, only points near the cameras are returned.
    """
    objects = [root.lodgs.points] if root.lodgs.points else finest_levels(root)
    parts = [np.zeros((0, 3), np.float32)]
    for obj in objects:
        if (positions := read_attribute(obj.data, "position")) is not None:
            base = read_attribute(obj.data, BASE)
            parts.append(positions if base is None else positions[base[:, 3] > 0.5])
    positions = np.concatenate(parts)
    depth = root.lodgs.training.median_depth or meta_of(root).get("median_depth", 0)
    return points_near_cameras(
        positions, np.array(root.lodgs.camera_center), depth if isinstance(depth, int | float) else 0
    )
