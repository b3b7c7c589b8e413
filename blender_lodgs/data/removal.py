"""Removal of splat scenes: by an operator, and after an artist deleted the root.

Blender deletes only the empty and leaves cameras, hidden points and levels behind, with drivers that read
deleted properties. A root therefore references itself (``root.lodgs.itself``): a deleted root keeps its data
until :func:`remove` deletes the entire scene. A root that was appended with another object, such as a level
by a script, has no collection either, but was not deleted (``root.lodgs.is_appended``).
"""

from __future__ import annotations

import bpy

from . import crops, photographs, tables
from .importing import ABOUT
from .placement import axes_of


def remove(root: bpy.types.Object) -> None:
    """Remove a splat scene: levels, crops, tables, points, cameras, animated cameras, the root and emptied
    collections.

    Other children of the root stay in place. Copies of levels keep their current state, without drivers and
    crops. Objects that the root references but that are children of another root stay as well: a copy of a
    root references the same levels.
    """
    views = [view for view in photographs.views(root) if view.data.lodgs.width]
    referenced = [item.object for item in root.lodgs.levels] + [root.lodgs.points, *views]
    axes, cropping = axes_of(root), crops.crops_of(root)
    parts = {obj for obj in referenced if obj is not None and obj.parent == axes}
    parts |= {root, axes, *tables.parts(root), *cropping}
    parts |= {obj for obj in bpy.data.objects if obj.lodgs.flight_of == root and obj.is_editable}
    outside = [obj for obj in bpy.data.objects if obj not in parts and obj.is_editable]
    for obj in outside:
        _detach(obj, root, cropping)
    images = {background.image for view in views for background in view.data.background_images} - {None}
    data = {obj.data for obj in parts} - {None}
    collections = {part for obj in parts for part in obj.users_collection if part in bpy.data.collections[:]}
    if root.lodgs.cameras is not None:
        collections.add(root.lodgs.cameras)
    bpy.data.batch_remove(list(parts))
    for unused in (data, images):
        bpy.data.batch_remove([datablock for datablock in unused if not datablock.users])
    if ABOUT in bpy.data.texts and not any(obj.lodgs.is_root for obj in bpy.data.objects):
        bpy.data.texts.remove(bpy.data.texts[ABOUT])
    while empty := [part for part in collections if not part.objects and not part.children]:
        collections -= set(empty)
        bpy.data.batch_remove(empty)


def remove_deleted() -> None:
    """Remove the splat scenes whose root an artist deleted."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.is_editable]:
        if root.users_collection:
            root.lodgs.property_unset("is_appended")
        elif root.lodgs.itself == root and not root.lodgs.is_appended:
            remove(root)


def _detach(obj: bpy.types.Object, root: bpy.types.Object, cropping: list[bpy.types.Object]) -> None:
    """Detach an object from a root without moving it, and remove drivers that read the root or its crops."""
    if obj.parent in (root, axes_of(root)):
        matrix = obj.matrix_world.copy()
        obj.parent = None
        obj.matrix_world = matrix
    if any(crop in crops.followed_objects(obj) for crop in cropping):
        crops.detach(obj)
    for curve in list(obj.animation_data.drivers if obj.animation_data else ()):
        if any(target.id == root for variable in curve.driver.variables for target in variable.targets):
            obj.animation_data.drivers.remove(curve)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.id_type_updated("COLLECTION"):
        _remove_soon()


@bpy.app.handlers.persistent
def _remove_soon(*_) -> None:
    """Remove deleted scenes after the other handlers, which may still read them."""
    if not bpy.app.timers.is_registered(remove_deleted):
        bpy.app.timers.register(remove_deleted, first_interval=0)


@bpy.app.handlers.persistent
def _on_import(context, *_) -> None:
    for item in context.import_items:
        if isinstance(item.id, bpy.types.Object) and item.id.lodgs.is_root and item.id.is_editable:
            item.id.lodgs.is_appended = not item.id.users_collection


@bpy.app.handlers.persistent
def _on_save(*_) -> None:
    remove_deleted()


def register() -> None:
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.append(_on_update)
    handlers.save_pre.append(_on_save)
    handlers.blend_import_post.append(_on_import)
    for callbacks in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        callbacks.append(_remove_soon)


def unregister() -> None:
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.remove(_on_update)
    handlers.save_pre.remove(_on_save)
    handlers.blend_import_post.remove(_on_import)
    for callbacks in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        callbacks.remove(_remove_soon)
    if bpy.app.timers.is_registered(remove_deleted):
        bpy.app.timers.unregister(remove_deleted)
