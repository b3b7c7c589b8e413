"""Looks of a splat scene: exposure, white balance, tint, saturation and opacity, on its root and its crops.

The look of a root (``Object.lodgs_look``) applies to the entire scene, that of a crop inside the crop, on top
of the root's (``training.editing.look``). The splats stay unchanged. Viewports, F12, comparisons and exports
of LODGS apply :func:`looks_of`. For Blender's own drawing, every level gets a modifier (``nodes.look``) once
a look is set.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import bpy
from mathutils import Matrix

from ...training.editing.look import LOOK_SETTINGS, NEUTRAL, Look
from ...training.editing.paint import COLUMNS as PAINT
from ...training.lod.crop import Crop
from .. import compat
from ..attributes import sh_names
from ..nodes import display, ellipsoids
from ..nodes import look as groups
from ..nodes.building import add_switched_modifier, find_modifier, remove_modifier, replace_driver
from . import crops
from .objects import root_of
from .setting_properties import property_of

_DISPLAY: dict[str, dict[str, Any]] = {
    "exposure": {"step": 10, "precision": 2},
    "temperature": {"step": 10_000, "precision": 0},
    "tint": {"subtype": "COLOR_GAMMA"},
    "saturation": {"precision": 3, "subtype": "FACTOR"},
    "opacity": {"precision": 3},
}
"""Arguments of the properties of a look that only concern Blender."""


class PlacedLook(NamedTuple):
    """A look and the crop that limits it, in the splats' space; None for the entire scene."""

    crop: Crop | None
    look: Look


def _changed(self, context: bpy.types.Context) -> None:
    root = root_of(self.id_data)
    if root is not None:
        attach(root)
    self.id_data.update_tag()


@lru_cache(maxsize=64)
def _rows(look: Look) -> list[float]:
    return look.matrix.reshape(-1).tolist()


def _matrix(self) -> list[float]:
    return _rows(_read_look(self))  # cached: every driver of every level reads it


class LookSettings(bpy.types.PropertyGroup):
    """A look: see ``training.editing.look.Look``."""

    outside: bpy.props.BoolProperty(
        name="Outside",
        description="Apply the look outside the region instead of inside",
        update=_changed,
    )
    matrix: bpy.props.FloatVectorProperty(
        name="Matrix",
        description="Colour matrix of the look, row by row, for node groups",
        size=9, get=_matrix, options={"HIDDEN"},
    )  # fmt: skip


LookSettings.__annotations__ |= {
    name: property_of(f, options={"ANIMATABLE"}, update=_changed, **_DISPLAY.get(name, {}))
    for name, f in LOOK_SETTINGS.items()
}


def looks_of(
    root: bpy.types.Object, depsgraph: bpy.types.Depsgraph, from_world: Matrix
) -> tuple[PlacedLook, ...]:
    """Return the looks of a scene that change anything, as evaluated in the depsgraph, the root's first.

    Args:
        from_world: matrix from the world to the splats' space.
    """
    root_look, placed_looks = _read_look(root.evaluated_get(depsgraph).lodgs_look), []
    if root_look != NEUTRAL:
        placed_looks.append(PlacedLook(None, root_look))
    for obj in regions_of(root):
        evaluated = obj.evaluated_get(depsgraph)
        look = _read_look(evaluated.lodgs_look)
        if evaluated.lodgs_crop.use and look != NEUTRAL:
            crop = crops.evaluated_crop(obj, from_world, depsgraph)
            placed_looks.append(PlacedLook(replace(crop, outside=evaluated.lodgs_look.outside), look))
    return tuple(placed_looks)


def regions_of(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the crops that can have a look of their own."""
    return [obj for obj in crops.crops_of(root) if obj.lodgs_crop.keep == "ALL" or is_set(obj)]


def is_set(obj: bpy.types.Object) -> bool:
    """Return True if a property of the look of a root or a crop is set."""
    return any(obj.lodgs_look.is_property_set(name) for name in LOOK_SETTINGS)


def reset(root: bpy.types.Object, obj: bpy.types.Object) -> None:
    """Reset the look of the root or of one of its crops; its animation stays."""
    for name in (*LOOK_SETTINGS, "outside"):
        obj.lodgs_look.property_unset(name)
    attach(root)
    obj.update_tag()


def attach(root: bpy.types.Object) -> None:
    """Give every level the modifier for paint and the current looks; remove it without paint and looks."""
    regions = regions_of(root)
    painted = any(PAINT[-1] in item.object.data.attributes for item in root.lodgs.existing_levels)
    needs_modifier = bool(regions) or is_set(root) or painted
    for item in root.lodgs.levels:
        if item.exists and needs_modifier:
            _attach(item.object, root, regions)
        elif item.exists:
            detach(item.object)


def modifier_of(obj: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """Return the look modifier of a level, of any version."""
    return find_modifier(obj, groups.COUNT)


def is_outdated(root: bpy.types.Object) -> bool:
    """Return True if a level's modifier is of another version or does not match the current regions."""
    regions = regions_of(root)
    levels = [item.object for item in root.lodgs.existing_levels]
    return any(crops.followed_objects(obj, groups.COUNT) != regions for obj in levels) or not all(
        groups.is_current(modifier.node_group, len(regions), len(sh_names(obj.data)))
        for obj in levels
        if (modifier := modifier_of(obj)) is not None
    )


def _read_look(settings: LookSettings) -> Look:
    """Return the look of properties, clamped: animation can exceed their ranges."""

    def clamp(name: str, value: float) -> float:
        bounds = LOOK_SETTINGS[name].metadata
        return min(max(value, bounds["low"]), bounds["high"])

    values: dict[str, Any] = {}
    for name in LOOK_SETTINGS:
        value = getattr(settings, name)
        vector = not isinstance(value, float)
        values[name] = tuple(clamp(name, v) for v in value) if vector else clamp(name, value)
    return Look(**values)


def _attach(obj: bpy.types.Object, root: bpy.types.Object, regions: list[bpy.types.Object]) -> None:
    """Give a level the look modifier, driven by the looks of the scene and its regions, unless it has it."""
    modifier = modifier_of(obj)
    if (
        modifier is not None
        and groups.is_current(modifier.node_group, len(regions), len(sh_names(obj.data)))
        and crops.followed_objects(obj, groups.COUNT) == regions
    ):
        return
    detach(obj)
    modifier = add_switched_modifier(
        obj, groups.look_group(len(regions), len(sh_names(obj.data))),
        show_viewport="lodgs_viewport.points", show_render="lodgs_render.draws_points",
    )  # fmt: skip
    last = obj.modifiers.find(ellipsoids.NAME)
    if last >= 0:
        obj.modifiers.move(len(obj.modifiers) - 1, last)
    display.keep_order(obj)
    for number, source in enumerate((root, *regions)):
        if number:
            crops.follow(obj, modifier, number, source)
            driver = replace_driver(obj, compat.input_path(modifier, groups.BEYOND.format(number)), "value")
            crops.read_from(driver, source, "lodgs_look.outside", 0.0)
        for row, name in enumerate(groups.MATRIX_ROWS):
            path = compat.input_path(modifier, name.format(number))
            for column in range(3):
                driver = replace_driver(obj, path, "value", column)
                crops.read_from(driver, source, f"lodgs_look.matrix[{3 * row + column}]", row == column)
        driver = replace_driver(obj, compat.input_path(modifier, groups.OPACITY.format(number)), "value")
        crops.read_from(driver, source, "lodgs_look.opacity", 1.0)


def detach(obj: bpy.types.Object) -> None:
    """Remove the look modifier of a level."""
    remove_modifier(obj, modifier_of(obj))


CLASSES = (LookSettings,)


def register() -> None:
    bpy.types.Object.lodgs_look = bpy.props.PointerProperty(type=LookSettings)


def unregister() -> None:
    del bpy.types.Object.lodgs_look
