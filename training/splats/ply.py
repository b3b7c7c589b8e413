"""Splats as PLY files: the layout of the original 3DGS, and every dialect of it on reading.

Columns of ``vertex``, in this order, all float: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (all red
coefficients first, then green, then blue), opacity, scale_0..2, rot_0..3 (Kerbl et al. 2023, reference code).
"""

from __future__ import annotations

import io
import mmap
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..documents import open_file
from ..errors import LodgsError
from ..files import atomic_write
from .dialects import Warn, drawable_3dgs, ignore, reject_unsupported
from .gaussians import SplatRows, Splats

MAX_HEADER_BYTES, MAX_COLUMNS = 1 << 20, 1000
"""Most bytes of a header, and most columns of all elements; ours have 70 columns a level."""
NORMALS = ("nx", "ny", "nz")
# PLY names its types as C does; viewers know no others.
_TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
# Rows are moved between a file's records and our columns in blocks that stay in the processor's cache.
_BLOCK = 4096
BATCH_ROWS = 1 << 15
"""Rows that are in memory at a time, of splats that are not."""

Columns = dict[str, np.ndarray]


class ElementPart(NamedTuple):
    """Some rows of an element: how many, and what gives the columns of a range of them."""

    count: int
    columns: Callable[[slice], Columns]


@dataclass
class Element:
    """One element of a PLY: rows of named columns, given in parts that follow one another."""

    name: str
    parts: Sequence[ElementPart]

    @classmethod
    def of(cls, name: str, columns: Columns) -> Element:
        """The element of columns (N,) in memory."""
        count = len(next(iter(columns.values())))
        return cls(
            name, [ElementPart(count, lambda some: {key: rows[some] for key, rows in columns.items()})]
        )

    @classmethod
    def of_splats(cls, name: str, sets: Sequence[SplatRows], columns: Callable[[Splats], Columns]) -> Element:
        """The element of columns of splats, of one set after the other."""
        return cls(
            name,
            [ElementPart(len(rows), lambda some, rows=rows: columns(rows.select(some))) for rows in sets],
        )

    @cached_property
    def dtype(self) -> np.dtype:
        """One row as the file holds it: packed and little-endian."""
        return _row_of(self.parts[0].columns(slice(0, 0)))

    @property
    def count(self) -> int:
        """Rows of the element, of all its parts."""
        return sum(part.count for part in self.parts)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self.count * self.dtype.itemsize


def read_ply(path: str | Path, warn: Warn = ignore) -> Splats:
    """Read the element ``vertex`` of any 3DGS PLY.

    Ascii, little- or big-endian, SH degree 0 to 4, columns in any order and of any scalar type. Missing
    normals are fine; normals that are all zero, as 3DGS writes them, are dropped. Columns of dialects are
    worked into the others (`dialects.as_3dgs`); every other column survives in ``extras`` with its name and
    type. A bundle reads as its ``vertex``, the finest level by default.

    Args:
        warn: receives a sentence for each thing that was left out or is shown otherwise than by its maker.

    Raises:
        LodgsError: not a PLY, cut short, without the columns of splats, or of a dialect that cannot be read.
    """
    elements, _ = read_elements(path)
    return drawable_3dgs(splats_from_rows(elements["vertex"], path), path, warn)


def write_ply(path: str | Path, splats: SplatRows, comments: Sequence[str] = ()) -> None:
    """Write splats as one binary little-endian ``vertex``, extras behind the 3DGS columns.

    Args:
        splats: in memory, or where they are read a few at a time.
        comments: for the header, such as `dialects.comments_of` a bundle's meta.

    Raises:
        LodgsError: the file cannot be written, or an extra has a name or a type that PLY does not know.
    """
    write_elements(path, [Element.of_splats("vertex", [splats], all_columns)], comments)


def splat_columns(splats: Splats) -> Columns:
    """The 3DGS columns in their order, as views (N,) into the arrays of ``splats``."""
    zero = np.broadcast_to(np.float32(0), len(splats))
    rest = splats.sh.shape[1] - 1
    return {
        **{name: splats.means[:, i] for i, name in enumerate("xyz")},
        **{name: splats.extras.get(name, zero) for name in NORMALS},
        **{f"f_dc_{i}": splats.sh[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": splats.sh[:, 1 + i % rest, i // rest] for i in range(3 * rest)},
        "opacity": splats.opacity_logits,
        **{f"scale_{i}": splats.log_scales[:, i] for i in range(3)},
        **{f"rot_{i}": splats.quats[:, i] for i in range(4)},
    }


def all_columns(splats: Splats) -> Columns:
    """The 3DGS columns, and the extras."""
    return splat_columns(splats) | extra_columns(splats)


def extra_columns(splats: Splats) -> Columns:
    """The extras that are columns of their own (normals have their place in the 3DGS layout)."""
    return {name: column for name, column in splats.extras.items() if name not in NORMALS}


def to_records(columns: Columns) -> np.ndarray:
    """Columns (N,) as rows of a file, (N,) structured: packed and little-endian."""
    records = np.empty(len(next(iter(columns.values()))), _row_of(columns))
    for block in _blocks(len(records)):
        for name, column in columns.items():
            records[name][block] = column[block]
    return records


def splats_from_rows(rows: np.ndarray, path: str | Path) -> Splats:
    """Splats from the structured rows of an element that has the 3DGS columns; ``path`` is for the message.

    Raises:
        LodgsError: columns are missing, or the number of f_rest columns fits no SH degree.
    """
    names = rows.dtype.names or ()
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    degree = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}.get(rest)
    if degree is None:
        raise LodgsError(
            f"{path} has {rest} f_rest columns, which fits no degree of spherical harmonics.",
            "0, 9, 24, 45 or 72 belong to degree 0 to 4; export the splats again.",
        )
    splats = _empty_splats(len(rows), degree)
    columns = {name: column for name, column in splat_columns(splats).items() if name not in NORMALS}
    missing = [name for name in columns if name not in names]
    if missing:
        raise LodgsError(
            f"{path} is not a PLY of Gaussian splats: it has no {', '.join(missing)}.",
            "Choose a PLY that a 3DGS trainer wrote; other point clouds and meshes have no splats.",
        )
    extras = {
        name: np.empty(len(rows), rows.dtype[name].newbyteorder("=")) for name in names if name not in columns
    }
    moves = [(column, np.asarray(rows[name])) for name, column in (columns | extras).items()]
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite or no number is left out later
        for block in _blocks(len(rows)):
            for column, source in moves:
                column[block] = source[block]
        meant = any(extras[name].any() for name in NORMALS if name in extras)
    if not meant:
        extras = {name: column for name, column in extras.items() if name not in NORMALS}
    splats.extras = extras
    return splats


def read_elements(path: str | Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Elements of a PLY as structured rows (memory-mapped when binary), and its comments in order.

    Elements without columns are passed over. So is everything from the first list on, such as a mesh's
    faces: where a list ends stands in its rows alone, and no splats are made of any.

    Raises:
        LodgsError: not a PLY, no ``vertex`` of splats, a dialect that cannot be read, or cut short.
    """
    path = Path(path)
    with open_file(path) as file:
        header, counts = _read_header(file, path)
        begin, size = file.tell(), os.fstat(file.fileno()).st_size
        found: list[tuple[str, np.dtype, int]] = []
        for element, count in zip(header.elements, counts, strict=True):
            if count and _has_lists(element):
                break
            if element.properties:
                kinds = [(column.name, column.dtype(header.byte_order)) for column in element.properties]
                found.append((element.name, np.dtype(kinds), count))
        if "vertex" not in (name for name, _, _ in found):
            raise LodgsError(f"{path} has lists before its vertices.", "Choose a .ply of Gaussian splats.")
        if header.text:
            return _read_text(file, found, size - begin, path), _comments(header)
        promised = begin + sum(count * row.itemsize for _, row, count in found)
        if size < promised:
            raise LodgsError(
                f"{path} is cut short: {promised - size} of its {promised} bytes are missing.",
                "Export or copy it again.",
            )
        elements: dict[str, np.ndarray] = {}
        for name, row, count in found:
            mapped = np.memmap(file, row, "c", begin, (count,)) if count else np.empty(0, row)
            elements[name] = mapped
            begin += count * row.itemsize
    return elements, _comments(header)


def release_pages(rows: np.ndarray) -> None:
    """Gives back the pages of a mapped file that have been read, which count as the process's own memory."""
    base = rows
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
        base.madvise(mmap.MADV_DONTNEED)


def read_comments(path: str | Path) -> list[str]:
    """The comments of a PLY of splats, in the time that its header takes.

    Raises:
        LodgsError: not a PLY, no ``vertex`` of splats, or a dialect that cannot be read.
    """
    with open_file(path) as file:
        return _comments(_read_header(file, Path(path))[0])


def write_elements(path: str | Path, elements: Iterable[Element], comments: Sequence[str] = ()) -> None:
    """Write elements as a binary little-endian PLY, whole or not at all.

    The first element stands on line 3 of the header and the comments follow its properties: so every
    viewer that was checked reads it.

    Raises:
        LodgsError: a column's name or type does not exist in PLY, or the file cannot be written.
    """
    elements = list(elements)
    first, *others = [_header_of(element) for element in elements]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *first,
        *(f"comment {comment}" for comment in comments),
    ]
    lines += [line for header in others for line in header] + ["end_header", ""]
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        for element in elements:
            for part in element.parts:
                for some in _blocks(part.count, BATCH_ROWS):
                    file.write(to_records(part.columns(some)).data)


def _row_of(columns: Columns) -> np.dtype:
    return np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])


def _header_of(element: Element) -> list[str]:
    lines = [f"element {element.name} {element.count}"]
    for name, column in element.parts[0].columns(slice(0, 0)).items():
        kind = _TYPES.get(column.dtype.str[1:])
        if kind is None or not re.fullmatch(r"[!-~]+", name):
            raise LodgsError(
                f"The column {name!r} of type {column.dtype} cannot be written as PLY.",
                f"Give it an ASCII name without spaces and one of the types {', '.join(_TYPES.values())}.",
            )
        lines.append(f"property {kind} {name}")
    return lines


def _read_header(file: IO[bytes], path: Path) -> tuple[PlyData, list[int]]:
    """The header of a PLY of splats, with no rows, and the rows that each element should have.

    The file is left where the rows begin.

    Raises:
        LodgsError: as `read_comments`.
    """
    start = file.read(MAX_HEADER_BYTES)
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if begin is None:
        raise LodgsError(f"{path} is not a PLY file.", "Choose a .ply of Gaussian splats.")
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", start)
    if end is None:
        if len(start) == MAX_HEADER_BYTES:
            raise LodgsError(
                f"{path} has a header of more than {MAX_HEADER_BYTES:,} bytes.",
                "Export it again, with less in it.",
            )
        raise LodgsError(f"{path} is cut short: its header does not end.", "Export or copy it again.")
    file.seek(end.end())
    lines = start[: end.end()].decode("ascii", "replace").split(begin[1].decode())
    counts: list[int] = []
    try:
        for place, line in enumerate(lines):
            match line.split():
                case ["element", name, *count]:
                    if len(count) != 1 or not re.fullmatch("[0-9]{1,15}", count[0]):
                        raise ValueError(f"{line[:200]!r} says no number of rows")
                    counts.append(int(count[0]))
                    lines[place] = f"element {name} 0"  # plyfile reads a header only together with rows
        if sum(line.lstrip().startswith("property") for line in lines) > MAX_COLUMNS:
            raise ValueError(f"it has more than {MAX_COLUMNS:,} columns")
        header = PlyData.read(io.BytesIO("\n".join(lines).encode("ascii", "replace")))
    except (PlyParseError, ValueError) as error:
        raise LodgsError(
            f"{path} has a damaged header: {str(error)[:300]}.", "Export or copy it again."
        ) from error
    if "vertex" not in header:
        raise LodgsError(f"{path} has no element vertex.", "Choose a .ply of Gaussian splats.")
    vertex = header["vertex"]
    if _has_lists(vertex):
        raise LodgsError(f"{path} has lists in its vertices.", "Choose a .ply of Gaussian splats.")
    reject_unsupported([column.name for column in vertex.properties], _comments(header), path)
    splats_from_rows(vertex.data, path)
    return header, counts


def _read_text(
    file: IO[bytes], found: list[tuple[str, np.dtype, int]], size: int, path: Path
) -> dict[str, np.ndarray]:
    """The rows of elements (name, row, count) of a PLY in ASCII, which take so many bytes at most."""
    try:
        if (
            sum(count * 2 * len(row.names or ()) for _, row, count in found) > size + 1
        ):  # a digit and a space each
            raise ValueError("it is too short for its rows")
        elements: dict[str, np.ndarray] = {}
        lines = io.TextIOWrapper(file, "ascii", "replace")
        for name, row, count in found:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a file that ends here: its rows are counted
                rows = np.loadtxt(lines, row, comments=None, ndmin=1, max_rows=count) if count else []
            if len(rows) != count:
                raise ValueError(f"{count - len(rows):,} of {count:,} rows of {name} are missing")
            elements[name] = np.asarray(rows, row)
    except (ValueError, OverflowError) as error:
        raise LodgsError(f"{path} is damaged: {str(error)[:300]}.", "Export or copy it again.") from error
    return elements


def _has_lists(element: PlyElement) -> bool:
    return any(isinstance(column, PlyListProperty) for column in element.properties)


def _comments(data: PlyData) -> list[str]:
    return data.comments + [comment for element in data.elements for comment in element.comments]


def _empty_splats(count: int, degree: int) -> Splats:
    return Splats(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        log_scales=np.empty((count, 3), np.float32),
        opacity_logits=np.empty(count, np.float32),
        sh=np.empty((count, (degree + 1) ** 2, 3), np.float32),
    )


def _blocks(count: int, size: int = _BLOCK) -> Iterator[slice]:
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))
