"""Folders of levels of detail: one plain PLY per level and a manifest (``docs/reference/bundle.md``)."""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from ..documents import read_json
from ..errors import LodgsError
from ..files import atomic_write
from .bundle import open_bundle
from .bundle_header import (
    INCONSISTENCIES,
    bundle_line,
    check_type,
    inconsistency_error,
    json_default,
    level_line,
    parse_bundle,
    pop_tables,
    table_elements,
    table_lines,
)
from .dialects import Warn, comments_from_meta, drop_undrawable, ignore
from .levels import MAX_READ_LEVELS, NO_SPLATS, Bundle, Level, bounding_box
from .ply import (
    Element,
    extra_columns,
    read_elements,
    read_ply,
    splat_columns,
    splats_from_rows,
    write_elements,
)

MANIFEST_FILE = "manifest.json"
TABLES_FILE = "tables.ply"
"""File with the tables of a folder."""


def write_folder(folder: str | Path, bundle: Bundle) -> None:
    """Write every level as a complete plain PLY, ``lod0.ply`` the finest, and ``manifest.json``.

    All files have the same columns, as splat-transform requires, so extras that a level lacks are omitted.
    Tables are in ``tables.ply``. No file is replaced before all are written, and the manifest is replaced
    last. Then surplus files of an earlier export (``lodN.ply``, ``tables.ply``) are removed, and no others:
    without its manifest, they are another program's.

    Raises:
        LodgsError: as `write_bundle`.
    """
    bundle.check()
    folder = Path(folder)
    is_replaced = (folder / MANIFEST_FILE).exists()
    shared = _shared_extras(bundle)
    manifest = bundle_line(bundle) | {"levels": [], "meta": bundle.meta}
    if bundle.tables:
        manifest["tables"] = table_lines(bundle)
    with ExitStack() as stack:
        manifest_file = stack.enter_context(atomic_write(folder / MANIFEST_FILE))
        for lod, level in enumerate(reversed(bundle.levels)):
            path = folder / f"lod{lod}.ply"
            temporary = stack.enter_context(atomic_write(path))
            manifest["levels"].append(
                level_line(lod, level)
                | {"file": path.name}
                | _write_level(temporary, bundle, level.number, shared)
            )
        if bundle.tables:
            temporary = stack.enter_context(atomic_write(folder / TABLES_FILE))
            no_splats = Element.from_columns("vertex", splat_columns(NO_SPLATS))
            write_elements(temporary, [no_splats, *table_elements(bundle)])
        manifest_file.write_text(
            json.dumps(manifest, indent=1, default=json_default, allow_nan=False) + "\n", "ascii"
        )
    if not is_replaced:
        return
    surplus = [
        file
        for file in folder.glob("lod*.ply")
        if (match := re.fullmatch(r"lod(\d+)\.ply", file.name)) and int(match[1]) >= len(bundle.levels)
    ]
    for file in surplus if bundle.tables else [*surplus, folder / TABLES_FILE]:
        with suppress(OSError):  # harmless, because the manifest does not name it
            file.unlink()


def _shared_extras(bundle: Bundle) -> list[str]:
    """Return the sorted names of extras that all levels have with one type."""
    first, *further = [extra_columns(level.rows.select(slice(0, 0))) for level in bundle.levels]
    return sorted(
        name
        for name, column in first.items()
        if all(name in columns and columns[name].dtype == column.dtype for columns in further)
    )


def _write_level(path: Path, bundle: Bundle, number: int, extras: list[str]) -> dict:
    """Write the complete scene of a level and return its entries for the manifest."""
    sets = [level.rows for level in bundle.drawn_levels(number)]
    element = Element.from_splats(
        "vertex",
        sets,
        lambda splats: splat_columns(splats) | {name: splats.extras[name] for name in extras},
    )
    write_elements(path, [element], comments_from_meta(bundle.meta))
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "count": element.count,
        "bytes": path.stat().st_size,
        "sha256": digest,
        "bounds": bounding_box(sets),
    }


def read_folder(folder: str | Path, warn: Warn = ignore) -> Bundle:
    """Read the levels of a folder from its manifest, or from one series ``lodN.ply`` or ``NAME_lodN.ply``.

    The output folder of a 3DGS program has one level, the newest ``point_cloud/iteration_N/point_cloud.ply``.

    Args:
        warn: as for `read_ply`.

    Raises:
        LodgsError: the folder has no levels or several series, or a file cannot be read.
    """
    folder = Path(folder)
    if (folder / MANIFEST_FILE).exists():
        return _read_manifest(folder, warn)
    coarse_first = _find_series(folder)
    head, rows = open_bundle(coarse_first[-1])
    shift = next(iter(rows.values())).origin
    levels = [Level(i, read_ply(file, warn, shift)) for i, file in enumerate(coarse_first, 1)]
    return Bundle("", levels, meta=head.meta)


def read_origin(path: str | Path) -> np.ndarray:
    """Return the local origin (3,) of a bundle, a folder of levels or any 3DGS PLY; read no splats.

    Raises:
        LodgsError: the file cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        return open_bundle(path)[0].origin
    if (path / MANIFEST_FILE).exists():
        return _parse_manifest(path)[0].origin
    return open_bundle(_find_series(path)[-1])[0].origin


def _find_series(folder: Path) -> list[Path]:
    """Return the files of a folder's only series of levels, from coarse to fine.

    The output folder of a 3DGS program counts as one level.

    Raises:
        LodgsError: the folder has no levels, several series or too many levels.
    """
    series: dict[str, list[tuple[int, Path]]] = {}
    for file in folder.glob("*.ply"):
        if match := re.fullmatch(r"(|.+_)lod(\d+)\.ply", file.name):
            series.setdefault(match[1], []).append((int(match[2]), file))
    if not series and (trained := _last_iteration(folder)):
        return [trained]
    if len(series) != 1:
        raise LodgsError(
            f"Cannot read {folder}: it has {len(series) or 'no'} series of levels (lod0.ply, lod1.ply, ...).",
            "Choose a folder with one series, or a single PLY.",
        )
    files = [file for _, file in sorted(next(iter(series.values())), reverse=True)]
    if len(files) > MAX_READ_LEVELS:
        raise LodgsError(
            f"Cannot read {folder}: it has {len(files)} levels, more than {MAX_READ_LEVELS}.",
            "Remove files from the series.",
        )
    return files


def _last_iteration(folder: Path) -> Path | None:
    """Return the newest PLY in the output folder of a 3DGS program, or None."""
    files = folder.glob("point_cloud/iteration_*/point_cloud.ply")
    numbered = [(int(n), file) for file in files if (n := file.parent.name[len("iteration_") :]).isdecimal()]
    return max(numbered)[1] if numbered else None


def _read_manifest(folder: Path, warn: Warn) -> Bundle:
    """Read the levels and tables that a manifest lists.

    A level of a cumulative bundle consists of the rows of its file after those of the next coarser level.
    """
    manifest_file = folder / MANIFEST_FILE
    bundle, manifest = _parse_manifest(folder)
    try:
        lines = sorted(manifest["levels"], key=lambda line: line["level"])
        begin = 0
        for level, line in zip(bundle.levels, lines, strict=True):
            file = folder / Path(line["file"]).name
            splats = splats_from_rows(read_elements(file)[0]["vertex"], file)
            if not begin <= line["count"] == len(splats):
                raise ValueError(f"level {level.number} should have {line['count']} splats")
            if bundle.cumulative:
                splats = splats.select(slice(begin, None))
                begin = line["count"]
            level.splats = drop_undrawable(splats, file, warn)
        if bundle.cumulative and len({level.sh_degree for level in bundle.levels}) > 1:
            raise ValueError("levels that add up have different SH degrees")
        if tables := check_type(manifest.get("tables", []), list, "tables"):
            bundle.tables = pop_tables(tables, read_elements(folder / TABLES_FILE)[0])
        return bundle
    except INCONSISTENCIES as error:
        raise inconsistency_error(manifest_file, error) from error


def _parse_manifest(folder: Path) -> tuple[Bundle, dict]:
    """Return the bundle that a manifest describes, without splats, and the manifest.

    Raises:
        LodgsError: the manifest cannot be read or is inconsistent.
    """
    file = folder / MANIFEST_FILE
    try:
        manifest = read_json(file)
        return parse_bundle(manifest, manifest["levels"], manifest["meta"], file), manifest
    except INCONSISTENCIES as error:
        raise inconsistency_error(file, error) from error
