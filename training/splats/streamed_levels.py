"""Levels that browsers stream by distance, written and read by splat-transform."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ..documents import read_json
from ..errors import LodgsError
from ..files import temporary_folder
from .level_folder import write_folder
from .levels import MAX_READ_LEVELS, Bundle
from .splat_transform import FiniteRows, find_splat_transform, splat_transform_steps

STREAMED_FILE = "lod-meta.json"
"""Main file of streamed levels, in a folder of their own."""


def write_streamed_levels(folder: Path, bundle: Bundle) -> Iterator[str]:
    """Write levels that browsers stream by distance: ``lod-meta.json`` and its files.

    Levels without splats, which crops can leave, are omitted because splat-transform refuses them. An earlier
    export in the folder is replaced after all files are written.

    Yields:
        The program's last line of output.

    Raises:
        LodgsError: splat-transform is missing or fails, the folder has other files or cannot be written, or
            no level has splats.
    """
    levels = [
        level for level in bundle.levels if any(len(part.rows) for part in bundle.drawn_levels(level.number))
    ]
    if not levels:
        raise LodgsError("Cannot export levels: they contain no splats.", "Make some splats visible.")
    finite = [replace(level, on_disk=FiniteRows(level.rows)) for level in levels]
    bundle = replace(bundle, levels=finite)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / STREAMED_FILE).exists():
        raise LodgsError(f"Cannot export to {folder}: it contains other files.", "Choose an empty folder.")
    find_splat_transform()  # reports a missing program before files are written
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LodgsError(f"Cannot create {folder}: {error.strerror}.", "Choose another folder.") from error
    with temporary_folder(folder.parent) as temporary:
        plain = temporary / "levels"
        converted = temporary / "converted"
        write_folder(plain, bundle)
        arguments = level_arguments(plain, len(bundle.levels))
        yield from splat_transform_steps([*arguments, str(converted / STREAMED_FILE)])
        if folder.exists():
            folder.rename(temporary / "previous")
        converted.rename(folder)


def level_arguments(folder: Path, count: int) -> list[str]:
    """Return splat-transform's arguments for the levels of a folder, ``lod0.ply`` the finest."""
    return [word for lod in range(count) for word in (str(folder / f"lod{lod}.ply"), "-l", str(lod))]


def count_lods(path: Path) -> int:
    """Return the number of levels in a :data:`STREAMED_FILE`.

    Raises:
        LodgsError: the file is damaged.
    """
    count = read_json(path).get("lodLevels")
    if type(count) is not int or not 1 <= count <= MAX_READ_LEVELS:
        raise LodgsError(f"Cannot read {path}: it does not describe streamed levels.", "Choose another file.")
    return count
