"""Relative paths of splat scenes stay valid when the file is saved in another folder.

Blender remaps its own relative paths ("//"), but not those of extensions.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress

import bpy

_previous: list[tuple[bpy.types.bpy_struct, str, str]] = []
"""Owners, property names and values of paths before the file is saved in another folder."""
_open_file = ""
"""File that was open then."""


def relative_paths() -> Iterator[tuple[bpy.types.bpy_struct, str, str]]:
    """Return the relative paths of this file's scenes as tuples of owner, property name and value."""
    owners: list[bpy.types.bpy_struct] = []
    for obj in bpy.data.objects:
        if obj.is_editable and obj.lodgs.is_root:
            owners += [obj.lodgs, obj.lodgs.training, obj.lodgs.stream]
        elif obj.is_editable and obj.type == "CAMERA" and obj.data.is_editable:
            owners.append(obj.data.lodgs)
    for scene in bpy.data.scenes:
        if scene.is_editable:
            owners += [scene.lodgs_render, scene.lodgs_capture]
    for owner in owners:
        for prop in owner.bl_rna.properties:
            if prop.type == "STRING" and prop.subtype in ("FILE_PATH", "DIR_PATH"):
                value = getattr(owner, prop.identifier)
                if value.startswith("//"):
                    yield owner, prop.identifier, value


@bpy.app.handlers.persistent
def _on_save(path: str = "", *_) -> None:
    """Make paths relative to the folder where the file will be saved."""
    global _open_file
    _previous.clear()
    _open_file = bpy.data.filepath
    old_folder, new_folder = (os.path.dirname(os.path.abspath(file)) for file in (_open_file, path))
    if not (_open_file and path) or old_folder == new_folder:
        return
    for owner, name, value in list(relative_paths()):
        remapped = bpy.path.abspath(value)
        with suppress(ValueError):  # on another drive
            remapped = bpy.path.relpath(remapped, start=new_folder)
        setattr(owner, name, remapped)
        _previous.append((owner, name, value))


@bpy.app.handlers.persistent
def _on_saved(*_) -> None:
    """Restore the paths if the open file has not moved: after saving a copy or a failed save."""
    if bpy.data.filepath == _open_file:
        for owner, name, value in _previous:
            setattr(owner, name, value)
    _previous.clear()


def register() -> None:
    bpy.app.handlers.save_pre.append(_on_save)
    bpy.app.handlers.save_post.append(_on_saved)
    bpy.app.handlers.save_post_fail.append(_on_saved)


def unregister() -> None:
    bpy.app.handlers.save_pre.remove(_on_save)
    bpy.app.handlers.save_post.remove(_on_saved)
    bpy.app.handlers.save_post_fail.remove(_on_saved)
