"""SPZ, a compressed format of splats: version 2 is written, 2 and 3 are read.

https://github.com/nianticlabs/spz: a gzip stream with a header and one array per attribute. Coordinates stay
as they are; their axes are those of the surrounding file.
"""

from __future__ import annotations

import gzip
import struct
import zlib

import numpy as np

from .gaussians import Splats
from .portable_levels import opacities, splats_from_activated

MAX_DEGREE = 3
_HEADER = struct.Struct("<IIIBBBB")
_MAGIC, _VERSION = 0x5053474E, 2
_FIXED_BITS = 23
"""Bits of a coordinate without its sign."""
_COLOR_SCALE = 0.15
"""Coded change of colour per unit of the coefficient of degree 0."""
_FIRST_BITS, _REST_BITS = 5, 4
"""Bits of the coefficients of degree 1, and of higher degrees."""


def pack_spz(splats: Splats, antialias: bool = False) -> bytes:
    """Return splats as the content of an SPZ file.

    Positions have the largest number of fractional bits that holds all of them.

    Args:
        splats: at least one, of SH degree 3 or lower.
        antialias: they are drawn with Mip-Splatting's filter.
    """
    extent = max(float(np.abs(splats.means).max()), 1e-6)
    bits = int(np.clip(np.floor(_FIXED_BITS - np.log2(extent)), 0, _FIXED_BITS))
    fixed = np.rint(splats.means.astype(np.float64) * 2.0**bits)
    fixed = fixed.clip(1 - 2**_FIXED_BITS, 2**_FIXED_BITS - 1).astype("<i4")
    arrays = (
        fixed.reshape(-1, 1).view(np.uint8)[:, :3],
        _byte(255 * opacities(splats)),
        _byte(255 * (_COLOR_SCALE * splats.sh[:, 0] + 0.5)),
        _byte(16 * (splats.log_scales + 10)),
        _rotation_codes(splats.quats),
        _coefficient_codes(splats.sh[:, 1:]),
    )
    header = _HEADER.pack(_MAGIC, _VERSION, len(splats), splats.sh_degree, bits, int(antialias), 0)
    return gzip.compress(header + b"".join(array.tobytes() for array in arrays), mtime=0)


def unpack_spz(data: bytes, max_splats: int) -> Splats:
    """Return the splats of an SPZ file's content, with the coordinates of the file.

    Raises:
        ValueError: the data are damaged, have another version, or more splats than ``max_splats``.
    """
    try:
        stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
        head = stream.decompress(data, _HEADER.size)
        magic, version, count, degree, bits, _, _ = _HEADER.unpack(head)
        if magic == _MAGIC and version not in (2, 3):
            raise ValueError(f"SPZ version {version} is not supported")
        if magic != _MAGIC or degree > MAX_DEGREE or count > max_splats:
            raise ValueError(f"its SPZ data declare {count:,} splats of SH degree {degree}")
        rest = (degree + 1) ** 2 - 1
        widths = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * rest)
        body = stream.decompress(stream.unconsumed_tail, count * sum(widths) or 1)
    except (zlib.error, struct.error) as error:
        raise ValueError(f"its SPZ data are damaged ({error})") from error
    if len(body) != count * sum(widths):
        raise ValueError(f"its SPZ data are too short for {count:,} splats")
    ends = np.cumsum(np.multiply(widths, count))[:-1]
    positions, alphas, colors, scales, rotations, coefficients = np.split(np.frombuffer(body, np.uint8), ends)
    fixed = np.zeros((3 * count, 4), np.uint8)
    fixed[:, 1:] = positions.reshape(-1, 3)
    means = (fixed.view("<i4").reshape(count, 3) >> 8) * 2.0**-bits
    quats = _rotations(rotations.reshape(count, -1)) if version == 2 else _smallest_three(rotations)
    sh = np.empty((count, rest + 1, 3), np.float32)
    sh[:, 0] = (colors.reshape(count, 3) / 255 - 0.5) / _COLOR_SCALE
    sh[:, 1:] = (coefficients.reshape(count, rest, 3) - 128.0) / 128
    return splats_from_activated(means, quats, np.exp(scales.reshape(count, 3) / 16 - 10), alphas / 255, sh)


def _rotation_codes(quats: np.ndarray) -> np.ndarray:
    """Return the codes (N, 3) uint8 of quats (N, 4), wxyz, that :func:`_rotations` reads."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return _byte(127.5 * np.where(unit[:, :1] < 0, -1, 1) * unit[:, 1:] + 127.5)


def _rotations(codes: np.ndarray) -> np.ndarray:
    """Return quats (N, 4), wxyz, of the codes (N, 3) of x, y and z, with w of at least 0."""
    xyz = codes / 127.5 - 1
    return np.column_stack([np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1), 0)), xyz])


def _smallest_three(codes: np.ndarray) -> np.ndarray:
    """Return quats (N, 4), wxyz, of 32-bit codes: index of the largest value, 10 bits for each other."""
    packed = codes.view("<u4").astype(np.int64)
    largest = packed >> 30
    xyzw = np.zeros((len(packed), 4))
    for index in (3, 2, 1, 0):
        is_stored = largest != index
        value = (packed & 511) / 511 / np.sqrt(2)
        xyzw[:, index] = np.where(is_stored, np.where(packed & 512, -value, value), 0)
        packed = np.where(is_stored, packed >> 10, packed)
    rows = np.arange(len(xyzw))
    xyzw[rows, largest] = np.sqrt(np.maximum(1 - np.square(xyzw).sum(axis=1), 0))
    return xyzw[:, [3, 0, 1, 2]]


def _coefficient_codes(rest: np.ndarray) -> np.ndarray:
    """Return the codes (N, K - 1, 3) uint8 of coefficients, with fewer bits than a byte has."""
    buckets = np.full((rest.shape[1], 1), 1 << (8 - _REST_BITS))
    buckets[:3] = 1 << (8 - _FIRST_BITS)
    codes = np.rint(128 * rest + 128)
    return ((codes + buckets // 2) // buckets * buckets).clip(0, 255).astype(np.uint8)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)
