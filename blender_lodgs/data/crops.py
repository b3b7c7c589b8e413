"""Crops of a splat scene: empties under its axes that remove splats of every level before any rule.

A crop is a box (an empty displayed as a cube) or a sphere. It is edited like any object: moved, rotated,
scaled, animated, copied, deleted. Every level has a modifier (``nodes.crops``) that follows all crops and
drops hidden points, if there are crops or hidden points. :func:`modifier_crops` converts the sockets of an
evaluated modifier back to ``training.lod.crop``.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.lod.crop import Crop
from .. import compat
from ..attributes import HIDDEN
from ..nodes import crops as groups
from ..nodes.building import add_modifier, find_modifier, remove_modifier, replace_driver
from .objects import root_of
from .placement import axes_of, world_matrix

DISPLAY_TYPES = {"BOX": "CUBE", "SPHERE": "SPHERE"}
"""Display types of crop empties; all other types are boxes."""


def crops_of(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the crops of a scene, sorted by name; those of scenes below its root are not among them."""
    candidates = [obj for obj in bpy.data.objects if obj.lodgs_crop.is_crop and root_of(obj) == root]
    return sorted((obj for obj in candidates if obj.users_collection), key=lambda obj: obj.name)


def removing_crops(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the crops that remove splats; the others only limit a look (``looks``)."""
    return [obj for obj in crops_of(root) if obj.lodgs_crop.keep != "ALL"]


def new_crop(root: bpy.types.Object, shape: str, matrix: Matrix, keep: str = "INSIDE") -> bpy.types.Object:
    """Create a crop.

    Args:
        matrix: world matrix of the box from -1 to 1, or of the sphere of radius 1.
    """
    name = "Region" if keep == "ALL" else "Crop"
    obj = bpy.data.objects.new(f"{name} {shape.title()}", None)
    obj.empty_display_type, obj.empty_display_size = DISPLAY_TYPES[shape], 1.0
    obj.show_in_front = obj.lodgs_crop.is_crop = True
    obj.lodgs_crop.keep = keep
    obj.parent = axes = axes_of(root)  # follows the scene when it is aligned or scaled
    obj.matrix_parent_inverse = axes.matrix_world.inverted_safe() @ root.matrix_world
    obj.matrix_basis = root.matrix_world.inverted_safe() @ matrix
    root.users_collection[0].objects.link(obj)
    return obj


def region_object(root: bpy.types.Object, region: Crop) -> bpy.types.Object:
    """Create the object of a job's region, which is given in the splats' space."""
    bpy.context.view_layer.update()
    to_local = Matrix((*region.to_local, (0.0, 0.0, 0.0, 1.0)))
    return new_crop(root, region.shape, axes_of(root).matrix_world @ to_local.inverted_safe(), "ALL")


def evaluated_crops(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[Crop, ...]:
    """Return the enabled crops in the splats' space, as evaluated in the depsgraph."""
    from_world = world_matrix(axes_of(root), depsgraph).inverted_safe()
    settings = {obj: obj.evaluated_get(depsgraph).lodgs_crop for obj in crops_of(root)}
    return tuple(
        evaluated_crop(obj, from_world, depsgraph)
        for obj, crop in settings.items()
        if crop.use and crop.keep != "ALL"
    )


def evaluated_crop(obj: bpy.types.Object, from_world: Matrix, depsgraph: bpy.types.Depsgraph) -> Crop:
    """Return the box or sphere of a crop, as evaluated in the depsgraph.

    Args:
        from_world: matrix from the world to the space of the result.
    """
    evaluated = obj.evaluated_get(depsgraph)
    sphere, outside = (
        evaluated.empty_display_type == DISPLAY_TYPES["SPHERE"],
        evaluated.lodgs_crop.keep == "OUTSIDE",
    )
    return _crop(from_world, obj, depsgraph, evaluated.empty_display_size, sphere, outside)


def crop_text(root: bpy.types.Object, obj: bpy.types.Object) -> str:
    """Return a crop as text for the region of a job (``Crop.from_text``), in the splats' space."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    from_world = world_matrix(axes_of(root), depsgraph).inverted_safe()
    return evaluated_crop(obj, from_world, depsgraph).as_text()


def modifier_crops(
    evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph, is_on
) -> tuple[Crop, ...] | None:
    """Return the crops of an evaluated level's modifier; None if it has no such modifier or it is off.

    Args:
        is_on: function that returns True for an enabled modifier.
    """
    modifier = modifier_of(evaluated)
    count = groups.crop_count(modifier.node_group) if modifier is not None else None
    if count is None or not is_on(modifier):
        return None
    from_world, crops = evaluated.matrix_world.inverted_safe(), []
    for number in range(1, count + 1):
        obj, size, sphere, side, use = (
            compat.get_input(modifier, name.format(number))
            for name in (groups.OBJECT, groups.SIZE, groups.SPHERE, groups.OUTSIDE, groups.USE)
        )
        if use and obj is not None and side < 1.5:
            crops.append(_crop(from_world, obj, depsgraph, size, sphere > 0.5, side > 0.5))
    return tuple(crops)


def attach(root: bpy.types.Object) -> None:
    """Give every level the modifier for the current crops and hidden points; remove it if there are none."""
    crops = removing_crops(root)
    for item in root.lodgs.existing_levels:
        if crops or HIDDEN in item.object.data.attributes:
            _attach(item.object, crops)
        else:
            detach(item.object)


def is_outdated(root: bpy.types.Object) -> bool:
    """Return True if modifiers do not match the current crops, or were made by an older version."""
    crops = removing_crops(root)
    levels = [item.object for item in root.lodgs.existing_levels]
    node_groups = [modifier.node_group for obj in levels if (modifier := modifier_of(obj))]
    return any(followed_objects(obj) != crops for obj in levels) or not all(
        groups.is_current(group, len(crops)) for group in node_groups
    )


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """Return the crop modifier of a level, of any version."""
    return find_modifier(obj, groups.COUNT)


def followed_objects(obj: bpy.types.Object, count_key: str = groups.COUNT) -> list[bpy.types.Object | None]:
    """Return the objects that a level's modifier follows.

    Args:
        count_key: custom property of the node group with its number of objects.
    """
    modifier = find_modifier(obj, count_key)
    if modifier is None or modifier.node_group is None:
        return []
    count = range(1, modifier.node_group[count_key] + 1)
    names = [groups.OBJECT.format(number) for number in count]
    return [compat.get_input(modifier, name) for name in names if compat.has_input(modifier, name)]


def detach(obj: bpy.types.Object) -> None:
    """Remove the crop modifier of a level or of a copy of one."""
    remove_modifier(obj, modifier_of(obj))


def _crop(
    from_world: Matrix, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph,
    size: float, sphere: bool, outside: bool,
) -> Crop:  # fmt: skip
    """Return a crop in the space to which ``from_world`` transforms."""
    matrix = np.array(from_world @ world_matrix(obj, depsgraph), np.float64)
    matrix[:, :3] *= size
    return Crop.from_matrix("SPHERE" if sphere else "BOX", matrix, outside)


def _attach(obj: bpy.types.Object, crops: list[bpy.types.Object]) -> None:
    """Give a level the crop modifier, which follows the crops, unless it has it."""
    modifier = modifier_of(obj)
    if (
        modifier is not None
        and groups.is_current(modifier.node_group, len(crops))
        and followed_objects(obj) == crops
    ):
        return
    detach(obj)
    modifier = add_modifier(obj, groups.crops_group(len(crops)), groups.NAME)
    obj.modifiers.move(len(obj.modifiers) - 1, 0)
    for number, crop in enumerate(crops, 1):
        follow(obj, modifier, number, crop)


def follow(
    obj: bpy.types.Object, modifier: bpy.types.NodesModifier, number: int, crop: bpy.types.Object
) -> None:
    """Make the modifier sockets of a number follow a crop; missing sockets are skipped."""
    sphere = bpy.types.Object.bl_rna.properties["empty_display_type"].enum_items["SPHERE"].value  # type: ignore[attr-defined]
    compat.set_input(modifier, groups.OBJECT.format(number), crop)
    sockets = (
        (groups.SIZE, "empty_display_size", "value", 1.0),
        (groups.SPHERE, "empty_display_type", f"value == {sphere}", 0.0),
        (groups.OUTSIDE, "lodgs_crop.keep", "value", 0.0),
        (groups.USE, "lodgs_crop.use", "value", 1.0),
    )
    for name, source, expression, without in sockets:
        if compat.has_input(modifier, name.format(number)):
            path = compat.input_path(modifier, name.format(number))
            read_from(replace_driver(obj, path, expression), crop, source, without)


def read_from(driver: bpy.types.Driver, obj: bpy.types.Object, source: str, without: float) -> None:
    """Give a driver the variable ``value``, read from an object's property.

    Args:
        without: value if the extension, and with it the property, is missing.
    """
    variable = driver.variables.new()
    variable.name, variable.type = "value", "SINGLE_PROP"
    target = variable.targets[0]
    target.id, target.data_path = obj, source
    target.use_fallback_value, target.fallback_value = True, without
