"""Splat clouds that Blender or another add-on imported, as levels of LODGS scenes."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from ...training.errors import LodgsError
from ...training.methods import METHODS
from ...training.splats.gaussians import Splats
from ...training.splats.levels import Level
from . import importing, objects, scenes
from .shown import is_splats


def loose_splats(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected and active objects with splats that are in no LODGS scene, fewest splats first."""
    candidates = dict.fromkeys([*context.selected_objects, context.active_object])
    loose = [
        obj
        for obj in candidates
        if obj is not None
        and obj.type == "POINTCLOUD"
        and is_splats(obj.data)
        and objects.root_of(obj) is None
    ]
    return sorted(loose, key=lambda obj: (len(obj.data.points), obj.name))


def add_to_scene(
    context: bpy.types.Context, clouds: Sequence[bpy.types.Object], as_levels: bool = False
) -> list[bpy.types.Object]:
    """Turn objects with splats into LODGS scenes, in place: objects, attributes and positions stay.

    Args:
        clouds: point-cloud objects outside LODGS scenes. The root takes over the object's transform.
        as_levels: put all objects into one scene as its levels, coarse to fine in the order given. All need
            the same transform. Otherwise each object becomes a scene with a single level.

    Returns:
        The new scene roots.

    Raises:
        LodgsError: an object is linked, has no splats, or is scaled differently along its axes; or levels of
            one scene differ in position. Nothing is changed then.
    """
    splats = [_read_movable(obj) for obj in clouds]
    groups = [list(clouds)] if as_levels else [[obj] for obj in clouds]
    for group in groups:
        for obj in group[1:]:
            if not _is_close(obj.matrix_world, group[0].matrix_world):
                raise LodgsError(
                    f"Cannot make levels of one scene: '{obj.name}' and '{group[0].name}' have different "
                    "transforms.",
                    "Give both the same transform, or add them as separate scenes.",
                )
    read = dict(zip(clouds, splats, strict=True))
    return [_new_scene(context, group, [read[obj] for obj in group]) for group in groups]


def _read_movable(obj: bpy.types.Object) -> Splats:
    if not obj.is_editable or not obj.data.is_editable:
        raise LodgsError(f"Cannot add '{obj.name}': it is linked from another file.", "Make it local first.")
    scale = obj.matrix_world.to_scale()
    if min(scale) <= 0 or max(scale) > 1.0001 * min(scale) or obj.matrix_world.is_negative:
        factors = ", ".join(f"{factor:.4g}" for factor in scale)
        raise LodgsError(
            f"Cannot add '{obj.name}': its scale ({factors}) differs between axes or is mirrored.",
            "Give it one positive scale for all axes.",
        )
    return objects.read_splats(obj)


def _new_scene(
    context: bpy.types.Context, group: Sequence[bpy.types.Object], splats: Sequence[Splats]
) -> bpy.types.Object:
    matrix = group[0].matrix_world.copy()
    with importing.new_scene(context, group[0].name) as root:
        root.matrix_world = matrix
        for number, (obj, values) in enumerate(zip(group, splats, strict=True), start=1):
            for collection in list(obj.users_collection):
                collection.objects.unlink(obj)
            obj.parent = None
            obj.matrix_basis.identity()
            objects.complete_attributes(obj, values)
            scenes.put_level(root, Level(number, values, {}), obj)
        root.lodgs.single_level = len(group)
        root.lodgs.training.method = next(info.name for info in METHODS.values() if info.suggested_for_base)
        scenes.levels_changed(root)
    return root


def _is_close(first, second) -> bool:
    return all(
        abs(a - b) <= 1e-5 * (1 + abs(a))
        for x, y in zip(first, second, strict=True)
        for a, b in zip(x, y, strict=True)
    )
