"""Paths of .blend files: their safe use, and their changes when a project is moved.

Blender remaps its own relative paths ("//"), but not those of extensions. Saving also makes the paths of the
project relative: those below the folder of the .blend, and those of scenes whose photos have relative paths,
as after Blender's Make Paths Relative.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.files import names_device, network_share

_previous: list[tuple[bpy.types.bpy_struct, str, str]] = []
"""Owners, property names and values of paths before the file is saved in another folder."""
_target = ""
"""File that is being saved."""
NO_SPACE = os.strerror(errno.ENOSPC)
_SEEK_TABLE_END = b"\xb1\xea\x92\x8f"
"""Last bytes of a compressed .blend file, from the seekable format of Zstandard."""


def library_of(datablock: bpy.types.ID) -> bpy.types.Library | None:
    """Return the library whose folder the paths of a datablock are relative to, also for an override."""
    override = datablock.override_library
    reference = override.reference if override is not None else None
    return datablock.library if reference is None else reference.library


def absolute_path(value: str, library: bpy.types.Library | None = None) -> Path:
    """Return a path of the .blend file or of a user, to open it on the user's request.

    Args:
        library: library of the property's owner.

    Raises:
        LodgsError: the path names a device.
    """
    path = bpy.path.abspath(value, library=library)
    if names_device(path):
        raise LodgsError(f"Cannot open {path}: it names a device.", "Choose a file or folder.")
    return Path(path)


def automatic_path(value: str, library: bpy.types.Library | None = None) -> Path | None:
    """Return a path of the .blend file to open without a request of the user, or None if that is unsafe.

    A stranger's file must not make Windows log in to the computer that the file names. Hence network shares
    are excluded, except the one that holds the .blend file.
    """
    path = bpy.path.abspath(value, library=library)
    share = network_share(path)
    unsafe = not value or names_device(path) or (share and share != network_share(bpy.data.filepath))
    return None if unsafe else Path(path)


def save_file(path: Path, copy: bool = False) -> None:
    """Save the .blend file, or a copy of it, under an absolute path.

    Raises:
        RuntimeError: the file was not saved completely.
    """
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False, copy=copy)
    except RuntimeError as error:
        if os.strerror(errno.ENOENT) in str(error) and path.parent.is_dir():
            raise RuntimeError(NO_SPACE) from error  # Blender reports the removal of the incomplete file
        raise
    if not is_complete_file(path):  # Blender 5.2 reports no error on a full disk if it compresses
        path.unlink(missing_ok=True)
        raise RuntimeError(NO_SPACE)


def is_complete_file(path: Path) -> bool:
    """Return whether a .blend file has its last block, or its last bytes if it is compressed."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 64, 0))
        end = file.read()
    return b"ENDB" in end or end.endswith(_SEEK_TABLE_END)


def stored_path(path: Path) -> str:
    """Return a path as properties store it: relative to the .blend file if the user prefers that."""
    absolute = str(path.absolute())
    return relative_path(absolute) if bpy.context.preferences.filepaths.use_relative_paths else absolute


def relative_path(path: str, folder: str = "") -> str:
    """Return an absolute path relative to a folder, with the prefix "//"; unchanged on another drive.

    If the folder's path has symbolic links, ``..`` leads to the parents of their targets.

    Args:
        folder: absolute path. By default, the folder of the .blend file; without one, paths stay unchanged.
    """
    folder = folder or os.path.dirname(bpy.data.filepath)
    if not folder:
        return path
    real_path, real_folder = os.path.realpath(path), os.path.realpath(folder)
    with suppress(ValueError):  # on another drive
        values = os.path.relpath(path, folder), os.path.relpath(real_path, real_folder)
        valid = [value for value in values if os.path.realpath(os.path.join(folder, value)) == real_path]
        return "//" + min(valid, key=lambda value: value.startswith(os.pardir))
    return path


def scene_paths(linked: bool = False) -> Iterator[tuple[bpy.types.bpy_struct, str, str]]:
    """Return the paths of local or linked scenes as tuples of owner, property name and value."""
    owners: list[bpy.types.bpy_struct] = []
    for obj in bpy.data.objects:
        if obj.lodgs.is_root:
            owners += [obj.lodgs, obj.lodgs.training, obj.lodgs.stream, obj.lodgs.source]
        elif obj.type == "CAMERA":
            owners.append(obj.data.lodgs)
    for scene in bpy.data.scenes:
        owners += [scene.lodgs_render, scene.lodgs_capture]
    for owner in owners:
        if (library_of(owner.id_data) is not None) != linked:
            continue
        for prop in owner.bl_rna.properties:
            is_path = prop.type == "STRING" and prop.subtype in ("FILE_PATH", "DIR_PATH")
            if is_path and (value := getattr(owner, prop.identifier)):
                yield owner, prop.identifier, value


def _project_folders(folder: str) -> list[str]:
    """Return the folders whose files move together with a .blend file in a folder."""
    photos = {
        os.path.dirname(bpy.path.abspath(image.filepath))
        for image in bpy.data.images
        if image.filepath.startswith("//") and image.library is None
    }
    scenes = {bpy.path.abspath(obj.lodgs.scene_folder) for obj in bpy.data.objects if obj.lodgs.scene_folder}
    return [folder, *(scene for scene in scenes if any(_is_inside(photo, scene) for photo in photos))]


def _is_inside(path: str, folder: str) -> bool:
    """Return whether an absolute path is a folder or below it, by name or after following symbolic links."""
    for resolve in (os.path.abspath, os.path.realpath):
        inner, outer = (os.path.normcase(resolve(item)) for item in (path, folder))
        if inner == outer or inner.startswith(os.path.join(outer, "")):
            return True
    return False


@bpy.app.handlers.persistent
def _on_save(path: str = "", *_) -> None:
    """Make paths relative to the folder where the file will be saved."""
    global _target
    _previous.clear()
    _target = path
    if not path:
        return
    old_folder, new_folder = (os.path.dirname(os.path.abspath(file)) for file in (bpy.data.filepath, path))
    projects = _project_folders(new_folder)
    for owner, name, value in list(scene_paths()):
        remapped = bpy.path.abspath(value)
        if not os.path.isabs(remapped) or automatic_path(value) is None:
            continue
        if value.startswith("//"):
            if old_folder == new_folder:
                continue
        elif not any(_is_inside(remapped, folder) for folder in projects):
            continue
        setattr(owner, name, relative_path(remapped, new_folder))
        _previous.append((owner, name, value))


@bpy.app.handlers.persistent
def _on_saved(*_) -> None:
    """Restore the paths after saving a copy or a failed save."""
    if os.path.abspath(bpy.data.filepath) != os.path.abspath(_target):
        for owner, name, value in _previous:
            setattr(owner, name, value)
    _previous.clear()


@bpy.app.handlers.persistent
def _on_import(context, *_) -> None:
    """Let the relative paths of appended and linked scenes lead to the files of their own .blend file."""
    folders = {
        item.id: os.path.dirname(bpy.path.abspath(item.source_library.filepath))
        for item in context.import_items
        if item.id is not None and item.id.library is None and item.source_library is not None
    }
    for owner, name, value in list(scene_paths()):
        folder = folders.get(owner.id_data)
        if folder and value.startswith("//"):
            setattr(owner, name, stored_path(Path(bpy.path.abspath(value, start=folder))))
    _resolve_linked()


@bpy.app.handlers.persistent
def _resolve_linked(*_) -> None:
    """Make the relative paths of linked scenes absolute in memory, so that Make Local keeps them valid."""
    for owner, name, value in list(scene_paths(linked=True)):
        if value.startswith("//"):
            setattr(owner, name, bpy.path.abspath(value, library=library_of(owner.id_data)))


def register() -> None:
    if hasattr(bpy.app.handlers, "blend_import_post"):
        bpy.app.handlers.blend_import_post.append(_on_import)
    bpy.app.handlers.load_post.append(_resolve_linked)
    bpy.app.handlers.save_pre.append(_on_save)
    bpy.app.handlers.save_post.append(_on_saved)
    bpy.app.handlers.save_post_fail.append(_on_saved)


def unregister() -> None:
    if hasattr(bpy.app.handlers, "blend_import_post"):
        bpy.app.handlers.blend_import_post.remove(_on_import)
    bpy.app.handlers.load_post.remove(_resolve_linked)
    bpy.app.handlers.save_pre.remove(_on_save)
    bpy.app.handlers.save_post.remove(_on_saved)
    bpy.app.handlers.save_post_fail.remove(_on_saved)
