"""SPZ, Niantic's compressed format of splats. Version 3 is written (2 inside glTF), versions 1 to 4 are read.

Specification: https://github.com/nianticlabs/spz. A header and one array per attribute; version 4 compresses
each array with Zstandard, the others all of them with gzip. By the specification the axes are right, up and
back (RUB). A file of its own therefore has y and z of 3DGS files, which point down and forward (RDF), with
opposite signs. Inside glTF, the axes are those of the surrounding file.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from ..documents import open_file
from ..errors import LodgsError
from ..files import atomic_write
from .gaussians import SplatRows, Splats
from .portable_levels import portable_batches, splats_from_activated
from .sh import MAX_DEGREE, basis, coefficient_count
from .similarity import Similarity
from .splat_format import require_degree

MAX_WRITTEN_DEGREE = 3
"""Highest degree that all readers know; version 3 and later store 4."""
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, splats, SH degree, fractional bits, flags, reserved byte."""
_HEADER_4 = struct.Struct("<IIIBBBBI12x")
"""Header of version 4, with the number of arrays and the offset of their table in place of the byte."""
_ENTRY_4 = struct.Struct("<QQ")
"""Compressed and uncompressed bytes of an array of version 4."""
_ANTIALIASED, _EXTENDED = 1, 2
"""Flags: drawn with Mip-Splatting's filter; has extensions."""
_FIXED_BITS = 23
"""Bits of a coordinate without its sign."""
_COLOR_SCALE = 0.15
"""Coded change of colour per unit of the coefficient of degree 0."""
_FIRST_BITS, _REST_BITS = 5, 4
"""Bits of the coefficients of degree 1, and of higher degrees."""
_MAX_RATIO, _ANY_RATIO_BYTES = 20, 1 << 26
"""Maximum ratio of compression that is read, and size up to which any ratio is.

The ratio of trained splats is about 2.
"""
_MAX_EXTENSIONS = 1 << 16
"""Maximum bytes of extensions that are read."""
_GZIP_LEVEL = 6
"""Compression of gzip. Level 9 takes several times as long for files that are hardly smaller."""
_FLIP = np.array([1.0, -1, -1])
"""From the axes of 3DGS files to those of the specification, and back."""
_AXES = 0xADBE0003
"""Extension SPZ_ADOBE_coordinate_system: other axes."""
_SYSTEMS = (
    "RUB",
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""Directions of x, y and z by the number in the extension; 0 stands for the default."""
_DIRECTIONS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}
"""Axis and sign of each direction in 3DGS files."""


class _Header(NamedTuple):
    """Header of a file.

    Attributes:
        bits: fractional bits of coordinates.
    """

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    def widths(self) -> tuple[int, ...]:
        """Return the bytes of a splat in each array."""
        positions, rotations = 6 if self.version == 1 else 9, 3 if self.version < 3 else 4
        return positions, 1, 3, 3, rotations, 3 * (coefficient_count(self.degree) - 1)


def write_spz(path: Path, rows: SplatRows, meta: dict) -> None:
    """Write a ``.spz`` file of version 3.

    Args:
        meta: meta of the splats' bundle; the file stores whether it is antialiased.

    Raises:
        LodgsError: the SH degree is too high, positions are too large, or the file cannot be written.
    """
    require_degree(rows, MAX_WRITTEN_DEGREE, "SPZ")
    extent = max((float(np.abs(splats.means).max()) for _, splats in portable_batches(rows)), default=0.0)
    if extent >= 2.0**_FIXED_BITS:
        raise LodgsError(
            f"Cannot write {path}: positions up to {extent:,.0f} exceed the limit of {2**_FIXED_BITS:,}.",
            "Keep the local origin, or write a PLY.",
        )
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        _write(file, rows, 3, extent, bool(meta.get("antialias")), _FLIP)


def pack_spz(splats: Splats, antialias: bool = False) -> bytes:
    """Return splats as SPZ 2 for glTF, with their own axes.

    Args:
        splats: at least one, of SH degree 3 or lower.
        antialias: they are drawn with Mip-Splatting's filter.
    """
    file = io.BytesIO()
    _write(file, splats, 2, float(np.abs(splats.means).max()), antialias, np.ones(3))
    return file.getvalue()


def _write(
    file: IO[bytes], rows: SplatRows, version: int, extent: float, antialias: bool, signs: np.ndarray
) -> None:
    """Write splats in batches. Positions have the largest number of fractional bits that holds all of them.

    Args:
        signs: signs of the axes in the file.
    """
    bits = int(np.clip(np.floor(_FIXED_BITS - np.log2(max(extent, 1e-6))), 0, _FIXED_BITS))
    flags = _ANTIALIASED if antialias else 0
    header = _Header(version, len(rows), rows.select(slice(0, 0)).sh_degree, bits, flags)
    arrays = [np.empty((len(rows), width), np.uint8) for width in header.widths()]
    for begin, splats in portable_batches(rows):
        part = slice(begin, begin + len(splats))
        for array, codes in zip(arrays, _encode(_flipped(splats, signs), header), strict=True):
            array[part] = codes.reshape(len(splats), -1)
    with gzip.GzipFile("", "wb", _GZIP_LEVEL, file, mtime=0) as stream:
        stream.write(_HEADER.pack(_MAGIC, *header, 0))
        for array in arrays:
            stream.write(array.data)


def _flipped(splats: Splats, signs: np.ndarray) -> Splats:
    """Return splats with opposite signs of no or two axes; rotations are conjugated."""
    if (signs > 0).all():
        return splats
    signs = signs.astype(np.float32)
    return Splats(
        splats.means * signs, splats.quats * np.append(np.float32(1), signs), splats.log_scales,
        splats.opacity_logits, splats.sh * _harmonic_signs(splats.sh_degree, signs)[:, None],
    )  # fmt: skip


def _harmonic_signs(degree: int, signs: np.ndarray) -> np.ndarray:
    """Return the sign (K,) float32 of each coefficient of SH after sign changes of two axes."""
    (x, y, z), (u, v, w) = (0.36, 0.48, 0.8), (0.36, 0.48, 0.8) * signs
    values = [0.0] * coefficient_count(degree), [0.0] * coefficient_count(degree)
    basis(x, y, z, degree, values[0])
    basis(u, v, w, degree, values[1])
    return np.sign(np.multiply(*values)).astype(np.float32)


def _encode(splats: Splats, header: _Header) -> tuple[np.ndarray, ...]:
    """Return the codes of splats, one array per attribute, in the order of the file."""
    fixed = np.rint(splats.means.astype(np.float64) * 2.0**header.bits)
    fixed = fixed.clip(1 - 2**_FIXED_BITS, 2**_FIXED_BITS - 1).astype("<i4")
    rotations = _first_three_codes(splats.quats) if header.version < 3 else _smallest_codes(splats.quats)
    return (
        fixed.reshape(-1, 1).view(np.uint8)[:, :3],
        _to_codes(255 * splats.opacities),
        _to_codes(255 * (_COLOR_SCALE * splats.sh[:, 0] + 0.5)),
        _to_codes(16 * (splats.log_scales.clip(-10) + 10)),
        rotations,
        _coefficient_codes(splats.sh[:, 1:]),
    )


def read_spz(path: Path) -> tuple[Splats, dict]:
    """Read a ``.spz`` file with the axes of 3DGS files; return splats and meta.

    Raises:
        LodgsError: the file cannot be read, is damaged, or needs a missing package.
    """
    with open_file(path) as file:
        data = file.read()
    try:
        header, arrays, extensions = _unpack(data, path)
        splats = _decode(header, arrays)
        axes = _SYSTEMS[_read_axes(extensions)] if header.flags & _EXTENDED else _SYSTEMS[0]
    except (ValueError, IndexError, struct.error, zlib.error) as error:
        raise LodgsError(f"Cannot read {path}: it is damaged ({error}).", "Export it again.") from error
    return _with_3dgs_axes(splats, axes), _meta(header)


def unpack_spz(data: bytes, max_splats: int, path: Path | None = None) -> tuple[Splats, dict]:
    """Return the splats and meta of an SPZ file's content inside glTF, with the coordinates of the file.

    Args:
        path: path of the glTF file, for messages.

    Raises:
        ValueError: the data are damaged, or have more splats than ``max_splats``.
        LodgsError: the data have an unknown version, or need a missing package.
    """
    try:
        header, arrays, _ = _unpack(data, path or Path("SPZ data"), max_splats)
    except (zlib.error, struct.error) as error:
        raise ValueError(f"its SPZ data are damaged ({error})") from error
    return _decode(header, arrays), _meta(header)


def _meta(header: _Header) -> dict:
    """Return the meta of a bundle with the splats of a file."""
    return {"antialias": True} if header.flags & _ANTIALIASED else {}


def _array_sizes(header: _Header, size: int, max_splats: int | None = None) -> list[int]:
    """Return the bytes of each array of a file.

    Args:
        size: bytes of the file.

    Raises:
        ValueError: the file declares what it cannot hold.
    """
    sizes = [header.count * width for width in header.widths()]
    too_many = max_splats is not None and header.count > max_splats
    if too_many or sum(sizes) > max(_MAX_RATIO * size, _ANY_RATIO_BYTES) or header.bits > _FIXED_BITS:
        raise ValueError(f"its SPZ data are too short for {header.count:,} splats")
    return sizes


def _unpack(
    data: bytes, path: Path, max_splats: int | None = None
) -> tuple[_Header, list[np.ndarray], bytes]:
    """Return header, arrays and extensions of any version; see the functions of the versions."""
    if data[:4] == _MAGIC.to_bytes(4, "little"):
        return _unpack_zstandard(data, path, max_splats)
    return _unpack_gzip(data, max_splats)


def _unpack_gzip(data: bytes, max_splats: int | None = None) -> tuple[_Header, list[np.ndarray], bytes]:
    """Return header, arrays and extensions of versions 1 to 3.

    Raises:
        ValueError, zlib.error, struct.error: the data are damaged.
    """
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    magic, *values, _ = _HEADER.unpack(stream.decompress(data, _HEADER.size))
    header = _Header(*values)
    if magic != _MAGIC or header.degree > MAX_DEGREE:
        raise ValueError("they are not SPZ data")
    if header.version not in (1, 2, 3):
        raise ValueError(f"SPZ version {header.version} is not supported")
    sizes = _array_sizes(header, len(data), max_splats)
    body = stream.decompress(stream.unconsumed_tail, sum(sizes) or 1)
    rest = stream.decompress(stream.unconsumed_tail, _MAX_EXTENSIONS)
    if len(body) != sum(sizes) or not stream.eof or (rest and not header.flags & _EXTENDED):
        raise ValueError(f"its SPZ data do not match {header.count:,} splats")
    return header, np.split(np.frombuffer(body, np.uint8), np.cumsum(sizes)[:-1]), rest


def _unpack_zstandard(
    data: bytes, path: Path, max_splats: int | None = None
) -> tuple[_Header, list[np.ndarray], bytes]:
    """Return header, arrays and extensions of version 4. Empty arrays may be missing.

    Raises:
        ValueError, struct.error: the data are damaged.
        LodgsError: the version is newer, or the package for Zstandard is missing.
    """
    try:
        import zstandard
    except ImportError as error:
        raise LodgsError(
            f"Cannot read {path}: SPZ 4 needs the package zstandard, which is not installed.",
            "Install it with pip, or save the file as SPZ 3.",
        ) from error
    _, version, count, degree, bits, flags, streams, offset = _HEADER_4.unpack_from(data)
    header = _Header(version, count, degree, bits, flags)
    if version > 4:
        raise LodgsError(
            f"Cannot read {path}: SPZ version {version} is not supported.", "Save the file as SPZ 4 or 3."
        )
    if version != 4 or degree > MAX_DEGREE or offset < _HEADER_4.size:
        raise ValueError(f"its version is {version} and its SH degree {degree}")
    sizes = _array_sizes(header, len(data), max_splats)
    begin, arrays = offset + streams * _ENTRY_4.size, []
    table = [entry for entry in _ENTRY_4.iter_unpack(data[offset:begin]) if entry[1]]
    if [unpacked for _, unpacked in table] != [size for size in sizes if size]:
        raise ValueError(f"its arrays do not hold {count:,} splats")
    packed_sizes = iter([packed for packed, _ in table])
    for size in sizes:
        packed = next(packed_sizes) if size else 0
        try:
            reader = zstandard.ZstdDecompressor().stream_reader(data[begin : begin + packed])
            content = reader.read(size) if size else b""
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
        if len(content) != size:
            raise ValueError("an array is truncated")
        arrays.append(np.frombuffer(content, np.uint8))
        begin += packed
    return header, arrays, data[_HEADER_4.size : offset][:_MAX_EXTENSIONS]


def _decode(header: _Header, arrays: Sequence[np.ndarray]) -> Splats:
    """Return the splats of the arrays of a file, with its coordinates."""
    positions, alphas, colors, scales, rotations, coefficients = arrays
    count, rest = header.count, coefficient_count(header.degree) - 1
    if header.version == 1:
        means = positions.view("<f2").reshape(count, 3).astype(np.float32)
    else:
        fixed = np.zeros((3 * count, 4), np.uint8)
        fixed[:, 1:] = positions.reshape(-1, 3)
        means = (fixed.view("<i4").reshape(count, 3) >> 8) * 2.0**-header.bits
    quats = _first_three(rotations.reshape(-1, 3)) if header.version < 3 else _smallest_three(rotations)
    sh = np.empty((count, rest + 1, 3), np.float32)
    sh[:, 0] = (colors.reshape(count, 3) / 255 - 0.5) / _COLOR_SCALE
    sh[:, 1:] = coefficients.reshape(count, rest, 3)
    sh[:, 1:] = (sh[:, 1:] - 128) / 128
    return splats_from_activated(means, quats, np.exp(scales.reshape(count, 3) / 16 - 10), alphas / 255, sh)


def _read_axes(extensions: bytes) -> int:
    """Return the number of the axes in a file's extensions; 0 without one.

    Raises:
        struct.error: the extensions are damaged.
    """
    begin = 0
    while begin + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, begin)
        if kind == _AXES:
            return struct.unpack_from("<I", extensions, begin + 8)[0]
        begin += 8 + length
    return 0


def _with_3dgs_axes(splats: Splats, axes: str) -> Splats:
    """Return splats in the axes of 3DGS files, right, down and forward.

    Args:
        axes: letters of the directions of x, y and z.
    """
    if axes == _SYSTEMS[0]:
        return _flipped(splats, _FLIP)
    matrix = np.zeros((3, 3))
    for column, letter in enumerate(axes):
        row, sign = _DIRECTIONS[letter]
        matrix[row, column] = sign
    side = np.linalg.det(matrix)  # -1: mirrored, which is a rotation and a reversal of all three axes
    turned = Similarity(side * matrix, 1.0, np.zeros(3)).transform_splats(splats)
    if side < 0:
        turned.means = -turned.means
        for degree in range(1, splats.sh_degree + 1, 2):
            turned.sh[:, degree**2 : (degree + 1) ** 2] *= -1
    return turned


def _first_three_codes(quats: np.ndarray) -> np.ndarray:
    """Return the codes (N, 3) uint8 of quats (N, 4), wxyz, that :func:`_first_three` reads."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return _to_codes(127.5 * np.where(unit[:, :1] < 0, -1, 1) * unit[:, 1:] + 127.5)


def _first_three(codes: np.ndarray) -> np.ndarray:
    """Return quats (N, 4), wxyz, of the codes (N, 3) of x, y and z, with w of at least 0."""
    xyz = codes / 127.5 - 1
    return np.column_stack([np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1), 0)), xyz])


def _smallest_codes(quats: np.ndarray) -> np.ndarray:
    """Return the codes (N, 4) uint8 of quats (N, 4), wxyz, that :func:`_smallest_three` reads."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    packed = largest.astype("<u4")
    for index in range(4):
        code = np.rint(np.abs(xyzw[:, index]) * (511 * np.sqrt(2))).clip(0, 511).astype("<u4")
        code |= np.where(xyzw[:, index] < 0, 512, 0).astype("<u4")
        packed = np.where(largest == index, packed, packed << 10 | code)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _smallest_three(codes: np.ndarray) -> np.ndarray:
    """Return quats (N, 4), wxyz, of 32-bit codes (4 N,) uint8.

    A code has the index of the largest value and 10 bits for each other value.
    """
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


def _to_codes(values: np.ndarray) -> np.ndarray:
    """Round values to uint8, limited to 0 to 255."""
    return np.rint(values).clip(0, 255).astype(np.uint8)
