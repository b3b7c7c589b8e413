"""Splat scenes in a Blender scene, and which one an operator or a panel works on."""

from __future__ import annotations

import bpy

from .objects import root_of

LINKED = (
    "This splat scene is linked from another file, where its settings are. To change them here, append it "
    "instead of linking it (File, Append), or make it local (Object, Relations, Make Local, All)."
)


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The splat scenes' roots in a Blender scene."""
    return [obj for obj in scene.objects if obj.lodgs.is_root]


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """The splat scene that is meant: the active object's, else the only one there is."""
    root = root_of(context.active_object)
    found = [root] if root is not None else roots(context.scene)
    return found[0] if len(found) == 1 else None


def shows_splats(scene: bpy.types.Scene) -> bool:
    """Whether a Blender scene has splat scenes, its own or in instances of collections."""
    return bool(roots(scene)) or any(map(_instanced, scene.objects))


def shows_levels(scene: bpy.types.Scene) -> bool:
    """Whether a Blender scene has levels of splats, its own or in instances of collections."""
    own = any(item.exists for root in roots(scene) for item in root.lodgs.levels)
    return own or any(map(_instanced, scene.objects))


def linked(context: bpy.types.Context) -> bool:
    """Whether the splat scene that is meant is another file's, or the selected instance shows such a one."""
    root, obj = active_root(context), context.active_object
    found = [root] if root is not None else [] if obj is None else _instanced(obj)
    return any(not one.is_editable for one in found)


def _instanced(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """The roots in the collection that an object is an instance of."""
    collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
    return [] if collection is None else [each for each in collection.all_objects if each.lodgs.is_root]


def root_with_levels(context: bpy.types.Context) -> bpy.types.Object | None:
    """:func:`active_root`, where it has levels."""
    root = active_root(context)
    return root if root is not None and any(item.exists for item in root.lodgs.levels) else None


def collection_of(root: bpy.types.Object) -> bpy.types.Collection:
    """Return the collection of a splat scene's objects."""
    return root.users_collection[0]
