"""Bundles: one PLY with every level of detail, which ordinary viewers open at the finest level.

``docs/reference/bundle.md`` specifies the format.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .bundle_header import (
    INCONSISTENCIES,
    bundle_line,
    format_comment,
    inconsistency_error,
    level_line,
    parse_comments,
    pop_tables,
    table_elements,
    table_lines,
)
from .coding import Codebook, code_elements
from .dialects import Warn, comments_from_meta, drawable_3dgs, drop_undrawable, ignore, meta_from_comments
from .file_rows import FileRows
from .gaussians import Splats
from .levels import NO_SPLATS, Bundle, Level
from .mapped_rows import release_pages
from .origin import FAR_SPLATS, NO_ORIGIN, ORIGIN_SAMPLE, choose_origin
from .ply import (
    Columns,
    Element,
    extra_columns,
    read_comments,
    read_elements,
    splat_columns,
    splats_from_rows,
    write_elements,
)

ORDERS = ("finest_first", "stream")
"""Orders of the levels in a file: finest or coarsest level first."""
# Some viewers read no further than 10 KB to find the end of the header. Usual descriptions take 1 to 3 KB.
_MAX_COMMENTS = 5120

RowSelector = Callable[[Bundle], Mapping[int, np.ndarray]]
"""Returns the rows (M,) of each level to read, by level number, for a bundle with its tables but without
splats. Rows beyond the last one are ignored."""


def write_bundle(
    path: str | Path, bundle: Bundle, order: str = "finest_first", codebook: Codebook | None = None
) -> None:
    """Write all levels into one PLY whose first element ``vertex`` is a complete, plain 3DGS scene.

    Args:
        order: the level of ``vertex``: the finest ("finest_first"), or the coarsest ("stream", so that a
            reader has a complete scene after each level). A cumulative bundle always has one ``vertex`` with
            all levels from coarse to fine.
        codebook: compress the splats with it (``coding.py``), so that only LODGS reads them. Needs all
            splats in memory.

    Raises:
        LodgsError: the file cannot be written, the levels do not form a bundle (see `Bundle.check`), or the
            header is too long.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {order!r}, not one of {ORDERS}")
    bundle.check()
    levels = list(enumerate(reversed(bundle.levels)))  # lod 0 is the finest
    if order == "stream" or bundle.cumulative:
        levels.reverse()
    sets = {"vertex": [level for _, level in levels]}
    if not bundle.cumulative:
        sets = {f"lod_{lod}_vertex" if i else "vertex": [level] for i, (lod, level) in enumerate(levels)}
    further = []
    if codebook is None:
        elements = [
            Element.from_splats(name, [level.rows for level in parts], splat_columns)
            for name, parts in sets.items()
        ]
    else:
        elements = _code_levels(sets, codebook)
        elements, further = elements[: len(sets)], elements[len(sets) :]
    extra = extra_columns if codebook is None else _all_extras
    extras = {
        lod: Element.from_splats(f"lod_extra_{lod}", [level.rows], extra)
        for lod, level in levels
        if extra(level.rows.select(slice(0, 0)))
    }
    lines = [bundle_line(bundle, order=order)]
    offset = 0
    for i, (lod, level) in enumerate(levels):
        element = elements[0 if bundle.cumulative else i]
        line = level_line(lod, level) | {"element": element.name, "offset": offset}
        if lod in extras:
            line["extras"] = extras[lod].name
        lines.append(line)
        offset += len(level.rows) * element.dtype.itemsize
    comments = [format_comment(line) for line in [*lines, *table_lines(bundle), {"meta": bundle.meta}]]
    if sum(len(comment) + 9 for comment in comments) > _MAX_COMMENTS:
        raise LodgsError(
            f"Cannot write {path}: its description needs more than {_MAX_COMMENTS} bytes of header.",
            "Reduce meta to a few numbers and names.",
        )
    elements += [*further, *extras.values(), *table_elements(bundle)]
    write_elements(path, elements, comments + comments_from_meta(bundle.meta))


def _code_levels(sets: Mapping[str, list[Level]], codebook: Codebook) -> list[Element]:
    """Return the compressed elements of levels, and those that decode them."""
    splats = {}
    for name, levels in sets.items():
        rows = Splats.concatenated([level.rows.select(slice(None)) for level in levels])
        splats[name] = rows, np.concatenate([codebook.codes[level.number] for level in levels])
    coded = code_elements(splats, codebook.sets)
    return [Element.from_columns(name, columns) for name, columns in coded.items()]


def _all_extras(splats: Splats) -> Columns:
    return splats.extras


def read_bundle(path: str | Path, warn: Warn = ignore, select_rows: RowSelector | None = None) -> Bundle:
    """Read a bundle bit for bit; any other 3DGS PLY becomes one level of unknown method.

    A third-party PLY far from 0 gets a local origin (``origin.py``). Splats that cannot be drawn are dropped
    (`dialects.drop_undrawable`). Elements and comments of other programs are ignored.

    Args:
        warn: as for `read_ply`.
        select_rows: selects the splats to read; None reads all. Of a binary file, nothing else is read.

    Raises:
        LodgsError: the file is not a PLY of splats, is truncated, has an inconsistent header, or is from a
            newer version.
    """
    elements, comments = read_elements(path)
    bundle, lines = parse_comments(comments, path)
    if bundle is None:
        meta, shift = _plain_meta(elements["vertex"], comments)
        splats = drawable_3dgs(splats_from_rows(elements["vertex"], path, shift), path, warn)
        return Bundle("", [Level(1, splats)], meta=meta)
    level_rows = _find_rows(bundle, lines, elements, path)
    try:
        selections = {} if select_rows is None else select_rows(bundle)
        for level in bundle.levels:
            rows = level_rows[level.number]
            index = selections.get(level.number, slice(None))
            index = index if isinstance(index, slice) else index[index < len(rows)]
            level.splats = drop_undrawable(rows.select(index), path, warn)
        return bundle
    except INCONSISTENCIES as error:
        raise inconsistency_error(path, error) from error


def open_bundle(path: str | Path) -> tuple[Bundle, dict[int, FileRows]]:
    """Open a bundle, or any other PLY as one level of unknown method, to read its splats in batches.

    Nothing else is read of a binary file.

    Returns:
        The bundle with its tables but without splats, and the unconverted rows of each level by number.

    Raises:
        LodgsError: as `read_bundle`.
    """
    elements, comments = read_elements(path)
    bundle, lines = parse_comments(comments, path)
    if bundle is None:
        meta, shift = _plain_meta(elements["vertex"], comments)
        return Bundle("", [Level(1, NO_SPLATS)], meta=meta), {
            1: FileRows(elements["vertex"], None, path, shift)
        }
    return bundle, _find_rows(bundle, lines, elements, path)


def read_header(path: str | Path) -> Bundle:
    """Read a bundle without splats from the header alone; any other 3DGS PLY is one level of unknown method.

    The local origin of a third-party PLY far from 0 is missing in its meta: `open_bundle` returns it.

    Raises:
        LodgsError: as `read_bundle`.
    """
    comments = read_comments(path)
    return parse_comments(comments, path)[0] or Bundle(
        "", [Level(1, NO_SPLATS)], meta=meta_from_comments(comments)
    )


def read_tables(path: str | Path) -> dict[str, Columns]:
    """Read the tables of a bundle without its splats; any other 3DGS PLY has none.

    Raises:
        LodgsError: as `read_bundle`.
    """
    elements, comments = read_elements(path)
    try:
        return pop_tables([line for line in parse_comments(comments, path)[1] if "table" in line], elements)
    except INCONSISTENCIES as error:
        raise inconsistency_error(path, error) from error


def _plain_meta(rows: np.ndarray, comments: list[str]) -> tuple[dict, np.ndarray]:
    """Return the meta of a plain PLY, and the local origin to subtract from its positions (3,) float64.

    A PLY that names its local origin is already relative to it.
    """
    meta = meta_from_comments(comments)
    if "origin" in meta or not set("xyz") <= set(rows.dtype.names or ()):
        return meta, NO_ORIGIN
    sample = rows[:: max(1, len(rows) // ORIGIN_SAMPLE)]
    means = np.stack([np.asarray(sample[axis], np.float64) for axis in "xyz"], axis=1)
    release_pages(rows)
    origin = choose_origin(means, far=FAR_SPLATS)
    return meta | ({"origin": origin.tolist()} if origin.any() else {}), origin


def _find_rows(
    bundle: Bundle, lines: list[dict], elements: dict[str, np.ndarray], path: str | Path
) -> dict[int, FileRows]:
    """Return the rows of each level by number, and add the tables to the bundle.

    Raises:
        LodgsError: the lines contradict the elements.
    """
    try:
        level_rows, begin = {}, dict.fromkeys(elements, 0)
        level_elements = {line["element"] for line in lines if "level" in line}
        # each remaining element belongs to one level or table, so it is popped
        further = {name: rows for name, rows in elements.items() if name not in level_elements}
        bundle.tables = pop_tables([line for line in lines if "table" in line], further)
        for line in lines:
            if "level" not in line:
                continue
            name, count = line["element"], line["count"]
            rows = elements[name][begin[name] : begin[name] + count]
            begin[name] += count
            extras = further.pop(line["extras"]) if "extras" in line else None
            if len(rows) != count or (extras is not None and len(extras) != count):
                raise ValueError(f"level {line['level']} should have {count} splats")
            level_rows[line["level"]] = FileRows(rows, extras, path)
        for name in level_elements:
            if begin[name] != len(elements[name]):
                raise ValueError(f"{name} has more splats than its levels")
        return level_rows
    except INCONSISTENCIES as error:
        raise inconsistency_error(path, error) from error
