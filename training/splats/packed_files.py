"""Checks of SOG files before a program unpacks them into memory.

A file must be large enough for the splats that it declares, and must not unpack to more than they need.
"""

from __future__ import annotations

import os
import struct
import zipfile
from pathlib import Path
from typing import IO

from ..documents import open_file, parse_json
from ..errors import LodgsError

MAX_PALETTE_PIXELS = 1 << 23
"""Maximum pixels of a SOG's image of harmonics, which has at most 2^16 sets."""
_BLOCK = 1 << 20


def check_sog_file(path: Path) -> None:
    """Check the sizes that an archive of SOG declares.

    Raises:
        LodgsError: the file cannot be read, is damaged, or unpacks to more than its splats need.
    """
    try:
        with open_file(path) as file:
            _check_sog(file, os.fstat(file.fileno()).st_size)
    except LodgsError:
        raise
    except Exception as error:  # zipfile documents no exception types
        raise LodgsError(
            f"Cannot read {path}: it is damaged or does not hold its splats ({error}).",
            "Export or copy it again.",
        ) from error


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
                if width * height > max(2 * count, MAX_PALETTE_PIXELS):
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
