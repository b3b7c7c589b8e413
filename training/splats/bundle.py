"""Levels of detail in files: one PLY that ordinary viewers open (the bundle), or a folder of plain PLYs.

``docs/bundle.md`` specifies both. Constraints that a method applies outside the parameters (FLoD's s_min, the
filters of Mip-Splatting and LODGE) are part of the scales and opacities handed over here: ``log_scales`` are
final, and what facts say of them is a record of how they came about.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..documents import parse_json, quote, read_json
from ..errors import LodgsError
from ..files import atomic_write
from .dialects import (
    MAX_COORDINATE,
    Warn,
    comments_from_meta,
    drawable_3dgs,
    drop_undrawable,
    dropped_message,
    ignore,
    meta_from_comments,
    to_3dgs,
)
from .gaussians import SplatRows, Splats
from .ply import (
    BATCH_ROWS,
    Columns,
    Element,
    extra_columns,
    read_comments,
    read_elements,
    read_ply,
    release_pages,
    splat_columns,
    splats_from_rows,
    write_elements,
)

FORMAT_VERSION = 2
MAX_LEVELS = 12
"""Levels that a job may ask for, or get from its scene: a header has no room for many more."""
MAX_READ_LEVELS = 64
"""Levels that are read of a file of anybody's making."""
ORDERS = ("finest_first", "stream")
TABLES_FILE = "tables.ply"
"""What holds the tables of a folder of levels."""
_ROW = "row"
"""Column that tells in which row of a file splats are."""
_TAG = "lodsplat "
# Some viewers search the whole header for these words, so no comment may hold one.
_FORBIDDEN = ("packed_", "f_rest_", "end_header", "element chunk")
# Some viewers read no further than 10 KB to find the end of the header.
_MAX_COMMENTS = 2560
_LARGEST_FACT = 1e30
META_SHAPES = {"camera_center": (3,), "up_rotation": (3, 3), "view": (2, 3)}
"""What readers rely on of meta, where it is there; none of its numbers is beyond FARTHEST."""
META_LENGTHS = ("scene_extent", "median_depth", "voxel", "distances")
"""What of meta, at any depth, are lengths in scene units."""
# What reading others' descriptions raises where something in them is missing, or of another kind.
_CONTRADICTIONS = (ValueError, KeyError, TypeError, AttributeError)

Kind = TypeVar("Kind")


@dataclass
class Level:
    """One level of detail.

    Attributes:
        number: 1 is the coarsest.
        splats: the level's splats with final scales and opacities.
        facts: numbers of this level by name that its rule needs, such as FLoD's ``s_min``.
        on_disk: the splats, where they are not in memory but read a few at a time to be written.
    """

    number: int
    splats: Splats
    facts: dict[str, float] = field(default_factory=dict)
    on_disk: SplatRows | None = None

    @property
    def rows(self) -> SplatRows:
        """The splats, wherever they are."""
        return self.splats if self.on_disk is None else self.on_disk

    @property
    def sh_degree(self) -> int:
        """Of the splats, wherever they are."""
        return self.rows.select(slice(0, 0)).sh_degree


NO_SPLATS = Splats(
    np.zeros((0, 3), np.float32), np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32), np.zeros((0, 1, 3), np.float32),
)  # fmt: skip


@dataclass
class Bundle:
    """Levels of detail of one scene.

    Attributes:
        method: the name of the method that made them ("flod", "3dgs", ...; "" when unknown).
        levels: in ascending number, all of one SH degree.
        rule: the name of the rule that chooses them by distance (``training.lod.rule``); "" for none.
        facts: numbers of the scene by name that the rule needs.
        controls: values of the rule's controls to begin with, by name.
        cumulative: False when each level replaces the others; True when each level only holds what it adds to
            the coarser ones, so that level n is drawn as levels 1 to n together.
        meta: what else is known, of types that JSON knows (numpy scalars and arrays are converted).
        tables: further tables by name, of columns (rows,) by name that PLY has types for.
    """

    method: str
    levels: list[Level]
    rule: str = ""
    facts: dict[str, float] = field(default_factory=dict)
    controls: dict[str, float] = field(default_factory=dict)
    cumulative: bool = False
    meta: dict = field(default_factory=dict)
    tables: dict[str, Columns] = field(default_factory=dict)

    @property
    def antialias(self) -> bool:
        """Whether the splats are drawn through Mip-Splatting's 2D filter, as they were trained."""
        return bool(self.meta.get("antialias"))

    @property
    def up_rotation(self) -> np.ndarray:
        """(3, 3) float64, the rotation that turns the scene upright, z up: as ``meta`` says, or else from -y,
        which is up in most files of splats."""
        return np.array(self.meta.get("up_rotation", ((1, 0, 0), (0, 0, 1), (0, -1, 0))), np.float64)

    @property
    def on_disk(self) -> bool:
        """Whether splats of a level are not in memory."""
        return any(level.on_disk is not None for level in self.levels)

    def drawn_levels(self, number: int) -> list[Level]:
        """The levels that are drawn at a level: it, and where levels add up the coarser ones before it."""
        return [
            level
            for level in self.levels
            if level.number == number or (self.cumulative and level.number < number)
        ]


def write_bundle(path: str | Path, bundle: Bundle, order: str = "finest_first") -> None:
    """Write all levels into one PLY whose first element ``vertex`` is a complete, plain 3DGS scene.

    ``order`` says which level is ``vertex``: the finest ("finest_first"), or the coarsest ("stream", where a
    reader that stops after any level has a complete scene). A cumulative bundle has one ``vertex``, coarse to
    fine, in either order.

    Raises:
        LodgsError: the file cannot be written, or the bundle is not one (see `Bundle`), or what is said
            beside the levels is too long.
    """
    if order not in ORDERS:
        raise ValueError(f"order is {order!r}, not one of {ORDERS}")
    _check(bundle)
    levels = list(enumerate(reversed(bundle.levels)))  # lod 0 is the finest
    if order == "stream" or bundle.cumulative:
        levels.reverse()
    if bundle.cumulative:
        elements = [Element.from_splats("vertex", [level.rows for _, level in levels], splat_columns)]
    else:
        names = ["vertex", *(f"lod_{lod}_vertex" for lod, _ in levels[1:])]
        elements = [
            Element.from_splats(name, [level.rows], splat_columns)
            for name, (_, level) in zip(names, levels, strict=True)
        ]
    extras = {
        lod: Element.from_splats(f"lod_extra_{lod}", [level.rows], extra_columns)
        for lod, level in levels
        if extra_columns(level.rows.select(slice(0, 0)))
    }
    comments = [_comment(_head(bundle, order=order))]
    offset = 0
    for i, (lod, level) in enumerate(levels):
        element = elements[0 if bundle.cumulative else i]
        line = _level_line(lod, level) | {"element": element.name, "offset": offset}
        if lod in extras:
            line["extras"] = extras[lod].name
        comments.append(_comment(line))
        offset += len(level.rows) * element.dtype.itemsize
    comments += [_comment(line) for line in _table_lines(bundle)]
    comments.append(_comment({"meta": bundle.meta}))
    if sum(len(comment) + 9 for comment in comments) > _MAX_COMMENTS:
        raise LodgsError(
            f"What {path} would say beside its levels takes more than {_MAX_COMMENTS} bytes of header.",
            "Keep meta to a few numbers and names.",
        )
    everything = [*elements, *extras.values(), *_table_elements(bundle)]
    write_elements(path, everything, comments + comments_from_meta(bundle.meta))


RowSelector = Callable[[Bundle], Mapping[int, np.ndarray]]
"""Of a bundle with its tables, but without splats yet: which rows (M,) of each level to read, by number;
those beyond its last one do not count."""


def read_bundle(path: str | Path, warn: Warn = ignore, rows_of: RowSelector | None = None) -> Bundle:
    """Read a bundle as it was written, bit for bit; any other 3DGS PLY reads as one level of unknown method.

    Splats that cannot be drawn are left out (`dialects.drawable`).

    Elements and comments that are not ours are passed over.

    Args:
        warn: as for `read_ply`.
        rows_of: where not all splats are wanted: of a binary file no others are read then.

    Raises:
        LodgsError: not a PLY of splats, cut short, from a newer version, or a header that contradicts itself.
    """
    elements, comments = read_elements(path)
    bundle, lines = _parse(comments, path)
    if bundle is None:
        splats = drawable_3dgs(splats_from_rows(elements["vertex"], path), path, warn)
        return Bundle("", [Level(1, splats)], meta=meta_from_comments(comments))
    rows = _rows_of_levels(bundle, lines, elements, path)
    try:
        wanted = {} if rows_of is None else rows_of(bundle)
        for level in bundle.levels:
            found, some = rows[level.number], wanted.get(level.number, slice(None))
            some = some if isinstance(some, slice) else some[some < len(found)]
            level.splats = drop_undrawable(found.select(some), path, warn)
        return bundle
    except _CONTRADICTIONS as error:
        raise _contradiction(path, error) from error


@dataclass(frozen=True)
class FileRows:
    """A level's splats in a file.

    Attributes:
        vertices: the 3DGS columns of each splat, structured.
        extras: the further columns, or None.
        path: of the file.
    """

    vertices: np.ndarray
    extras: np.ndarray | None
    path: str | Path

    def __len__(self) -> int:
        return len(self.vertices)

    def columns(self, some: slice | np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Columns (M,) of some rows, of those of these names that there are; nothing else is read."""
        found = {}
        for rows in (self.vertices, self.extras):
            there = () if rows is None else rows.dtype.names or ()
            found |= {name: np.array(rows[name][some]) for name in names if name in there}  # type: ignore[index]
            if rows is not None:
                release_pages(rows)
        return found

    def select(self, some: slice | np.ndarray) -> Splats:
        """The splats of some rows, drawable or not; none of the file stays in memory.

        Raises:
            LodgsError: as ``splats_from``.
        """
        splats = splats_from_rows(self.vertices[some], self.path)
        if self.extras is not None:
            extras = self.extras[some]
            splats.extras |= {column: np.array(extras[column]) for column in extras.dtype.names or ()}
        release_pages(self.vertices)
        if self.extras is not None:
            release_pages(self.extras)
        return splats


class DrawableRows:
    """Of the splats of a file those that can be drawn, in the meaning of the 3DGS columns.

    All are read once for it.

    Args:
        warn: as for `read_ply`.
    """

    def __init__(self, rows: FileRows, warn: Warn = ignore) -> None:
        self._rows, self._kept = rows, None
        kept, tell = [], warn
        for begin in range(0, len(rows), BATCH_ROWS):
            splats = self._meant(slice(begin, begin + BATCH_ROWS), tell)
            splats.extras = {_ROW: begin + np.arange(len(splats))}
            kept.append(drop_undrawable(splats, rows.path).extras[_ROW])
            tell = ignore
        missing = len(rows) - sum(map(len, kept))
        if missing:
            self._kept = np.concatenate(kept)
            warn(dropped_message(missing, rows.path))

    def __len__(self) -> int:
        return len(self._rows) if self._kept is None else len(self._kept)

    def select(self, some: slice | np.ndarray, /) -> Splats:
        """The splats of a range of rows, or of some rows (M,) ascending."""
        return drop_undrawable(self._meant(some if self._kept is None else self._kept[some]), self._rows.path)

    def _meant(self, some: slice | np.ndarray, warn: Warn = ignore) -> Splats:
        splats = self._rows.select(some)
        return splats if self._rows.extras is not None else to_3dgs(splats, self._rows.path, warn)


def open_bundle(path: str | Path) -> tuple[Bundle, dict[int, FileRows]]:
    """A bundle with its tables, but without splats, and each level's by number to read of, as they stand
    there: of a binary file nothing else is read. Any other PLY is one level of unknown method.

    Raises:
        LodgsError: as `read_bundle`.
    """
    elements, comments = read_elements(path)
    bundle, lines = _parse(comments, path)
    if bundle is None:
        bundle = Bundle("", [Level(1, NO_SPLATS)], meta=meta_from_comments(comments))
        return bundle, {1: FileRows(elements["vertex"], None, path)}
    return bundle, _rows_of_levels(bundle, lines, elements, path)


def open_ply(path: str | Path) -> FileRows:
    """The splats of a plain PLY to read of, as they stand in the file.

    Raises:
        LodgsError: as ``read_elements``.
    """
    return FileRows(read_elements(path)[0]["vertex"], None, path)


def _rows_of_levels(
    bundle: Bundle, lines: list[dict], elements: dict[str, np.ndarray], path: str | Path
) -> dict[int, FileRows]:
    """Where each level's splats are; the bundle gets its tables.

    Raises:
        LodgsError: the lines contradict the elements.
    """
    try:
        found, begin = {}, dict.fromkeys(elements, 0)
        of_levels = {line["element"] for line in lines if "level" in line}
        apart = {name: rows for name, rows in elements.items() if name not in of_levels}  # each is taken once
        bundle.tables = _read_tables([line for line in lines if "table" in line], apart)
        for line in lines:
            if "level" not in line:
                continue
            name, count = line["element"], line["count"]
            rows = elements[name][begin[name] : begin[name] + count]
            begin[name] += count
            extras = apart.pop(line["extras"]) if "extras" in line else None
            if len(rows) != count or (extras is not None and len(extras) != count):
                raise ValueError(f"level {line['level']} should have {count} splats")
            found[line["level"]] = FileRows(rows, extras, path)
        for name in of_levels:
            if begin[name] != len(elements[name]):
                raise ValueError(f"{name} has more splats than its levels")
        return found
    except _CONTRADICTIONS as error:
        raise _contradiction(path, error) from error


def read_header(path: str | Path) -> Bundle:
    """What a bundle says of its levels, in the time that its header takes: the levels are without splats.

    Any other 3DGS PLY is one level of unknown method.

    Raises:
        LodgsError: as `read_bundle`.
    """
    comments = read_comments(path)
    return _parse(comments, path)[0] or Bundle("", [Level(1, NO_SPLATS)], meta=meta_from_comments(comments))


def read_tables(path: str | Path) -> dict[str, Columns]:
    """The tables of a bundle alone: its splats are not read. Any other 3DGS PLY has none.

    Raises:
        LodgsError: as `read_bundle`.
    """
    elements, comments = read_elements(path)
    try:
        return _read_tables([line for line in _parse(comments, path)[1] if "table" in line], elements)
    except _CONTRADICTIONS as error:
        raise _contradiction(path, error) from error


def write_folder(folder: str | Path, bundle: Bundle) -> None:
    """Write every level as a complete plain PLY, ``lod0.ply`` the finest, and ``manifest.json``.

    All files have the same columns, as splat-transform wants it: extras that not every level has are left
    out. Tables stand beside, in ``tables.ply``. Nothing is replaced before all is written; the manifest is
    moved into place last. Then what an earlier export has left that this one has no place for (``lodN.ply``,
    ``tables.ply``) is removed, and nothing else.

    Raises:
        LodgsError: as `write_bundle`.
    """
    _check(bundle)
    folder = Path(folder)
    first, *others = [extra_columns(level.rows.select(slice(0, 0))) for level in bundle.levels]
    shared = {
        name
        for name, column in first.items()
        if all(name in other and other[name].dtype == column.dtype for other in others)
    }
    manifest = _head(bundle) | {"levels": [], "meta": bundle.meta}
    if bundle.tables:
        manifest["tables"] = _table_lines(bundle)
    with ExitStack() as stack:
        manifest_file = stack.enter_context(atomic_write(folder / "manifest.json"))
        for lod, level in enumerate(reversed(bundle.levels)):
            path = folder / f"lod{lod}.ply"
            temporary = stack.enter_context(atomic_write(path))
            drawn = bundle.drawn_levels(level.number)
            element = Element.from_splats(
                "vertex",
                [x.rows for x in drawn],
                lambda some: splat_columns(some) | {name: some.extras[name] for name in sorted(shared)},
            )
            write_elements(temporary, [element], comments_from_meta(bundle.meta))
            with open(temporary, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            manifest["levels"].append(
                _level_line(lod, level)
                | {
                    "file": path.name,
                    "count": element.count,
                    "bytes": temporary.stat().st_size,
                    "sha256": digest,
                }
                | {"bounds": bounding_box([x.rows for x in drawn])}
            )
        if bundle.tables:
            temporary = stack.enter_context(atomic_write(folder / TABLES_FILE))
            no_splats = Element.from_columns("vertex", splat_columns(NO_SPLATS))
            write_elements(temporary, [no_splats, *_table_elements(bundle)])
        manifest_file.write_text(
            json.dumps(manifest, indent=1, default=json_default, allow_nan=False) + "\n", "ascii"
        )
    unused = [
        file
        for file in folder.glob("lod*.ply")
        if (found := re.fullmatch(r"lod(\d+)\.ply", file.name)) and int(found[1]) >= len(bundle.levels)
    ]
    for file in unused if bundle.tables else [*unused, folder / TABLES_FILE]:
        with suppress(OSError):  # the manifest does not name it
            file.unlink()


def read_folder(folder: str | Path, warn: Warn = ignore) -> Bundle:
    """Read a folder of levels: by its ``manifest.json``, or any one series ``lodN.ply`` or ``NAME_lodN.ply``.

    Where levels add up, each is what its file has after the rows of the next coarser one.

    Args:
        warn: as for `read_ply`.

    Raises:
        LodgsError: no levels, several series, or a file that cannot be read.
    """
    folder = Path(folder)
    manifest_file = folder / "manifest.json"
    if manifest_file.exists():
        try:
            manifest = read_json(manifest_file)
            bundle = _bundle(manifest, manifest["levels"], manifest["meta"], manifest_file)
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
            if lines_of_tables := _of_kind(manifest.get("tables", []), list, "tables"):
                bundle.tables = _read_tables(lines_of_tables, read_elements(folder / TABLES_FILE)[0])
            return bundle
        except _CONTRADICTIONS as error:
            raise _contradiction(manifest_file, error) from error
    series: dict[str, list[tuple[int, Path]]] = {}
    for file in folder.glob("*.ply"):
        if found := re.fullmatch(r"(|.+_)lod(\d+)\.ply", file.name):
            series.setdefault(found[1], []).append((int(found[2]), file))
    if len(series) != 1:
        raise LodgsError(
            f"{folder} has {len(series) or 'no'} series of levels (lod0.ply, lod1.ply, ...).",
            "Choose a folder with one series, or a single PLY.",
        )
    coarse_first = [file for _, file in sorted(next(iter(series.values())), reverse=True)]
    if len(coarse_first) > MAX_READ_LEVELS:
        raise LodgsError(
            f"{folder} has {len(coarse_first)} levels.", f"Leave at most {MAX_READ_LEVELS} of them there."
        )
    levels = [Level(i, read_ply(file, warn)) for i, file in enumerate(coarse_first, 1)]
    return Bundle("", levels, meta=read_header(coarse_first[-1]).meta)


def _check(bundle: Bundle) -> None:
    numbers = [level.number for level in bundle.levels]
    if not numbers or numbers != sorted(set(numbers)):
        raise ValueError(f"a bundle needs levels in ascending number, not {numbers}")
    degrees = {level.sh_degree for level in bundle.levels}
    if len(degrees) > 1:
        raise LodgsError(
            f"The levels have spherical harmonics of different degrees {sorted(degrees)}.",
            "Give all levels one degree, or export each level as a plain PLY.",
        )


def _head(bundle: Bundle, **further) -> dict:
    return {
        "v": FORMAT_VERSION, "method": bundle.method, "rule": bundle.rule, "facts": bundle.facts,
        "controls": bundle.controls, "cumulative": bundle.cumulative,
        "sh": bundle.levels[0].sh_degree, **further,
    }  # fmt: skip


def _level_line(lod: int, level: Level) -> dict:
    line = {"level": level.number, "lod": lod, "count": len(level.rows)}
    return line | {"facts": level.facts} if level.facts else line


def _table_elements(bundle: Bundle) -> list[Element]:
    return [Element.from_columns(f"lod_{name}", columns) for name, columns in bundle.tables.items()]


def _table_lines(bundle: Bundle) -> list[dict]:
    return [{"table": name, "element": f"lod_{name}"} for name in bundle.tables]


def _read_tables(lines: list[dict], elements: dict[str, np.ndarray]) -> dict[str, Columns]:
    """The tables that a header or a manifest names, taken out of the elements; raises what a contradiction
    raises."""
    tables = {}
    for line in lines:
        name = _of_kind(line["table"], str, "table")
        if line["element"] != f"lod_{name}":
            raise ValueError(f"the table {quote(name)} is in another element")
        rows = elements.pop(line["element"])
        tables[name] = {column: np.array(rows[column]) for column in rows.dtype.names or ()}
    return tables


def _parse(comments: list[str], path: str | Path) -> tuple[Bundle | None, list[dict]]:
    """What a PLY's comments say: a bundle without splats, and line by line; None where it is no bundle."""
    ours = [comment[len(_TAG) :] for comment in comments if comment.startswith(_TAG)]
    if not ours:
        return None, []
    try:
        head, *lines = [parse_json(text, f"A comment of {path}") for text in ours]
        meta = next((line["meta"] for line in lines if "meta" in line), {})
        return _bundle(head, [line for line in lines if "level" in line], meta, path), lines
    except _CONTRADICTIONS as error:
        raise _contradiction(path, error) from error


def _bundle(head: dict, lines: list[dict], meta: dict, path: str | Path) -> Bundle:
    """A bundle without splats, of what a header or a manifest says; raises what a contradiction raises."""
    version = _whole(head["v"], "v")
    if version > FORMAT_VERSION:
        raise LodgsError(f"{path} is a bundle of the newer version {version}.", "Update LODGS to read it.")
    if version < FORMAT_VERSION:
        raise ValueError(f"version {version} is not supported")
    _of_kind(meta, dict, "meta")
    for name, shape in META_SHAPES.items():
        if name in meta:
            values = np.asarray(meta[name])
            if (
                values.shape != shape
                or values.dtype.kind not in "if"
                or (np.abs(values) > MAX_COORDINATE).any()
            ):
                raise ValueError(f"{name} is not {shape} numbers")
    _of_kind(meta.get("antialias", False), bool, "antialias")
    if not 1 <= len(_of_kind(lines, list, "levels")) <= MAX_READ_LEVELS:
        raise ValueError(f"{len(lines)} levels")
    for line in lines:
        _whole(line["count"], "count")
        if not 1 <= _whole(line["level"], "level") < 2**15:
            raise ValueError(f"{line['level']} is no level's number")
    controls = _of_kind(head["controls"], dict, "controls")
    # earlier exports from Blender have boxes to tick as true and false
    controls = {name: int(value) if isinstance(value, bool) else value for name, value in controls.items()}
    levels = [Level(line["level"], NO_SPLATS, _numbers(line.get("facts", {}))) for line in lines]
    levels.sort(key=lambda level: level.number)
    if len({level.number for level in levels}) < len(levels):
        raise ValueError("a level is there twice")
    return Bundle(
        _of_kind(head["method"], str, "method"),
        levels,
        _of_kind(head["rule"], str, "rule"),
        _numbers(head["facts"]),
        _numbers(controls),
        _of_kind(head["cumulative"], bool, "cumulative"),
        meta,
    )


def _of_kind(value: Kind, kind: type[Kind], name: str) -> Kind:
    """The value, or a TypeError where it is of another kind."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} = {quote(value)} is no {kind.__name__}")
    return value


def _whole(value: int, name: str) -> int:
    """The value, or an error where it is no count."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{name} = {quote(value)} is no whole number")
    return value


def _numbers(values: dict) -> dict[str, float]:
    """Facts as they are; ValueError or TypeError where one is no number that single precision holds."""
    for name, value in _of_kind(values, dict, "facts").items():
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > _LARGEST_FACT:
            raise ValueError(f"{name} = {quote(value)} is no such number")
    return dict(values)


def _contradiction(path: str | Path, error: Exception) -> LodgsError:
    return LodgsError(
        f"{path} describes its levels in a way that cannot be followed "
        f"({type(error).__name__}: {str(error)[:300]}).",
        "Another program may have changed it; export it again.",
    )


def bounding_box(sets: Sequence[SplatRows]) -> list[list[float]]:
    """Smallest and largest x, y, z of the means that are numbers, of all sets of splats together."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in sets:
        for begin in range(0, len(rows), BATCH_ROWS):
            means = rows.select(slice(begin, begin + BATCH_ROWS)).means
            means = means[np.isfinite(means).all(axis=1)]
            low = np.minimum(low, means.min(axis=0, initial=np.inf))
            high = np.maximum(high, means.max(axis=0, initial=-np.inf))
    return [low.tolist(), high.tolist()] if (low <= high).all() else [[0.0] * 3] * 2


def _comment(facts: dict) -> str:
    text = json.dumps(facts, separators=(",", ":"), default=json_default, allow_nan=False)
    for word in _FORBIDDEN:  # such words only occur inside JSON strings, where an escape means the same
        text = text.replace(word, f"{word[:-1]}\\u{ord(word[-1]):04x}")
    return _TAG + text


def json_default(value):
    """A numpy scalar or array as json knows it: its ``default``."""
    return value.tolist()
