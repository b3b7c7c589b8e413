"""Taking a splat scene away: by its own operator, and after an artist has deleted its root.

Blender would delete the empty alone and leave cameras, hidden points and levels behind, with drivers that
read what is gone. A root therefore holds on to itself (``root.lodgs.itself``): deleted, it leaves the scene
but is still there with all that it knows, until :func:`remove` clears it away.
"""

from __future__ import annotations

import bpy

from . import crops, photographs, tables
from .importing import ABOUT
from .placement import axes_of


def remove(root: bpy.types.Object) -> None:
    """Removes a splat scene: levels, crops, tables, points, cameras with those that move,
    the root, and collections empty then.

    What else hangs on the root stays where it is: copies of levels show what they show, without following,
    and uncropped.
    What the root knows and does not carry, another does: a copy of a root alone knows the same levels.
    """
    views = [view for view in photographs.views(root) if view.data.lodgs.width]
    known = [item.object for item in root.lodgs.levels] + [root.lodgs.points, *views]
    axes, cropping = axes_of(root), crops.crops_of(root)
    parts = {obj for obj in known if obj is not None and obj.parent == axes}
    parts |= {root, axes, *tables.parts(root), *cropping}
    parts |= {obj for obj in bpy.data.objects if obj.lodgs.flight_of == root and obj.is_editable}
    others = [obj for obj in bpy.data.objects if obj not in parts and obj.is_editable]
    for obj in others:
        _let_go(obj, root, cropping)
    pictures = {picture.image for view in views for picture in view.data.background_images} - {None}
    data = {obj.data for obj in parts} - {None}
    collections = {part for obj in parts for part in obj.users_collection if part in bpy.data.collections[:]}
    if root.lodgs.cameras is not None:
        collections.add(root.lodgs.cameras)
    bpy.data.batch_remove(list(parts))
    for unused in (data, pictures):
        bpy.data.batch_remove([one for one in unused if not one.users])
    if ABOUT in bpy.data.texts and not any(obj.lodgs.is_root for obj in bpy.data.objects):
        bpy.data.texts.remove(bpy.data.texts[ABOUT])
    while empty := [part for part in collections if not part.objects and not part.children]:
        collections -= set(empty)
        bpy.data.batch_remove(empty)


def remove_deleted() -> None:
    """Removes the splat scenes whose root an artist has deleted."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.is_editable]:
        if root.lodgs.itself == root and not root.users_collection:
            remove(root)


def _let_go(obj: bpy.types.Object, root: bpy.types.Object, cropping: list[bpy.types.Object]) -> None:
    """Takes an object off the root, where it is, and away from drivers that read the root, and its crops."""
    if obj.parent in (root, axes_of(root)):
        place = obj.matrix_world.copy()
        obj.parent = None
        obj.matrix_world = place
    if any(crop in crops.followed_by(obj) for crop in cropping):
        crops.detach(obj)
    for curve in list(obj.animation_data.drivers if obj.animation_data else ()):
        if any(target.id == root for variable in curve.driver.variables for target in variable.targets):
            obj.animation_data.drivers.remove(curve)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if depsgraph.id_type_updated("COLLECTION"):
        _soon()


@bpy.app.handlers.persistent
def _soon(*_) -> None:
    """Others of these handlers still read what would be gone."""
    if not bpy.app.timers.is_registered(remove_deleted):
        bpy.app.timers.register(remove_deleted, first_interval=0)


@bpy.app.handlers.persistent
def _on_save(*_) -> None:
    remove_deleted()


def register() -> None:
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.append(_on_update)
    handlers.save_pre.append(_on_save)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.append(_soon)


def unregister() -> None:
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.remove(_on_update)
    handlers.save_pre.remove(_on_save)
    for changes in (handlers.load_post, handlers.undo_post, handlers.redo_post):
        changes.remove(_soon)
    if bpy.app.timers.is_registered(remove_deleted):
        bpy.app.timers.unregister(remove_deleted)
