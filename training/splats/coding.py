"""Compressed splats in the elements of a PLY: quantised columns, and a codebook of spherical harmonics.

``docs/reference/bundle.md`` specifies the format. Readers decode batches of rows to the columns of 3DGS.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import asinh
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import LodgsError
from .gaussians import Splats

CODEBOOK, RANGES = "lod_codebook", "lod_ranges"
"""Elements with the sets of SH coefficients that splats share, and with the ranges of all coded columns."""
MAX_CODES = 1 << 16
"""Maximum number of sets of coefficients in a codebook."""
MAX_LOGIT, MIN_LOG_SCALE = 12.0, -60.0
"""Bounds of coded opacity logits (opacities differ by less than 1e-5) and log-scales."""
_PREFIX = "q_"
_INDEX = "q_sh"
_ROTATION = ("rot_1", "rot_2", "rot_3")
_BITS = dict.fromkeys("xyz", 16) | dict.fromkeys(
    ("f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", *_ROTATION), 8
)
_RANGE = ("low", "high", "center", "width")


class Codebook(NamedTuple):
    """Sets of SH coefficients above degree 0 that the splats of all levels share.

    Attributes:
        sets: (K, C, 3) float32, K at most MAX_CODES; C = 0 for splats of degree 0.
        codes: row in ``sets`` of each splat (N,), by level number.
    """

    sets: np.ndarray
    codes: Mapping[int, np.ndarray]


class Range(NamedTuple):
    """Numbers that map codes to values.

    value = center + width · sinh(u), limited to [low, high], where u rises evenly from low's to high's.
    """

    low: float
    high: float
    center: float
    width: float

    @classmethod
    def of(cls, values: np.ndarray) -> Range:
        """Fit a range to values (N,). Steps are finest around the median, within the median deviation."""
        if not len(values):
            return cls(0, 0, 0, 1)
        low, high, center = values.min(), values.max(), np.median(values)
        width = max(np.median(np.abs(values - center)), 1e-6 * (high - low), 1e-30)
        return cls(*(float(np.float32(number)) for number in (low, high, center, width)))

    def table(self, bits: int) -> np.ndarray:
        """Return the value of each code, (2**bits,) float32."""
        first, last = self._ends()
        steps = np.linspace(first, last, 1 << bits)
        return (self.center + self.width * np.sinh(steps)).clip(self.low, self.high).astype(np.float32)

    def encode(self, values: np.ndarray, bits: int) -> np.ndarray:
        """Return the codes (N,) of values (N,), uint8 or uint16."""
        first, last = self._ends()
        steps = np.arcsinh((values.astype(np.float64) - self.center) / self.width)
        largest = (1 << bits) - 1
        codes = (steps - first) * (largest / max(last - first, 1e-30))
        return codes.round().clip(0, largest).astype(f"u{bits // 8}")

    def _ends(self) -> tuple[float, float]:
        low, high = (asinh((end - self.center) / self.width) for end in (self.low, self.high))
        return low, high


def code_elements(
    splats: Mapping[str, tuple[Splats, np.ndarray]], sets: np.ndarray
) -> dict[str, dict[str, np.ndarray]]:
    """Code splats as the columns of PLY elements.

    Args:
        splats: splats of each element, with their rows (N,) in ``sets``, by its name.
        sets: as in :class:`Codebook`.

    Returns:
        Columns of the elements by name: those of ``splats``, then CODEBOOK unless C = 0, and RANGES.
    """
    elements, ranges = {}, []

    def code(columns: Mapping[str, np.ndarray], bits: Mapping[str, int]) -> dict[str, np.ndarray]:
        coded = {}
        for name, values in columns.items():
            ranges.append(Range.of(values))
            coded[_PREFIX + name] = ranges[-1].encode(values, bits[name])
        return coded

    rest = sets.transpose(0, 2, 1).reshape(len(sets), sets.shape[1] * 3)
    for name, (rows, codes) in splats.items():
        elements[name] = code(_plain_columns(rows), _BITS)
        if rest.shape[1]:
            elements[name][_INDEX] = codes.astype(np.uint16)
    if rest.shape[1]:
        columns = {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
        elements[CODEBOOK] = code(columns, dict.fromkeys(columns, 8))
    table = np.array(ranges, np.float32)
    elements[RANGES] = {name: table[:, i] for i, name in enumerate(_RANGE)}
    return elements


def _plain_columns(splats: Splats) -> dict[str, np.ndarray]:
    """Return the columns to quantise. Rotations are modified Rodrigues parameters, q_xyz / (1 + q_w)."""
    quats = splats.quats.astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    quats *= np.where(quats[:, :1] < 0, -1, 1)
    vectors = (quats[:, 1:] / (1 + quats[:, :1])).astype(np.float32)
    return {
        **dict(zip("xyz", splats.means.T, strict=True)),
        **{f"f_dc_{i}": splats.sh[:, 0, i] for i in range(3)},
        "opacity": splats.opacity_logits.clip(-MAX_LOGIT, MAX_LOGIT),
        **{f"scale_{i}": splats.log_scales[:, i].clip(MIN_LOG_SCALE) for i in range(3)},
        **dict(zip(_ROTATION, vectors.T, strict=True)),
    }


class CodedRows:
    """Rows of an element with coded splats, which decode to structured rows with the columns of 3DGS.

    Slices stay coded. ``numpy.asarray`` decodes.

    Attributes:
        codes: structured rows of the file.
        dtype: type of the decoded rows.
    """

    def __init__(
        self, codes: np.ndarray, tables: Mapping[str, np.ndarray], rest: np.ndarray, path: str | Path
    ) -> None:
        self.codes = codes
        self._tables, self._rest, self._path = tables, rest, path
        names = [*(name for name in _BITS if name not in _ROTATION), "rot_0", *_ROTATION]
        names += [f"f_rest_{i}" for i in range(rest.shape[1])]
        self.dtype = np.dtype([(name, "<f4") for name in names])

    @property
    def description(self) -> str:
        """Size of the codebook and of a row, as text."""
        return f"{self.codes.dtype.itemsize} bytes per splat, codebook of {len(self._rest):,} sets"

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, index):
        if isinstance(index, str):
            return np.asarray(self)[index]
        return CodedRows(self.codes[index], self._tables, self._rest, self._path)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        rows = np.empty(len(self), self.dtype)
        for name, table in self._tables.items():
            rows[name] = table[self.codes[_PREFIX + name]]
        vectors = np.stack([rows[name] for name in _ROTATION])
        squares = np.square(vectors).sum(axis=0)
        rows["rot_0"] = (1 - squares) / (1 + squares)
        for name, values in zip(_ROTATION, vectors, strict=True):
            rows[name] = 2 * values / (1 + squares)
        if self._rest.shape[1] and len(self):
            codes = np.asarray(self.codes[_INDEX])
            if codes.max() >= len(self._rest):
                raise LodgsError(
                    f"Cannot read {self._path}: a splat has set {codes.max()} of a codebook with "
                    f"{len(self._rest)}.",
                    "Export or copy it again.",
                )
            for i in range(self._rest.shape[1]):
                rows[f"f_rest_{i}"] = self._rest[codes, i]
        return rows


def is_coded(rows: np.ndarray) -> bool:
    """Return True if rows have the columns of coded splats."""
    return _PREFIX + "x" in (rows.dtype.names or ())


def declared_rows(vertex: np.ndarray, codebook: np.ndarray | None, path: str | Path) -> CodedRows:
    """Return no rows with the columns that a header declares.

    Raises:
        LodgsError: a coded column is missing, or there is an unknown one.
    """
    rest = 0 if codebook is None else len(codebook.dtype.names or ())
    expected = {_PREFIX + name: f"u{bits // 8}" for name, bits in _BITS.items()}
    if rest:
        expected[_INDEX] = "u2"
    if _types(vertex) != expected:
        raise _inconsistent(path, "it has other columns of compressed splats than this version")
    tables = {name: np.zeros(1 << bits, np.float32) for name, bits in _BITS.items()}
    return CodedRows(vertex[:0], tables, np.zeros((0, rest), np.float32), path)


def decode_elements(elements: dict[str, np.ndarray], path: str | Path) -> dict[str, np.ndarray]:
    """Replace the coded elements of a file by rows that decode on access; remove CODEBOOK and RANGES.

    Raises:
        LodgsError: the elements contradict each other.
    """
    coded = [name for name, rows in elements.items() if is_coded(rows)]
    if not coded:
        return elements
    remaining = dict(elements)
    codebook, table = remaining.pop(CODEBOOK, None), remaining.pop(RANGES, None)
    for name in coded:
        declared_rows(elements[name], codebook, path)
    rest = () if codebook is None else codebook.dtype.names or ()
    count = len(coded) * len(_BITS) + len(rest)
    if table is None or _types(table) != dict.fromkeys(_RANGE, "f4") or len(table) != count:
        raise _inconsistent(path, f"it should have {count} ranges of its compressed columns")
    ranges = [Range(*row) for row in np.asarray(table).tolist()]
    low, high, _, width = numbers = np.array(ranges).T
    if not (np.isfinite(numbers).all() and (low <= high).all() and (width > 0).all()):
        raise _inconsistent(path, "a range of its compressed columns is invalid")
    shared = np.zeros((0, len(rest)), np.float32)
    if codebook is not None:
        if len(codebook) > MAX_CODES or set(_types(codebook).values()) != {"u1"}:
            raise _inconsistent(path, f"its codebook is not one of up to {MAX_CODES} sets of bytes")
        tables = [span.table(8) for span in ranges[len(ranges) - len(rest) :]]
        shared = np.stack([column[codebook[name]] for column, name in zip(tables, rest, strict=True)], axis=1)
    for i, name in enumerate(coded):
        spans = ranges[i * len(_BITS) : (i + 1) * len(_BITS)]
        tables = {column: span.table(bits) for (column, bits), span in zip(_BITS.items(), spans, strict=True)}
        remaining[name] = CodedRows(elements[name], tables, shared, path)  # type: ignore[assignment]
    return remaining


def _types(rows: np.ndarray) -> dict[str, str]:
    """Return the types of columns by name, without their byte order."""
    return {name: rows.dtype[name].str[1:] for name in rows.dtype.names or ()}


def _inconsistent(path: str | Path, reason: str) -> LodgsError:
    return LodgsError(f"Cannot read {path}: {reason}.", "Export or copy it again.")
