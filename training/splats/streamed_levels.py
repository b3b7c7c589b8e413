"""Levels that browsers stream by distance: PlayCanvas' streamed SOG.

A tree divides space. Each leaf has its splats of every level as a range of a file, and a viewer selects a
level per leaf. Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..documents import read_json
from ..errors import LodgsError, printable
from ..files import atomic_folder, check_export_folder
from .batches import batch_slices
from .dialects import comments_from_meta
from .gaussians import SplatRows, Splats, equalize_degrees
from .levels import MAX_READ_LEVELS, Bundle
from .morton import spatial_order
from .ply import write_ply
from .portable_levels import ConcatenatedRows
from .sog import MAX_DEGREE, META, encode_sog, load_packages, read_sog, relative_parts, sog_error
from .splat_format import require_degree

STREAMED_FILE = "lod-meta.json"
"""Main file of streamed levels, in a folder of their own."""
SURROUNDINGS = f"env/{META}"
"""File of the surroundings, which viewers draw at every distance."""
FAR = 2.0
"""Distance from the center, or radius of a splat, from which on it belongs to the surroundings.

Unit: the radius that contains 90 % of the finest splats.
"""
LEAF_SPLATS = 1 << 14
"""Maximum number of splats of all levels in a leaf."""
FILE_SPLATS = 1 << 17
"""Maximum number of splats of a SOG; larger levels have several."""
MeasureLeaf = Callable[[Mapping[int, Splats], np.ndarray], Mapping[int, float]]
"""Function that returns the error of each level of detail of a leaf from its splats and bounds (2, 3)."""
_MAX_JSON, _MAX_NESTING = 1 << 26, 200
"""Maximum bytes and nesting of the main file."""
_SIGMAS = 3.0
"""Extent of a splat in the bounds of leaves, in standard deviations."""


@dataclass
class _Leaf:
    """A region of space.

    Attributes:
        rows: rows (N,) of its splats by level of detail, 0 the finest, in Morton order.
        ranges: entry of each level of detail in the main file.
        bounds: (2, 3), minimum and maximum of its splats.
        errors: error of each level of detail, if measured.
    """

    rows: dict[int, np.ndarray]
    ranges: dict[int, dict[str, int]] = field(default_factory=dict)
    bounds: np.ndarray = field(default_factory=lambda: np.array([[np.inf] * 3, [-np.inf] * 3]))
    errors: list[float] = field(default_factory=list)


def write_streamed_levels(folder: Path, bundle: Bundle, measure: MeasureLeaf | None = None) -> None:
    """Write levels that browsers stream by distance: ``lod-meta.json`` and its files.

    Levels without splats, which crops can leave, are omitted. An earlier export in the folder is replaced
    after all files are written. Memory holds the means of all levels and the splats of one file.

    Args:
        measure: function that measures the levels' errors, for viewers that select levels by error.

    Raises:
        LodgsError: a package is missing, the folder has other files or cannot be written, no level has
            splats, or the degree of harmonics is too high.
    """
    load_packages()
    levels = [ConcatenatedRows.of_level(bundle, level.number) for level in reversed(bundle.levels)]
    levels = [rows for rows in levels if len(rows)]
    if not levels:
        raise LodgsError("Cannot export levels: they contain no splats.", "Make some splats visible.")
    degree = max(require_degree(rows, MAX_DEGREE, "levels for web") for rows in levels)
    check_export_folder(folder, STREAMED_FILE, r"env|\d+_\d+")
    with atomic_folder(folder) as target:
        _write_files(target, levels, degree, bundle.antialias, measure)


def _write_files(
    folder: Path, levels: Sequence[SplatRows], degree: int, antialias: bool, measure: MeasureLeaf | None
) -> None:
    """Write the files of levels, finest first, into an empty folder.

    Args:
        degree: degree of harmonics of all files.
        antialias: as for `encode_sog`.
        measure: measures the errors of leaves; None writes none.
    """
    places = np.concatenate([_read_places(rows) for rows in levels])
    begins = np.cumsum([0, *map(len, levels)])
    far = _is_surroundings(places, len(levels[0]))
    leaves: list[_Leaf] = []
    tree = _divide(np.flatnonzero(~far), places, begins, leaves)
    surroundings = np.flatnonzero(far[: len(levels[0])])
    counts = [int((~far[begin:end]).sum()) for begin, end in pairwise(begins)]
    del places, far
    names: list[str] = []
    for lod, rows in enumerate(levels):
        for number, group in enumerate(_file_groups(leaves, lod)):
            names.append(f"{lod}_{number}/{META}")
            _write_sog(folder / names[-1], _read_file(rows, group, lod, len(names) - 1, degree), antialias)
    if len(surroundings):
        splats = levels[0].select(surroundings).padded(degree)
        _write_sog(folder / SURROUNDINGS, splats.select(spatial_order(splats.means)), antialias)
    if measure is not None:
        for leaf in leaves:
            leaf.errors = _measure_errors(leaf, levels, measure)
    meta = {
        "version": 1,
        "asset": {"generator": "LODGS"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "lodErrors": measure is not None,
        **({"environment": SURROUNDINGS} if len(surroundings) else {}),
        "filenames": names,
        "tree": _describe(tree),
    }
    (folder / STREAMED_FILE).write_text(json.dumps(meta), "utf-8")


def _measure_errors(leaf: _Leaf, levels: Sequence[SplatRows], measure: MeasureLeaf) -> list[float]:
    """Return the error of each level of detail of a leaf; coarser levels have no smaller one."""
    errors = measure({lod: _read_rows(levels[lod], rows) for lod, rows in leaf.rows.items()}, leaf.bounds)
    result, largest = [0.0] * len(levels), 0.0
    for lod in sorted(errors):
        result[lod] = largest = max(largest, float(errors[lod]))
    return result


def _write_sog(path: Path, splats: Splats, antialias: bool) -> None:
    path.parent.mkdir()
    for name, data in encode_sog(splats, antialias).items():
        path.with_name(name).write_bytes(data)


def _read_places(rows: SplatRows) -> np.ndarray:
    """Read the means and the radii of splats in batches, (N, 4) float32."""
    parts = []
    for batch in batch_slices(len(rows)):
        splats = rows.select(batch)
        parts.append(np.concatenate([splats.means, _radii(splats)], axis=1))
    return np.concatenate(parts)


def _radii(splats: Splats) -> np.ndarray:
    """Return the radii (N, 1) that bounds include."""
    return _SIGMAS * np.exp(splats.log_scales.max(axis=1, keepdims=True))


def _is_surroundings(places: np.ndarray, count: int) -> np.ndarray:
    """Return True (N,) for sky and other far splats; the first ``count`` places are the finest level's.

    They would enlarge the bounds of leaves, which then could not be far from any camera.
    """
    finest = places[:count, :3]
    center = np.median(finest, axis=0)
    limit = FAR * np.quantile(np.linalg.norm(finest - center, axis=1), 0.9)
    far = (np.linalg.norm(places[:, :3] - center, axis=1) > limit) | (places[:, 3] > limit)
    return far if not far[:count].all() else np.zeros(len(places), bool)


_Node = _Leaf | tuple["_Node", "_Node"]
"""A leaf, or two halves of a region."""


def _divide(rows: np.ndarray, places: np.ndarray, begins: np.ndarray, leaves: list[_Leaf]) -> _Node:
    """Divide rows of all levels at medians of the longest axis, and append the leaves in their order."""
    points = places[rows, :3]
    if len(rows) > LEAF_SPLATS:
        axis = int(np.ptp(points, axis=0).argmax())
        order, middle = np.argpartition(points[:, axis], len(rows) // 2), len(rows) // 2
        low = _divide(rows[order[:middle]], places, begins, leaves)
        return low, _divide(rows[order[middle:]], places, begins, leaves)
    ordered = rows[spatial_order(points)]
    lods = np.searchsorted(begins, ordered, side="right") - 1
    leaf = _Leaf({int(lod): ordered[lods == lod] - begins[lod] for lod in np.unique(lods)})
    leaves.append(leaf)
    return leaf


def _file_groups(leaves: Sequence[_Leaf], lod: int) -> Iterator[list[_Leaf]]:
    """Yield the leaves with splats of a level that share a file."""
    group, count = [], 0
    for leaf in leaves:
        if lod in leaf.rows:
            group.append(leaf)
            count += len(leaf.rows[lod])
        if count >= FILE_SPLATS:
            yield group
            group, count = [], 0
    if group:
        yield group


def _read_file(rows: SplatRows, leaves: Sequence[_Leaf], lod: int, file: int, degree: int) -> Splats:
    """Return a level's splats in leaves that share a file, and enter their ranges and bounds."""
    splats = _read_rows(rows, np.concatenate([leaf.rows[lod] for leaf in leaves]))
    splats, reach, offset = splats.padded(degree), _radii(splats), 0
    for leaf in leaves:
        count = len(leaf.rows[lod])
        part = slice(offset, offset + count)
        leaf.ranges[lod] = {"file": file, "offset": offset, "count": count}
        low = (splats.means[part] - reach[part]).min(axis=0)
        high = (splats.means[part] + reach[part]).max(axis=0)
        leaf.bounds = np.array([np.minimum(leaf.bounds[0], low), np.maximum(leaf.bounds[1], high)])
        offset += count
    return splats


def _read_rows(rows: SplatRows, wanted: np.ndarray) -> Splats:
    """Return splats by row, in any order."""
    order = np.argsort(wanted, kind="stable")
    return rows.select(wanted[order]).select(np.argsort(order, kind="stable"))


def _describe(node: _Node) -> dict:
    """Return the entry of a node in the main file."""
    if isinstance(node, _Leaf):
        low, high = node.bounds.tolist()
        return {
            "bound": {"min": low, "max": high},
            "lods": {str(lod): entry for lod, entry in sorted(node.ranges.items())},
            **({"errors": node.errors} if node.errors else {}),
        }
    children = [_describe(child) for child in node]
    low = np.min([child["bound"]["min"] for child in children], axis=0)
    high = np.max([child["bound"]["max"] for child in children], axis=0)
    return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}


def read_streamed_levels(path: Path, folder: Path) -> None:
    """Convert streamed levels to a folder of PLYs, each with the surroundings; omit levels without splats.

    Args:
        path: a :data:`STREAMED_FILE`.

    Raises:
        LodgsError: the files cannot be read or are damaged, refer to files outside their folder, or Pillow is
            missing.
    """
    meta = read_json(path, max_bytes=_MAX_JSON, max_nesting=_MAX_NESTING)
    count = meta.get("lodLevels")
    if type(count) is not int or not 1 <= count <= MAX_READ_LEVELS:
        raise LodgsError(f"Cannot read {path}: it does not describe streamed levels.", "Choose another file.")
    if meta.get("version", 1) != 1:
        version = printable(meta["version"])
        raise LodgsError(
            f"Cannot read {path}: its streamed levels have version {version}.", "Export them as version 1."
        )
    meta_of_splats: dict = {}

    def read_part(name: str) -> Splats:
        splats, part_meta = read_sog(path.parent.joinpath(*relative_parts(name)))
        meta_of_splats.update(part_meta)
        return splats

    try:
        names, ranges = list(meta["filenames"]), _collect_ranges(meta["tree"], count)
        surroundings = [read_part(meta["environment"])] if meta.get("environment") else []
        folder.mkdir()
        for lod, files in enumerate(filter(None, ranges)):
            parts = [_select(read_part(names[file]), files[file]) for file in sorted(files)]
            splats = Splats.concatenated(equalize_degrees(parts + surroundings))
            write_ply(folder / f"lod{lod}.ply", splats, comments_from_meta(meta_of_splats))
    except LodgsError:
        raise
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, OSError) as error:
        raise sog_error(path, error) from error


def _collect_ranges(tree: dict, count: int) -> list[dict[int, list[tuple[int, int]]]]:
    """Return the first row and the end of each part with splats of each level, by the number of its file."""
    ranges: list[dict[int, list[tuple[int, int]]]] = [{} for _ in range(count)]
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        waiting += node.get("children", [])
        for lod, entry in node.get("lods", {}).items():
            file, offset, length = (entry[name] for name in ("file", "offset", "count"))
            if not all(type(value) is int and value >= 0 for value in (int(lod), file, offset, length)):
                raise ValueError("a range of splats is not valid")
            if length:
                ranges[int(lod)].setdefault(file, []).append((offset, offset + length))
    return ranges


def _select(splats: Splats, ranges: Sequence[tuple[int, int]]) -> Splats:
    """Return the splats in ranges of rows.

    Raises:
        ValueError: the ranges do not fit the splats.
    """
    if sum(end - begin for begin, end in ranges) > len(splats) or max(ranges)[1] > len(splats):
        raise ValueError("ranges of splats do not fit their file")
    return splats.select(np.concatenate([np.arange(begin, end) for begin, end in ranges]))
