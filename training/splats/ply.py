"""Splats as PLY files: writes the original 3DGS layout, and reads all supported dialects.

The columns of ``vertex``, in this order, all float: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (all red
coefficients first, then green, then blue), opacity, scale_0..2, rot_0..3 (Kerbl et al. 2023, reference code).
"""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..documents import damage_error, has_decimal_commas, open_text, read_lines
from ..errors import LodgsError
from ..files import atomic_write
from .batches import BATCH_ROWS, batch_slices
from .coding import CODEBOOK, CodedRows, declared_rows, decode_elements, is_coded
from .colors import color_names, full_intensity
from .content import check_name
from .dialects import Warn, drawable_3dgs, ignore, reject_unsupported
from .gaussians import SH_C0, SplatRows, Splats
from .mapped_rows import release_pages, require_size
from .origin import NO_ORIGIN

MAX_HEADER_BYTES = 1 << 20
"""Maximum length of a header."""
MAX_COLUMNS = 1000
"""Maximum number of columns of all elements together; ours have 70 per level."""
_MAX_LINE = 1 << 20
NORMALS = ("nx", "ny", "nz")
# PLY's type names, from C. Viewers support no others.
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
# Rows are converted in blocks that fit in the processor's cache.
_BLOCK = 4096
_F_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_CLOUDCOMPARE = re.compile(r"scalar_((?:f_dc|f_rest|scale|rot)_\d+|opacity)")
"""Columns of splats that CloudCompare has saved."""
_WINDOWS_NAN = re.compile(r"-?(nan\(\w+\)|1\.#(IND|[QS]NAN)0*)", re.I)
"""NaN in text files of Windows programs."""
_FLAT = np.float32(np.log(1e-3))
"""Logarithm of the thickness of flat splats, relative to the smaller of their other sizes."""

Columns = dict[str, np.ndarray]


class ElementPart(NamedTuple):
    """Rows of an element: their number, and a function that returns the columns of a range."""

    count: int
    columns: Callable[[slice], Columns]


@dataclass
class Element:
    """One element of a PLY: rows of named columns, in consecutive parts."""

    name: str
    parts: Sequence[ElementPart]

    @classmethod
    def from_columns(cls, name: str, columns: Columns) -> Element:
        """Create an element of columns (N,) in memory."""
        count = len(next(iter(columns.values())))
        return cls(
            name, [ElementPart(count, lambda index: {key: rows[index] for key, rows in columns.items()})]
        )

    @classmethod
    def from_splats(
        cls, name: str, sets: Sequence[SplatRows], columns: Callable[[Splats], Columns]
    ) -> Element:
        """Create an element of columns of splats, one set after the other."""
        return cls(
            name,
            [ElementPart(len(rows), lambda index, rows=rows: columns(rows.select(index))) for rows in sets],
        )

    @cached_property
    def dtype(self) -> np.dtype:
        """Type of one row in the file: packed and little-endian."""
        return _row_dtype(self.parts[0].columns(slice(0, 0)))

    @property
    def count(self) -> int:
        """Number of rows of all parts."""
        return sum(part.count for part in self.parts)

    @property
    def size(self) -> int:
        """Size in the file in bytes."""
        return self.count * self.dtype.itemsize


def read_ply(path: str | Path, warn: Warn = ignore, origin: np.ndarray = NO_ORIGIN) -> Splats:
    """Read the element ``vertex`` of any 3DGS PLY.

    ASCII, little- and big-endian files of SH degree 0 to 4 are supported, with columns in any order and of
    any scalar type. Normals may be missing; all-zero normals, which 3DGS writes, are dropped. Columns of
    dialects are converted (`dialects.drawable_3dgs`). Every other column survives in ``extras`` with its
    name and type. For a bundle, the result is its ``vertex``, by default the finest level.

    Args:
        warn: receives one sentence for each omission or changed look, see `dialects.Warn`.
        origin: (3,) local origin to subtract from the positions.

    Raises:
        LodgsError: the file is not a PLY, is truncated, lacks the columns of splats, or has an unsupported
            dialect.
    """
    elements, _ = read_elements(path)
    return drawable_3dgs(splats_from_rows(elements["vertex"], path, origin), path, warn)


def write_ply(
    path: str | Path, splats: SplatRows, comments: Sequence[str] = (), origin: np.ndarray = NO_ORIGIN
) -> None:
    """Write splats as one binary little-endian ``vertex``, with extras after the 3DGS columns.

    Args:
        splats: splats in memory, or a source that is read in batches.
        comments: header comments, such as those of `dialects.comments_from_meta`.
        origin: (3,) local origin to add to the positions, which are then of type double.

    Raises:
        LodgsError: the file cannot be written, or PLY does not support the name or type of an extra.
    """

    def columns(splats: Splats) -> Columns:
        if not origin.any():
            return all_columns(splats)
        means = splats.means.astype(np.float64) + origin
        return all_columns(splats) | dict(zip("xyz", means.T, strict=True))

    write_elements(path, [Element.from_splats("vertex", [splats], columns)], comments)


def splat_columns(splats: Splats) -> Columns:
    """Return the 3DGS columns in file order, as views (N,) of the arrays of ``splats``."""
    zero = np.broadcast_to(np.float32(0), len(splats))
    rest_count = splats.sh.shape[1] - 1
    return {
        **{name: splats.means[:, i] for i, name in enumerate("xyz")},
        **{name: splats.extras.get(name, zero) for name in NORMALS},
        **{f"f_dc_{i}": splats.sh[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": splats.sh[:, 1 + i % rest_count, i // rest_count] for i in range(3 * rest_count)},
        "opacity": splats.opacity_logits,
        **{f"scale_{i}": splats.log_scales[:, i] for i in range(3)},
        **{f"rot_{i}": splats.quats[:, i] for i in range(4)},
    }


def all_columns(splats: Splats) -> Columns:
    """Return the 3DGS columns and the extras."""
    return splat_columns(splats) | extra_columns(splats)


def extra_columns(splats: Splats) -> Columns:
    """Return the extras except normals, which are part of the 3DGS layout."""
    return {name: column for name, column in splats.extras.items() if name not in NORMALS}


def to_records(columns: Columns) -> np.ndarray:
    """Convert columns (N,) to structured rows (N,) of a file: packed and little-endian."""
    records = np.empty(len(next(iter(columns.values()))), _row_dtype(columns))
    for block in batch_slices(len(records), _BLOCK):
        for name, column in columns.items():
            records[name][block] = column[block]
    return records


def splats_from_rows(
    rows: np.ndarray | CodedRows, path: str | Path, origin: np.ndarray = NO_ORIGIN
) -> Splats:
    """Convert the structured rows of an element with the 3DGS columns to splats.

    Args:
        path: path of the file, for messages.
        origin: (3,) local origin to subtract from the positions.

    Raises:
        LodgsError: columns are missing, the number of f_rest columns fits no SH degree, or another program
            has truncated the file.
    """
    rows = np.asarray(rows)
    names = rows.dtype.names or ()
    splats = _empty_splats(len(rows), _sh_degree(names, path))
    flat = {"scale_2"} - set(names)  # 2D Gaussian Splatting
    columns = {name: part for name, part in splat_columns(splats).items() if name not in {*NORMALS, *flat}}
    missing = [name for name in columns if name not in names]
    colors = color_names(names) if missing == _F_DC else None  # nerfstudio's splats without harmonics
    missing = [] if colors else missing
    if missing:
        raise LodgsError(
            f"Cannot read {path}: it is not a PLY of Gaussian splats: it has no {', '.join(missing)}.",
            "Choose a PLY from a 3DGS trainer; other point clouds and meshes contain no splats.",
        )
    sources = dict(zip(_F_DC, colors, strict=True)) if colors else {}
    full = full_intensity([rows[name] for name in sources.values()]) if sources else 1.0
    extras = {
        name: np.empty(len(rows), rows.dtype[name].newbyteorder("="))
        for name in names
        if name not in columns and name not in sources.values()
    }
    pairs = [
        (column, np.asarray(rows[sources.get(name, name)])) for name, column in (columns | extras).items()
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # infinities and NaN are dropped later
        for block in batch_slices(len(rows), _BLOCK):
            require_size(rows, path)
            for column, source in pairs:
                column[block] = source[block]
            for axis in np.flatnonzero(origin):
                splats.means[block, axis] = rows["xyz"[axis]][block].astype(np.float64) - origin[axis]
            if colors:
                splats.sh[block, 0] = (splats.sh[block, 0] / full - 0.5) / SH_C0
            if block.stop % BATCH_ROWS == 0:
                release_pages(rows)
        if flat:
            splats.log_scales[:, 2] = splats.log_scales[:, :2].min(axis=1) + _FLAT
        has_normals = any(extras[name].any() for name in NORMALS if name in extras)
    if not has_normals:
        extras = {name: column for name, column in extras.items() if name not in NORMALS}
    splats.extras = extras
    return splats


def _sh_degree(names: Sequence[str], path: str | Path) -> int:
    """Return the SH degree of columns; raise LodgsError if their number fits none."""
    rest_count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    degree = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}.get(rest_count)
    if degree is None:
        raise LodgsError(
            f"Cannot read {path}: its {rest_count} f_rest columns fit no degree of spherical harmonics.",
            "Export the splats again; degree 0 to 4 have 0, 9, 24, 45 or 72 such columns.",
        )
    return degree


def read_elements(path: str | Path, splats: bool = True) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the elements of a PLY as structured rows (memory-mapped if binary), and its comments in order.

    Elements without columns are skipped. So is everything from the first list on, such as a mesh's faces:
    only reading all of its rows would show where a list ends, and lists describe no splats.

    Args:
        splats: require a ``vertex`` of splats in a supported dialect, not only any ``vertex``.

    Raises:
        LodgsError: the file is not such a PLY, or is truncated.
    """
    path = Path(path)
    with open_text(path) as file:
        header, counts = _read_header(file, path, splats)
        begin = file.tell()
        size = os.fstat(file.fileno()).st_size
        layout: list[tuple[str, np.dtype, int]] = []
        for element, count in zip(header.elements, counts, strict=True):
            if count and _has_lists(element):
                break
            if element.properties:
                kinds = [(column.name, column.dtype(header.byte_order)) for column in element.properties]
                layout.append((element.name, np.dtype(kinds), count))
        if "vertex" not in (name for name, _, _ in layout):
            raise LodgsError(
                f"Cannot read {path}: it has lists before its vertices.",
                "Export it again with the vertices first.",
            )
        if header.text:
            return decode_elements(_read_text(file, layout, size - begin, path), path), _comments(header)
        expected = begin + sum(count * row.itemsize for _, row, count in layout)
        if size < expected:
            raise LodgsError(
                f"Cannot read {path}: it is truncated, {expected - size} of {expected} bytes are missing.",
                "Export or copy it again.",
            )
        elements: dict[str, np.ndarray] = {}
        for name, row, count in layout:
            mapped = np.memmap(file, row, "c", begin, (count,)) if count else np.empty(0, row)
            elements[name] = mapped
            begin += count * row.itemsize
    return decode_elements(elements, path), _comments(header)


def read_comments(path: str | Path) -> list[str]:
    """Read the comments of a PLY of splats, from its header alone.

    Raises:
        LodgsError: the file is not a PLY, or has no ``vertex`` of splats or an unsupported dialect.
    """
    with open_text(path) as file:
        return _comments(_read_header(file, Path(path))[0])


def write_elements(path: str | Path, elements: Iterable[Element], comments: Sequence[str] = ()) -> None:
    """Write elements as a binary little-endian PLY, atomically.

    The first element is on line 3 of the header, and the comments follow its properties: all tested viewers
    read this order.

    Raises:
        LodgsError: PLY does not support a column's name or type, or the file cannot be written.
    """
    elements = list(elements)
    first, *further = [_header_lines(element) for element in elements]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *first,
        *(f"comment {comment}" for comment in comments),
    ]
    lines += [line for header in further for line in header] + ["end_header", ""]
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        for element in elements:
            for part in element.parts:
                for batch in batch_slices(part.count):
                    file.write(to_records(part.columns(batch)).data)


def _row_dtype(columns: Columns) -> np.dtype:
    return np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])


def _header_lines(element: Element) -> list[str]:
    lines = [f"element {element.name} {element.count}"]
    for name, column in element.parts[0].columns(slice(0, 0)).items():
        kind = _TYPES.get(column.dtype.str[1:])
        if kind is None or not re.fullmatch(r"[!-~]+", name):
            raise LodgsError(
                f"Cannot write column {name!r} of type {column.dtype} to a PLY.",
                f"Use an ASCII name without spaces and one of the types {', '.join(_TYPES.values())}.",
            )
        lines.append(f"property {kind} {name}")
    return lines


def _read_header(file: IO[bytes], path: Path, splats: bool = True) -> tuple[PlyData, list[int]]:
    """Read the header of a PLY of splats, and stop at the first row.

    Returns:
        The header with empty elements, and the number of rows of each element.

    Raises:
        LodgsError: as `read_comments`.
    """
    lines = _read_header_lines(file, path)
    counts: list[int] = []
    try:
        for number, line in enumerate(lines):
            match line.split():
                case ["element", name, *count]:
                    if len(count) != 1 or not re.fullmatch("[0-9]{1,15}", count[0]):
                        raise ValueError(f"{line[:200]!r} contains no number of rows")
                    counts.append(int(count[0]))
                    lines[number] = f"element {name} 0"  # plyfile reads a header only together with rows
                case ["property", kind, name] if match := _CLOUDCOMPARE.fullmatch(name):
                    lines[number] = f"property {kind} {match[1]}"
        if sum(line.lstrip().startswith("property") for line in lines) > MAX_COLUMNS:
            raise ValueError(f"it has more than {MAX_COLUMNS:,} columns")
        header = PlyData.read(io.BytesIO("\n".join(lines).encode("ascii", "replace")))
    except (PlyParseError, ValueError) as error:
        raise LodgsError(
            f"Cannot read {path}: its header is corrupt: {str(error)[:300].rstrip('.')}.",
            "Export or copy it again.",
        ) from error
    if "vertex" not in header:
        raise LodgsError(
            f"Cannot read {path}: it has no element vertex.", "Choose a .ply of Gaussian splats."
        )
    vertex = header["vertex"]
    if _has_lists(vertex):
        raise LodgsError(
            f"Cannot read {path}: it has lists in its vertices.", "Choose a .ply of Gaussian splats."
        )
    if splats:
        reject_unsupported([column.name for column in vertex.properties], path)
        rows = vertex.data
        if is_coded(rows):
            rows = declared_rows(rows, header[CODEBOOK].data if CODEBOOK in header else None, path)
        splats_from_rows(rows, path)
    return header, counts


def _foreign_error(path: Path, start: bytes) -> LodgsError:
    """Return the error for a file with the first bytes of another format.

    Raises:
        LodgsError: it is a format of splats, see :func:`content.check_name`.
    """
    if name := check_name(path):
        remedy = f"Convert it: lodgs edit {path.name} --out {path.stem}.ply"
        return LodgsError(f"Cannot read {path}: its format is {name}.", remedy)
    problem, remedy = "it is not a PLY file", "Choose a .ply of Gaussian splats."
    if start.startswith((b"PK\3\4", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!")):
        problem, remedy = "it is not a PLY file but an archive", "Unpack it."
    elif path.suffix.lower() != ".ply":
        remedy = "Convert it to PLY, for example with splat-transform, or choose another file."
    return LodgsError(f"Cannot read {path}: {problem}.", remedy)


def _read_header_lines(file: IO[bytes], path: Path) -> list[str]:
    """Read the lines of a header and leave the file at the first row."""
    start = file.read(MAX_HEADER_BYTES)
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if begin is None:
        raise _foreign_error(path, start)
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", start)
    if end is None:
        if len(start) == MAX_HEADER_BYTES:
            raise LodgsError(
                f"Cannot read {path}: its header exceeds {MAX_HEADER_BYTES:,} bytes.",
                "Export it again with fewer columns and comments.",
            )
        raise LodgsError(
            f"Cannot read {path}: it is truncated, its header has no end.", "Export or copy it again."
        )
    file.seek(end.end())
    lines = re.split("\r\n|\n|\r", start[: end.end()].decode("ascii", "replace"))
    return [*filter(None, map(str.rstrip, lines)), ""]


def _read_text(
    file: IO[bytes], layout: list[tuple[str, np.dtype, int]], size: int, path: Path
) -> dict[str, np.ndarray]:
    """Read the rows of an ASCII PLY.

    Args:
        layout: name, row type and number of rows of each element.
        size: remaining bytes of the file.
    """
    try:
        min_size = sum(
            count * 2 * len(row.names or ()) for _, row, count in layout
        )  # a digit and a space each
        if min_size > size + 1:
            raise ValueError("it is too short for its rows")
        elements: dict[str, np.ndarray] = {}
        text = read_lines(io.TextIOWrapper(file, "ascii", "replace"), _MAX_LINE)
        lines = (_WINDOWS_NAN.sub("nan", line) for line in text)
        for name, row, count in layout:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # numpy warns at the end of a file; the rows are counted below
                rows = np.loadtxt(lines, row, comments=None, ndmin=1, max_rows=count) if count else []
            if len(rows) != count:
                raise ValueError(f"{count - len(rows):,} of {count:,} rows of {name} are missing")
            elements[name] = np.asarray(rows, row)
    except (ValueError, OverflowError) as error:
        if has_decimal_commas(str(error)):
            raise damage_error(path, error, "") from error
        raise LodgsError(
            f"Cannot read {path}: it is corrupt: {str(error)[:300].rstrip('.')}.", "Export or copy it again."
        ) from error
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
