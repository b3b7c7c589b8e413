"""Paths of scenes lead where they led where a file is saved in another folder, as images' do.

Blender does not know what paths an extension keeps: relative to the file ("//") they would then mean
something else.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import bpy

_before: list[tuple[bpy.types.bpy_struct, str, str]] = []
"""What paths were before the file is saved: where, which property, its value."""


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
    _before.clear()
    here, there = (str(Path(each).parent) for each in (bpy.data.filepath, path))
    if not (bpy.data.filepath and path) or here == there:
        return
    for owner, name, value in list(relative_paths()):
        moved = bpy.path.abspath(value)
        with suppress(ValueError):  # on another drive
            moved = bpy.path.relpath(moved, start=there)
        setattr(owner, name, moved)
        _before.append((owner, name, value))


@bpy.app.handlers.persistent
def _on_saved(path: str = "", *_) -> None:
    """Where a copy was saved, or nothing, the file that is open has not moved."""
    if bpy.data.filepath != path:
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
