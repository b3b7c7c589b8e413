"""PlayCanvas' compressed PLY: values of splats as fractions of the ranges of their chunk.

Layout: https://blog.playcanvas.com/compressing-gaussian-splats. An element ``chunk`` has the minima and
maxima of 256 splats. An element ``vertex`` has four words per splat: position and logarithmic scales of 11,
10 and 11 bits, rotation of 2, 10, 10 and 10 bits, colour and opacity of 8 bits each. An optional element
``sh`` has one byte per further coefficient.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .dialects import comments_from_meta, meta_from_comments
from .gaussians import SH_C0, SplatRows, Splats
from .mapped_rows import release_pages, require_size
from .morton import spatial_order
from .ply import Element, read_elements, write_elements
from .portable_levels import portable_batches, splats_from_activated
from .quats import join_quats, split_quats
from .sh import coefficient_count
from .splat_format import require_degree

MAX_DEGREE = 3
_CHUNK = 256
"""Splats of a chunk."""
_VECTOR_BITS = 11, 10, 11
_QUAT_BITS = 2, 10, 10, 10
_COLOR_BITS = 8, 8, 8, 8
"""Bits of the parts of a word, highest first."""
_WORDS = "packed_position", "packed_rotation", "packed_scale", "packed_color"
_POSITIONS = "min_x", "min_y", "min_z", "max_x", "max_y", "max_z"
_SCALES = tuple(name.replace("_", "_scale_") for name in _POSITIONS)
_COLORS = "min_r", "min_g", "min_b", "max_r", "max_g", "max_b"
"""Columns of a chunk. Files of older programs have no ranges of colours, which are then 0 to 1."""
_MAX_LOG_SCALE = 20.0
"""Bound of stored logarithms of scales; larger ones would widen the steps of the others."""
_SH_RANGE = 8.0
"""Difference of the largest and the smallest coefficient that a byte stores."""
_COEFFICIENTS = (_SH_RANGE * ((np.arange(256) + 0.5) / 256 - 0.5)).astype(np.float32)
_COEFFICIENTS[[0, -1]] = -_SH_RANGE / 2, _SH_RANGE / 2
"""Coefficient of each byte."""


def write_compressed_ply(path: Path, rows: SplatRows, meta: dict) -> None:
    """Write a compressed PLY, with the meta as comments. Splats are sorted along a curve through space.

    Args:
        rows: splats of SH degree 0 to :data:`MAX_DEGREE`.
        meta: meta of the splats' bundle.

    Raises:
        LodgsError: the SH degree is too high, or the file cannot be written.
    """
    count, degree = len(rows), require_degree(rows, MAX_DEGREE, "compressed PLY")
    values = np.empty((3, count, 3), np.float32)  # positions, logarithms of scales, colours
    words = np.empty((4, count), np.uint32)
    rest = np.empty((count, 3 * (coefficient_count(degree) - 1)), np.uint8)
    alphas = np.empty(count, np.uint32)
    for begin, splats in portable_batches(rows):
        part = slice(begin, begin + len(splats))
        values[:, part] = (
            splats.means,
            splats.log_scales.clip(-_MAX_LOG_SCALE, _MAX_LOG_SCALE),
            0.5 + SH_C0 * splats.sh[:, 0],
        )
        largest, smaller = split_quats(splats.quats)
        words[1, part] = _pack(np.column_stack([largest, np.rint(1023 * smaller)]), _QUAT_BITS)
        alphas[part] = np.rint(255 * splats.opacities)
        coefficients = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats), rest.shape[1])
        rest[part] = np.floor((coefficients / _SH_RANGE + 0.5) * 256).clip(0, 255)
    order = spatial_order(values[0])
    values, words, rest, alphas = values[:, order], words[:, order], rest[order], alphas[order]

    starts, chunks = np.arange(0, count, _CHUNK), np.arange(count) // _CHUNK
    ranges, fractions = {}, []
    for names, part in zip((_POSITIONS, _SCALES, _COLORS), values, strict=True):
        low, high = np.minimum.reduceat(part, starts), np.maximum.reduceat(part, starts)
        ranges |= dict(zip(names, np.concatenate([low, high], axis=1).T, strict=True))
        fractions.append((part - low[chunks]) / np.maximum(high - low, 1e-30)[chunks])
    words[0], words[2] = (_pack(_steps(fractions[i], _VECTOR_BITS), _VECTOR_BITS) for i in (0, 1))
    words[3] = _pack(np.column_stack([_steps(fractions[2], _COLOR_BITS[:3]), alphas]), _COLOR_BITS)

    elements = [
        Element.from_columns("chunk", ranges),
        Element.from_columns("vertex", dict(zip(_WORDS, words, strict=True))),
    ]
    if degree:
        columns = {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
        elements.append(Element.from_columns("sh", columns))
    write_elements(path, elements, comments_from_meta(meta))


def read_compressed_ply(path: Path) -> tuple[CompressedRows, dict]:
    """Return the splats of a compressed PLY, which are read in batches, and their meta.

    Raises:
        LodgsError: the file cannot be read, is damaged, or is another PLY.
    """
    elements, comments = read_elements(path, splats=False)
    return CompressedRows(path, elements), meta_from_comments(comments)


class CompressedRows:
    """Splats of a compressed PLY.

    Args:
        path: path of the file, for messages.
        elements: its elements by name, as structured rows.

    Raises:
        LodgsError: the elements contradict each other.
    """

    def __init__(self, path: Path, elements: dict[str, np.ndarray]) -> None:
        self._path = path
        empty = np.empty(0, [])
        self._chunks, self._words, self._rest = (
            elements.get(name, empty) for name in ("chunk", "vertex", "sh")
        )
        names = [set(rows.dtype.names or ()) for rows in (self._chunks, self._words, self._rest)]
        rest = len(names[2])
        problem = ""
        if not (names[0] >= {*_POSITIONS, *_SCALES} and names[1] >= set(_WORDS)):
            problem = "it lacks columns of a compressed PLY"
        elif not all(self._words.dtype[name].str[1:] == "u4" for name in _WORDS) or not all(
            self._rest.dtype[name] == np.uint8 for name in names[2]
        ):
            problem = "its columns have other types than those of a compressed PLY"
        elif len(self._chunks) * _CHUNK < len(self._words):
            problem = f"{len(self._chunks):,} chunks are too few for {len(self._words):,} splats"
        elif rest and (
            names[2] != {f"f_rest_{i}" for i in range(rest)}
            or rest not in [3 * (coefficient_count(degree) - 1) for degree in range(1, MAX_DEGREE + 1)]
            or len(self._rest) != len(self._words)
        ):
            problem = "its spherical harmonics do not fit its splats"
        if problem:
            raise LodgsError(f"Cannot read {path}: {problem}.", "Export it again.")
        self._coefficients = rest // 3

    def __len__(self) -> int:
        return len(self._words)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,).

        Raises:
            LodgsError: another program has truncated the file.
        """
        for elements in (self._chunks, self._words, self._rest):
            require_size(elements, self._path)
        numbers = np.arange(*index.indices(len(self))) if isinstance(index, slice) else index
        chunks = self._chunks[numbers // _CHUNK]
        rows = self._words[index]
        words = {name: rows[name].astype(np.uint32) for name in _WORDS}
        quats = _unpack(words["packed_rotation"], _QUAT_BITS)
        colors = _unpack(words["packed_color"], _COLOR_BITS) / np.float32(255)
        sh = np.empty((len(rows), 1 + self._coefficients, 3), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # such splats are dropped later
            means, scales = (
                _in_range(chunks, names, _unpack(words[word], _VECTOR_BITS) / _largest(_VECTOR_BITS))
                for names, word in ((_POSITIONS, "packed_position"), (_SCALES, "packed_scale"))
            )
            rgb = colors[:, :3]
            if set(_COLORS) <= set(chunks.dtype.names or ()):
                rgb = _in_range(chunks, _COLORS, rgb)
            sh[:, 0] = (rgb - 0.5) / SH_C0
            scales = np.exp(scales)
        if self._coefficients:
            rest = self._rest[index]
            codes = np.stack([rest[f"f_rest_{i}"] for i in range(3 * self._coefficients)], axis=1)
            sh[:, 1:] = _COEFFICIENTS[codes].reshape(len(rows), 3, self._coefficients).transpose(0, 2, 1)
        for elements in (self._chunks, self._words, self._rest):
            release_pages(elements)
        return splats_from_activated(
            means, join_quats(quats[:, 0], quats[:, 1:] / 1023), scales, colors[:, 3], sh
        )


def _in_range(chunks: np.ndarray, names: tuple[str, ...], fractions: np.ndarray) -> np.ndarray:
    """Return values (M, 3) float32 at fractions (M, 3) of the ranges of chunks (M,)."""
    low, high = (
        np.stack([chunks[name].astype(np.float32) for name in part], axis=1)
        for part in (names[:3], names[3:])
    )
    return (low + (high - low) * fractions).astype(np.float32)


def _largest(bits: tuple[int, ...]) -> np.ndarray:
    """Return the largest code of each part of a word."""
    return (1 << np.array(bits)) - 1


def _steps(fractions: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return the nearest codes (N, parts) of fractions."""
    return np.rint(fractions * _largest(bits))


def _pack(codes: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return words (N,) uint32 of codes (N, parts)."""
    words = np.zeros(len(codes), np.uint32)
    for column, width in zip(codes.T, bits, strict=True):
        words = words << np.uint32(width) | column.astype(np.uint32)
    return words


def _unpack(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return codes (N, parts) uint32 of words (N,)."""
    ends = 32 - np.cumsum(bits)
    return (words[:, None] >> ends.astype(np.uint32)) & _largest(bits).astype(np.uint32)
