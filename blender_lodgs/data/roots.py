"""Splat scenes of a Blender scene, and the active one for operators and panels."""

from __future__ import annotations

import bpy

from .objects import root_of

LINKED = (
    "This splat scene is linked from another file and cannot be changed here. Append it instead of linking "
    "it (File, Append), or make it local (Object, Relations, Make Local, All)."
)


def is_local(root: bpy.types.Object) -> bool:
    """Return False if a splat scene is linked, or overrides a linked one: changes of it are not saved."""
    return root.is_editable and root.override_library is None


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the roots of the splat scenes in a Blender scene."""
    return [obj for obj in scene.objects if obj.lodgs.is_root]


def all_roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the roots of the splat scenes in a Blender scene, also in collection instances."""
    instanced = [root for obj in scene.objects for root in _instanced_roots(obj)]
    return list(dict.fromkeys([*roots(scene), *instanced]))


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the root of the active object's splat scene, or else the only root of the Blender scene."""
    root = root_of(context.active_object)
    candidates = [root] if root is not None else roots(context.scene)
    return candidates[0] if len(candidates) == 1 else None


def shows_splats(scene: bpy.types.Scene) -> bool:
    """Return True if a Blender scene has splat scenes, also in collection instances."""
    return bool(roots(scene)) or any(map(_instanced_roots, scene.objects))


def shows_levels(scene: bpy.types.Scene) -> bool:
    """Return True if a Blender scene has levels of splats, also in collection instances."""
    has_levels = any(root.lodgs.existing_levels for root in roots(scene))
    return has_levels or any(map(_instanced_roots, scene.objects))


def is_linked(context: bpy.types.Context) -> bool:
    """Return True if the active splat scene, or one in the selected instance, is linked from another file."""
    root, obj = active_root(context), context.active_object
    candidates = [root] if root is not None else [] if obj is None else _instanced_roots(obj)
    return not all(map(is_local, candidates))


def _instanced_roots(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the roots of the splats in the collection that an object is an instance of."""
    collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
    members = () if collection is None else collection.all_objects
    candidates = [root_of(member) for member in members if member.type in ("EMPTY", "POINTCLOUD")]
    return list(dict.fromkeys(root for root in candidates if root is not None))


def root_with_levels(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return :func:`active_root` if it has levels, otherwise None."""
    root = active_root(context)
    return root if root is not None and root.lodgs.existing_levels else None


def collection_of(root: bpy.types.Object) -> bpy.types.Collection:
    """Return the collection of a splat scene's objects."""
    return root.users_collection[0]


def levels_collection(root: bpy.types.Object) -> bpy.types.Collection:
    """Return the collection for levels, which artists instance; create it if there is none."""
    name = f"{root.name} splats"
    for item in root.lodgs.existing_levels:
        return item.object.users_collection[0]
    children = collection_of(root).children
    if name not in children:
        children.link(bpy.data.collections.new(name))
        return children[-1]
    return children[name]
