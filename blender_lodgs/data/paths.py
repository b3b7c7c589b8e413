"""Paths of scenes lead where they led where a file is saved in another folder, as images' do.

Blender does not know what paths an extension keeps: relative to the file ("//") they would then mean
something else.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress

import bpy

_before: list[tuple[bpy.types.bpy_struct, str, str]] = []
"""What paths were before the file is saved elsewhere: where, which property, its value."""
_file = ""
"""The file that was open then."""


def relative_paths() -> Iterator[tuple[bpy.types.bpy_struct, str, str]]:
    """The paths of scenes of this file that are relative to it: where, which property, its value."""
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
        for each in owner.bl_rna.properties:
            if each.type == "STRING" and each.subtype in ("FILE_PATH", "DIR_PATH"):
                value = getattr(owner, each.identifier)
                if value.startswith("//"):
                    yield owner, each.identifier, value


@bpy.app.handlers.persistent
def _on_save(path: str = "", *_) -> None:
    """Writes paths as they are from where the file will be."""
    global _file
    _before.clear()
    _file = bpy.data.filepath
    here, there = (os.path.dirname(os.path.abspath(each)) for each in (_file, path))
    if not (_file and path) or here == there:
        return
    for owner, name, value in list(relative_paths()):
        moved = bpy.path.abspath(value)
        with suppress(ValueError):  # on another drive
            moved = bpy.path.relpath(moved, start=there)
        setattr(owner, name, moved)
        _before.append((owner, name, value))


@bpy.app.handlers.persistent
def _on_saved(*_) -> None:
    """Where a copy was saved, or nothing, the file that is open has not moved."""
    if bpy.data.filepath == _file:
        for owner, name, value in _before:
            setattr(owner, name, value)
    _before.clear()


def register() -> None:
    bpy.app.handlers.save_pre.append(_on_save)
    bpy.app.handlers.save_post.append(_on_saved)
    bpy.app.handlers.save_post_fail.append(_on_saved)


def unregister() -> None:
    bpy.app.handlers.save_pre.remove(_on_save)
    bpy.app.handlers.save_post.remove(_on_saved)
    bpy.app.handlers.save_post_fail.remove(_on_saved)
