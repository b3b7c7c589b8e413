"""OpenEXR files of anybody's making: their size with the standard library, their pixels with OpenEXR."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import LodgsError

MAGIC = b"\x76\x2f\x31\x01"
MAX_BYTES = 2 << 30
"""Memory that all channels of a file may take."""


class Truncated(Exception):
    """The file ends too early."""


def exr_size(file: IO[bytes]) -> tuple[int, int]:
    """Width and height of the displayWindow of the (first) header, after a look at the chunks that follow it.

    File layout: https://openexr.com/en/latest/OpenEXRFileLayout.html

    Raises:
        Truncated, struct.error, KeyError, IndexError: the file is cut short.
    """
    end = file.seek(0, 2)
    file.seek(4)
    (version,) = struct.unpack("<I", file.read(4))
    attributes = {}
    while name := _string(file):
        _string(file)  # its type
        (size,) = struct.unpack("<I", file.read(4))
        if file.tell() + size > end:
            raise Truncated
        attributes[name] = file.read(size)
    left, top, right, bottom = struct.unpack("<4i", attributes[b"displayWindow"])
    _, first, _, last = struct.unpack("<4i", attributes[b"dataWindow"])
    lines = _LINES.get(attributes[b"compression"][0])
    if lines and not version & _NOT_SCANLINES:
        _expect_chunks(file, max(-(-(last - first + 1) // lines), 0), end)
    return right - left + 1, bottom - top + 1


# Lines in a chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_LINES = dict(enumerate([1, 1, 1, 16, 32, 16, 32, 32, 32, 256]))
_NOT_SCANLINES = 0x200 | 0x800 | 0x1000  # tiles, deep data, several parts


def _expect_chunks(file: IO[bytes], count: int, end: int) -> None:
    """The table of chunk offsets is filled in, and the chunk that is last in the file is whole."""
    if file.tell() + 8 * count > end:
        raise Truncated
    offsets = np.frombuffer(file.read(8 * count), "<u8")
    if not offsets.all() or offsets.max(initial=0) + 8 > end:
        raise Truncated
    file.seek(int(offsets.max(initial=0)) + 4)
    (size,) = struct.unpack("<I", file.read(4))
    if file.tell() + size > end:
        raise Truncated


def _string(file: IO[bytes]) -> bytes:
    """A null-terminated name of at most 255 bytes."""
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > 255:
            raise Truncated
        text += byte
    return text


def read_parts(path: Path) -> list[tuple[str, dict, dict[str, np.ndarray]]]:
    """Every part of a file: its name, its header, and its channels (H, W) by name, as they are stored.

    Raises:
        LodgsError: the file's channels take more than MOST_BYTES.
        RuntimeError, OSError, ValueError: as OpenEXR raises them.
    """
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        needed = sum(_bytes_of(part.header) for part in file.parts)
        promised = [len(part.header["channels"]) for part in file.parts]
    if needed > MAX_BYTES:
        raise LodgsError(
            f"{path} holds {needed / 2**30:.1f} GiB of pixels; {MAX_BYTES >> 30} are read at most.",
            "Make it smaller, or leave out passes.",
        )
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = [(part.name(), dict(part.header), part.channels) for part in file.parts]
        if [len(channels) for _, _, channels in found] != promised:
            raise ValueError("its pixels are damaged")  # of which OpenEXR only prints
        return [
            (name, header, {each: channel.pixels for each, channel in channels.items()})
            for name, header, channels in found
        ]


def _bytes_of(header: dict) -> int:
    """At most so many, at 4 bytes a value."""
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (max(int(side), 0) for side in high - low + 1)
    return 4 * width * height * len(header["channels"])


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Writes channels (H, W) by name, as float32.

    Raises:
        OSError: it cannot be written.
    """
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    try:
        planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
        OpenEXR.File(header, planes).write(str(path))
    except RuntimeError as error:
        raise OSError(f"{path} could not be written: {error}") from error
