"""Crops of a splat scene: empties under its axes that say what is left of every level, before any rule.

A crop is a box (an empty drawn as a cube) or a sphere, edited as any object: moved, turned, scaled, animated,
copied, deleted. Every level has one modifier (``nodes.crops``) that follows them all and drops hidden points,
as long as there is something of either. Reading the sockets of an evaluated one gives the crops back as
``training.lod.crop`` has them: :func:`of_modifier`.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.lod.crop import Crop
from .. import compat
from ..attributes import HIDDEN
from ..nodes import crops as groups
from ..nodes.building import find_modifier, remove_modifier, replace_driver
from .placement import axes_of

DRAWN_AS = {"BOX": "CUBE", "SPHERE": "SPHERE"}
"""How empties are drawn that crop; any other way counts as a box."""


def crops_of(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The crops under a root, in the order of their names."""
    found = [obj for obj in bpy.data.objects if obj.lodgs_crop.is_crop and _is_under(obj, root)]
    return sorted((obj for obj in found if obj.users_collection), key=lambda obj: obj.name)


def cutting(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Those of them that leave something out; others only say where a look counts (``looks``)."""
    return [obj for obj in crops_of(root) if obj.lodgs_crop.keep != "ALL"]


def new_crop(root: bpy.types.Object, shape: str, matrix: Matrix, keep: str = "INSIDE") -> bpy.types.Object:
    """A crop where a matrix of the world puts the box from -1 to 1, or the sphere of radius 1."""
    name = "Region" if keep == "ALL" else "Crop"
    obj = bpy.data.objects.new(f"{name} {shape.title()}", None)
    obj.empty_display_type, obj.empty_display_size = DRAWN_AS[shape], 1.0
    obj.show_in_front = obj.lodgs_crop.is_crop = True
    obj.lodgs_crop.keep = keep
    obj.parent = axes = axes_of(root)  # it goes along where the scene is laid on its ground, or grows
    obj.matrix_parent_inverse = axes.matrix_world.inverted_safe() @ root.matrix_world
    obj.matrix_basis = root.matrix_world.inverted_safe() @ matrix
    root.users_collection[0].objects.link(obj)
    return obj


def as_object(root: bpy.types.Object, region: Crop) -> bpy.types.Object:
    """The object of a job's region, which is in the splats' own space."""
    bpy.context.view_layer.update()
    to_own = Matrix((*region.to_own, (0.0, 0.0, 0.0, 1.0)))
    return new_crop(root, region.shape, axes_of(root).matrix_world @ to_own.inverted_safe(), "ALL")


def as_objects_stand(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> tuple[Crop, ...]:
    """The crops in use, in the splats' own space, as of the depsgraph."""
    to_own = axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe()
    return tuple(as_it_stands(obj, to_own, depsgraph) for obj in cutting(root) if obj.lodgs_crop.use)


def as_it_stands(obj: bpy.types.Object, to_own: Matrix, depsgraph: bpy.types.Depsgraph) -> Crop:
    """A crop's box or sphere, as of the depsgraph, in the space that ``to_own`` leads to from the world."""
    sphere = obj.empty_display_type == DRAWN_AS["SPHERE"]
    return _crop(to_own, obj, depsgraph, obj.empty_display_size, sphere, obj.lodgs_crop.keep == "OUTSIDE")


def as_text(root: bpy.types.Object, obj: bpy.types.Object) -> str:
    """A crop as a job's region has it, in the splats' own space (``Crop.from_text``)."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    to_own = axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe()
    return as_it_stands(obj, to_own, depsgraph).as_text()


def of_modifier(
    evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph, is_on
) -> tuple[Crop, ...] | None:
    """By what the modifier of an evaluated level crops it, as of the depsgraph; None where it does not.

    Args:
        is_on: says of a modifier whether it is on.
    """
    modifier = modifier_of(evaluated)
    count = groups.crop_count(modifier.node_group) if modifier is not None else None
    if count is None or not is_on(modifier):
        return None
    to_own, found = evaluated.matrix_world.inverted_safe(), []
    for number in range(1, count + 1):
        obj, size, sphere, outside, use = (
            compat.get_input(modifier, name.format(number))
            for name in (groups.OBJECT, groups.SIZE, groups.SPHERE, groups.OUTSIDE, groups.USE)
        )
        if use and obj is not None:
            found.append(_crop(to_own, obj, depsgraph, size, sphere > 0.5, outside > 0.5))
    return tuple(found)


def attach(root: bpy.types.Object) -> None:
    """Gives every level the modifier for the crops and hidden points that there are, anew where there are
    others now; takes it away where there are none."""
    crops = cutting(root)
    for item in root.lodgs.levels:
        if item.exists:
            if crops or HIDDEN in item.object.data.attributes:
                _attach(item.object, crops)
            else:
                detach(item.object)


def outdated(root: bpy.types.Object) -> bool:
    """Whether crops have come or gone since modifiers were last given them, or an older version gave them."""
    crops = cutting(root)
    levels = [item.object for item in root.lodgs.levels if item.exists]
    given = [modifier.node_group for obj in levels if (modifier := modifier_of(obj))]
    return any(followed_by(obj) != crops for obj in levels) or not all(
        groups.is_current(group, len(crops)) for group in given
    )


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier of a level that follows crops, of any version."""
    return find_modifier(obj, groups.COUNT)


def followed_by(obj: bpy.types.Object, count_key: str = groups.COUNT) -> list[bpy.types.Object | None]:
    """The objects that a level's modifier follows.

    Args:
        count_key: the custom property by which its group tells how many it has places for.
    """
    modifier = find_modifier(obj, count_key)
    if modifier is None or modifier.node_group is None:
        return []
    count = range(1, modifier.node_group[count_key] + 1)
    names = [groups.OBJECT.format(number) for number in count]
    return [compat.get_input(modifier, name) for name in names if compat.has_input(modifier, name)]


def detach(obj: bpy.types.Object) -> None:
    """Takes the modifier that follows crops off a level, or a copy of one."""
    modifier = modifier_of(obj)
    if modifier is not None:
        remove_modifier(obj, modifier)


def _is_under(obj: bpy.types.Object | None, root: bpy.types.Object) -> bool:
    while obj is not None and obj != root:
        obj = obj.parent
    return obj is not None


def _crop(
    to_own: Matrix, obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph,
    size: float, sphere: bool, outside: bool,
) -> Crop:  # fmt: skip
    """A crop in the space that ``to_own`` leads to from the world."""
    matrix = np.array(to_own @ obj.evaluated_get(depsgraph).matrix_world, np.float64)
    matrix[:, :3] *= size
    return Crop.from_matrix("SPHERE" if sphere else "BOX", matrix, outside)


def _attach(obj: bpy.types.Object, crops: list[bpy.types.Object]) -> None:
    modifier = modifier_of(obj)
    if (
        modifier is not None
        and groups.is_current(modifier.node_group, len(crops))
        and followed_by(obj) == crops
    ):
        return
    detach(obj)
    modifier = obj.modifiers.new(groups.NAME, "NODES")
    assert isinstance(modifier, bpy.types.NodesModifier)
    modifier.node_group, modifier.show_expanded = groups.crops_group(len(crops)), False
    obj.modifiers.move(len(obj.modifiers) - 1, 0)
    for number, crop in enumerate(crops, 1):
        follow(obj, modifier, number, crop)


def follow(
    obj: bpy.types.Object, modifier: bpy.types.NodesModifier, number: int, crop: bpy.types.Object
) -> None:
    """Has the sockets of a number, as far as a level's modifier has them, follow a crop."""
    sphere = bpy.types.Object.bl_rna.properties["empty_display_type"].enum_items["SPHERE"].value  # type: ignore[attr-defined]
    compat.set_input(modifier, groups.OBJECT.format(number), crop)
    driven = (
        (groups.SIZE, "empty_display_size", "value", 1.0),
        (groups.SPHERE, "empty_display_type", f"value == {sphere}", 0.0),
        (groups.OUTSIDE, "lodgs_crop.keep", "value", 0.0),
        (groups.USE, "lodgs_crop.use", "value", 1.0),
    )
    for name, source, expression, without in driven:
        if compat.has_input(modifier, name.format(number)):
            path = compat.input_path(modifier, name.format(number))
            read_from(replace_driver(obj, path, expression), crop, source, without)


def read_from(driver: bpy.types.Driver, obj: bpy.types.Object, source: str, without: float) -> None:
    """Gives a driver the variable ``value``: an object's property.

    Args:
        without: its value where this extension, and with it the property, is missing.
    """
    variable = driver.variables.new()
    variable.name, variable.type = "value", "SINGLE_PROP"
    target = variable.targets[0]
    target.id, target.data_path = obj, source
    target.use_fallback_value, target.fallback_value = True, without
