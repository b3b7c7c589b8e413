"""What an artist says of a splat scene's place: where its ground is, and how long something in it is."""

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
from .photographs import views
from .placement import axes_of, move, placement_of
from .selection import read_json

APART = 1e-6
"""Of two places, over the size of the scene: nearer ones are one."""


def lay_on_ground(root: bpy.types.Object, places: np.ndarray | None = None, flip: bool = False) -> float:
    """Has z = 0 of Blender's world where a splat scene's ground is, its normal up.

    Args:
        places: (P, 3) of the ground, in Blender's world: three or more; None finds the plane that lies under
            the scene.
        flip: the other side of the ground is up.

    Returns:
        By how many degrees the scene was turned.

    Raises:
        LodgsError: the places make no plane, or none is found; the root is stretched.
    """
    there, up = placement_of(root), np.array([0.0, 0.0, 1.0])
    if places is None:
        normal, middle = find_ground(there.transform_points(_places(root)), up)
    else:
        normal, middle = fit_plane(places, up)
    _leave_edit_mode()
    up = -normal if flip else normal
    move(root, ground_placement(up, middle))
    return float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))


def scale(root: bpy.types.Object, factor: float) -> None:
    """Makes a splat scene so many times as large, about where its root stands on z = 0. Its cameras see as
    far as they did.

    Raises:
        LodgsError: the root is stretched.
    """
    _leave_edit_mode()
    x, y, _ = root.matrix_world.translation
    move(root, scaling_about(np.array([x, y, 0.0]), factor))
    for view in views(root):
        if view.data.lodgs.width:
            for name in ("clip_start", "clip_end", "display_size"):
                setattr(view.data, name, factor * getattr(view.data, name))


def picked(context: bpy.types.Context) -> np.ndarray:
    """(P, 3) float64, where in Blender's world an artist has picked something: the points that are selected
    in Edit Mode, or in Object Mode the origins of selected empties and meshes that are no splat scene's."""
    if context.mode == "OBJECT":
        axes = {axes_of(obj) for obj in bpy.data.objects if obj.lodgs.is_root}
        places = [
            np.array(obj.matrix_world.translation, np.float64)
            for obj in context.selected_objects
            if obj.type in ("EMPTY", "MESH") and not obj.lodgs.is_root and obj not in axes
        ]
        return np.array(places).reshape(-1, 3)
    found = [np.zeros((0, 3))]
    for obj in context.objects_in_mode:
        if obj.type == "POINTCLOUD" and (places := read_attribute(obj.data, "position")) is not None:
            matrix = np.array(obj.matrix_world, np.float64)
            found.append(places[_selected(obj.data)] @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(found)


def _leave_edit_mode() -> None:
    """Blender undoes what is done to objects from Object Mode alone."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def _selected(cloud: bpy.types.PointCloud) -> np.ndarray:
    """(N,) bool, which points are selected in Edit Mode."""
    selected = np.ones(len(cloud.points), bool)
    if attribute := cloud.attributes.get(".selection"):  # without it all are
        attribute.data.foreach_get("value", selected)
    return selected


def measured(places: np.ndarray) -> float:
    """The distance between two places that were picked.

    Raises:
        LodgsError: there are not two, or they are one.
    """
    if len(places) != 2:
        raise LodgsError(
            f"{len(places):,} places are selected, and a length is between two.",
            "Select two points in Edit Mode, or two empties that mark them.",
        )
    distance = float(np.linalg.norm(places[1] - places[0]))
    if distance <= APART * float(np.abs(places).max()):
        raise LodgsError("The two places that are selected are one.", "Select two that are apart.")
    return distance


def _places(root: bpy.types.Object) -> np.ndarray:
    """(P, 3) in the scene's own space: COLMAP's points, else where the finest level's opaque splats are;
    those about the cameras alone, where it is known how deep these look."""
    found = [item.object for item in root.lodgs.levels if item.exists][-1:]
    obj = root.lodgs.points or (found[0] if found else None)
    places = None if obj is None else read_attribute(obj.data, "position")
    if places is None:
        return np.zeros((0, 3))
    base = read_attribute(obj.data, BASE)
    places = places if base is None else places[base[:, 3] > 0.5]
    depth = root.lodgs.training.median_depth or read_json(root.lodgs.meta).get("median_depth", 0)
    return points_near_cameras(
        places, np.array(root.lodgs.camera_center), depth if isinstance(depth, int | float) else 0
    )
