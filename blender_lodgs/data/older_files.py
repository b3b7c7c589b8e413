"""Upgrade of files saved by older versions or opened without the extension, and repair of damaged ones."""

from __future__ import annotations

import bpy

from ..attributes import BASE, LOG_SCALE, rename_sh
from ..nodes import display, ellipsoids
from . import looks, selection
from .roots import roots


def repair_references(group: bpy.types.PropertyGroup) -> None:
    """Clear references to data of another type, in a group of settings and the groups inside."""
    for prop in group.bl_rna.properties:
        value = getattr(group, prop.identifier, None)
        if prop.type == "COLLECTION":
            for item in value or ():
                repair_references(item)
        elif isinstance(value, bpy.types.PropertyGroup):
            repair_references(value)
        elif isinstance(value, bpy.types.ID) and not isinstance(
            value, getattr(bpy.types, prop.fixed_type.identifier)
        ):
            group.property_unset(prop.identifier)


def repair_levels(root: bpy.types.Object) -> None:
    """Sort the list of levels, and drop entries that share a number or an object with an earlier one."""
    items = root.lodgs.levels
    for index in reversed(range(len(items))):
        earlier = [items[number] for number in range(index)]
        if any(
            item.number == items[index].number or (item.object and item.object == items[index].object)
            for item in earlier
        ):
            items.remove(index)
    for index in range(len(items)):
        lowest = min(range(index, len(items)), key=lambda number: items[number].number)
        if lowest != index:
            items.move(lowest, index)


def upgrade_scene(root: bpy.types.Object) -> None:
    """Upgrade a splat scene of an older version; scenes of this version stay unchanged."""
    repair_references(root.lodgs)
    repair_levels(root)
    if selection.is_outdated(root) or looks.is_outdated(root):
        selection.attach(root)


def _restore_ellipsoids() -> None:
    """Add the modifiers of ellipsoids that Blender does not save, because their objects are linked."""
    for scene in bpy.data.scenes:
        for root in roots(scene) if scene.lodgs_render.ellipsoids else ():
            for item in root.lodgs.existing_levels:
                if not item.object.is_editable:
                    ellipsoids.attach(item.object)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    """Upgrade editable data after a file is opened or appended from; linked data only get ellipsoids."""
    for cloud in bpy.data.pointclouds:
        if cloud.is_editable and BASE in cloud.attributes:
            rename_sh(cloud)
    for obj in bpy.data.objects:
        if (
            obj.type == "POINTCLOUD"
            and obj.is_editable
            and obj.data.is_editable
            and LOG_SCALE in obj.data.attributes
        ):
            display.attach(obj)
    for obj in bpy.data.objects:
        if obj.lodgs.is_root and obj.is_editable:
            upgrade_scene(obj)
    _restore_ellipsoids()


def _restore_drivers() -> None:
    """Let Blender evaluate the drivers that were invalid without the extension's properties."""
    for obj in bpy.data.objects:
        for curve in obj.animation_data.drivers if obj.animation_data else ():
            if not curve.driver.is_valid:
                curve.driver.expression = curve.driver.expression  # setting it clears the error


def _upgrade_open_file() -> None:
    """Upgrade the file that was opened before the extension was enabled."""
    _on_load()
    _restore_drivers()


_HANDLERS = (bpy.app.handlers.load_post, bpy.app.handlers.blend_import_post)


def register() -> None:
    for handlers in _HANDLERS:
        handlers.append(_on_load)
    bpy.app.timers.register(_upgrade_open_file, first_interval=0)  # data are not accessible yet


def unregister() -> None:
    for handlers in _HANDLERS:
        handlers.remove(_on_load)
    if bpy.app.timers.is_registered(_upgrade_open_file):
        bpy.app.timers.unregister(_upgrade_open_file)
