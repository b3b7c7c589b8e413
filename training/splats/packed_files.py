"""Checks of compressed splat files before splat-transform unpacks them into memory.

A file must be large enough for the splats that it declares, and must not unpack to more than they need.
"""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

from ..documents import open_file, parse_json
from ..errors import LodgsError
from .ply import read_elements

_SPZ = struct.Struct("<IIIB3x")
_SPZ_MAGIC = 0x5053474E
_SPZ_COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}
_SPZ_SPLAT = 16, 20
"""Minimum and maximum bytes of a splat without harmonics: position, opacity, colour, scale and rotation."""
_SPZ_4 = struct.Struct("<IIIB2xBI12x")
"""Header of version 4: magic, version, splats, SH degree, number of streams, offset of the table."""
_SPZ_ENTRY = struct.Struct("<QQ")
"""Packed and unpacked bytes of a stream."""
_SPZ_4_SPLAT = 9, 1, 3, 3, 4
"""Bytes of a splat per stream of version 4, before harmonics; empty streams may be missing."""
_MAX_DEFLATION = 1032
"""Maximum ratio of Deflate, https://zlib.net/zlib_tech.html."""
_KSPLAT_HEADER = 4096
_KSPLAT_SPLAT = 24
"""Bytes of a splat at the highest compression."""
_SOG_PALETTE = 1 << 23
"""Maximum pixels of a SOG's image of harmonics, which has at most 2^16 sets."""
_BLOCK = 1 << 20
_SMALL = 1 << 26
"""Size up to which unpacked files need no relation to the packed ones."""


def check_packed_file(path: Path) -> None:
    """Check a file by the suffix of its name; other suffixes pass.

    Raises:
        LodgsError: the file cannot be read, is damaged, or unpacks to more than its splats need.
    """
    name = path.name.lower()
    if name.endswith(".ply"):
        read_elements(path, splats=False)
    check = next((check for suffix, check in _CHECKS.items() if name.endswith(suffix)), None)
    if check is None:
        return
    try:
        with open_file(path) as file:
            check(file, os.fstat(file.fileno()).st_size)
    except LodgsError:
        raise
    except Exception as error:  # zipfile documents no exception types
        raise LodgsError(
            f"Cannot read {path}: it is damaged or does not hold its splats ({error}).",
            "Export or copy it again.",
        ) from error


def _check_spz(file: IO[bytes], size: int) -> None:
    """Unpack versions 1 to 3, a gzip stream, without storing it; check the table of contents of version 4."""
    if file.read(2) != b"\x1f\x8b":
        _check_spz_table(file, size)
        return
    file.seek(0)
    unpacker = zlib.decompressobj(wbits=31)
    unpacked, head, min_size, limit = 0, b"", _SPZ.size, _SPZ.size
    while block := unpacker.unconsumed_tail or file.read(_BLOCK):
        data = unpacker.decompress(block, _BLOCK)
        unpacked += len(data)
        if len(head) < _SPZ.size and len(head := head + data[: _SPZ.size]) >= _SPZ.size:
            magic, _, count, degree = _SPZ.unpack(head[: _SPZ.size])
            if magic != _SPZ_MAGIC:
                raise ValueError("it is not an SPZ file")
            min_size, limit = (
                _SPZ.size + count * (splat + 3 * _SPZ_COEFFICIENTS[degree]) for splat in _SPZ_SPLAT
            )
            if min_size > _MAX_DEFLATION * size:
                raise ValueError(f"it is too short for {count:,} splats")
        if unpacked > limit + _BLOCK:
            raise ValueError(f"it unpacks to more than {limit:,} bytes")
        if unpacker.eof:
            break
    if not unpacker.eof or unpacked < min_size:
        raise ValueError("it is truncated")
    if unpacker.unused_data or file.read(1):
        raise ValueError("it has data after its end")


def _check_spz_table(file: IO[bytes], size: int) -> None:
    """Check the packed and unpacked sizes of the streams of version 4, which Zstandard compresses."""
    file.seek(0)
    magic, version, count, degree, streams, offset = _SPZ_4.unpack(file.read(_SPZ_4.size))
    if magic != _SPZ_MAGIC:
        raise ValueError("it is not an SPZ file")
    if version != 4:
        problem = "must be compressed" if version < 4 else "is not supported"
        raise ValueError(f"version {version} {problem}")
    file.seek(offset)
    table = list(_SPZ_ENTRY.iter_unpack(file.read(streams * _SPZ_ENTRY.size)))
    begin = offset + streams * _SPZ_ENTRY.size
    if offset < _SPZ_4.size or len(table) < streams or begin + sum(packed for packed, _ in table) > size:
        raise ValueError("it is truncated")
    expected = [count * width for width in (*_SPZ_4_SPLAT, 3 * _SPZ_COEFFICIENTS[degree])]
    if [unpacked for _, unpacked in table if unpacked] != [length for length in expected if length]:
        raise ValueError(f"its streams do not unpack to {count:,} splats")
    if sum(expected) > max(_MAX_DEFLATION * size, _SMALL):  # real positions hardly compress
        raise ValueError(f"it is too short for {count:,} splats")


def _check_ksplat(file: IO[bytes], size: int) -> None:
    (count,) = struct.unpack_from("<I", file.read(20), 16)
    if _KSPLAT_HEADER + count * _KSPLAT_SPLAT > size:
        raise ValueError(f"it is too short for {count:,} splats")


def _check_sog(file: IO[bytes], size: int) -> None:
    """Check the sizes of the archive's members, and those of its images."""
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > 2 * size + _BLOCK:  # images hardly compress
            raise ValueError(f"it unpacks to more than {2 * size + _BLOCK:,} bytes")
        meta = parse_json(archive.read("meta.json"), "meta.json", _BLOCK)
        count = meta["count"] if "count" in meta else meta["means"]["shape"][0]
        if type(count) is not int or not 0 <= count <= size:  # a splat takes 8 bytes or more
            raise ValueError(f"it is too short for {count} splats")
        for member in members:
            if member.filename.lower().endswith(".webp"):
                with archive.open(member) as image:
                    width, height = webp_size(image.read(30))
                if width * height > max(2 * count, _SOG_PALETTE):
                    raise ValueError(f"{member.filename} has {width}x{height} pixels for {count:,} splats")


def webp_size(head: bytes) -> tuple[int, int]:
    """Return width and height from the first 30 bytes of a WebP, whose first chunk has one of three layouts.

    RFC 9649.

    Raises:
        ValueError, struct.error: the bytes are not those of a WebP.
    """
    kind, chunk, body = head[8:12], head[12:16], head[20:30]
    if kind != b"WEBP" or len(body) < 10:
        raise ValueError("it is not a WebP image")
    if chunk == b"VP8 ":
        width, height = struct.unpack("<6xHH", body)
        return width & 0x3FFF, height & 0x3FFF
    if chunk == b"VP8L":
        (packed,) = struct.unpack("<xI5x", body)
        return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1


_CHECKS: dict[str, Callable[[IO[bytes], int], None]] = {
    ".spz": _check_spz,
    ".ksplat": _check_ksplat,
    ".sog": _check_sog,
}
