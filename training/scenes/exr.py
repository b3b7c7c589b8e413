"""OpenEXR files: size with the standard library, pixels with OpenEXR. Checks untrusted files."""

from __future__ import annotations

import errno
import struct
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import LodgsError

MAGIC = b"\x76\x2f\x31\x01"
MAX_BYTES = 2 << 30
"""Maximum memory of all channels of a file."""


_WINDOW_BYTES = 16
_MAX_CHUNKS = 1 << 20


class Truncated(Exception):
    """Raised for an image file that ends too early."""


def exr_size(file: IO[bytes]) -> tuple[int, int]:
    """Return the width and height of the first header's displayWindow, and check its chunks.

    File layout: https://openexr.com/en/latest/OpenEXRFileLayout.html

    Raises:
        Truncated, struct.error, KeyError, IndexError: if the file is truncated.
    """
    end = file.seek(0, 2)
    file.seek(4)
    (version,) = struct.unpack("<I", file.read(4))
    attributes = {}
    while name := _string(file):
        _string(file)  # attribute type
        (size,) = struct.unpack("<I", file.read(4))
        if file.tell() + size > end:
            raise Truncated
        attributes[name] = file.read(min(size, _WINDOW_BYTES))
        file.seek(max(size - _WINDOW_BYTES, 0), 1)
    left, top, right, bottom = struct.unpack("<4i", attributes[b"displayWindow"])
    _, first, _, last = struct.unpack("<4i", attributes[b"dataWindow"])
    lines = _LINES.get(attributes[b"compression"][0])
    if lines and not version & _NOT_SCANLINES:
        _check_chunks(file, max(-(-(last - first + 1) // lines), 0), end)
    return right - left + 1, bottom - top + 1


# Lines per chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_LINES = dict(enumerate([1, 1, 1, 16, 32, 16, 32, 32, 32, 256]))
_NOT_SCANLINES = 0x200 | 0x800 | 0x1000  # tiles, deep data, several parts


def _check_chunks(file: IO[bytes], count: int, end: int) -> None:
    """Raise Truncated unless the chunk offset table is filled in and the last chunk is complete."""
    if file.tell() + 8 * count > end or count > _MAX_CHUNKS:
        raise Truncated
    offsets = np.frombuffer(file.read(8 * count), "<u8")
    if not offsets.all() or offsets.max(initial=0) + 8 > end:
        raise Truncated
    file.seek(int(offsets.max(initial=0)) + 4)
    (size,) = struct.unpack("<I", file.read(4))
    if file.tell() + size > end:
        raise Truncated


def _string(file: IO[bytes]) -> bytes:
    """Read a null-terminated name of at most 255 bytes."""
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > 255:
            raise Truncated
        text += byte
    return text


def read_parts(path: Path) -> list[tuple[str, dict, dict[str, np.ndarray]]]:
    """Read name, header and channels (H, W) by name of each part of a file. Values stay as stored.

    Raises:
        LodgsError: the channels need more memory than MAX_BYTES.
        RuntimeError, OSError, ValueError: if OpenEXR cannot read the file.
    """
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        needed = sum(_max_bytes(part.header) for part in file.parts)
        expected = [len(part.header["channels"]) for part in file.parts]
    if needed > MAX_BYTES:
        raise LodgsError(
            f"Cannot read {path}: its {needed / 2**30:.1f} GiB of pixels exceed the limit of "
            f"{MAX_BYTES >> 30} GiB.",
            "Reduce the image, or export fewer passes.",
        )
    with OpenEXR.File(str(path), separate_channels=True) as file:
        parts = [(part.name(), dict(part.header), part.channels) for part in file.parts]
        if [len(channels) for _, _, channels in parts] != expected:
            raise ValueError("its pixels are damaged")  # OpenEXR only prints a message
        return [
            (name, header, {key: channel.pixels for key, channel in channels.items()})
            for name, header, channels in parts
        ]


def _max_bytes(header: dict) -> int:
    """Return an upper bound of a part's memory, at 4 bytes per value."""
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (max(int(side), 0) for side in high - low + 1)
    return 4 * width * height * len(header["channels"])


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Write channels (H, W) by name as float32.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    try:
        planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
        OpenEXR.File(header, planes).write(str(path))
    except RuntimeError as error:
        raise OSError(errno.EIO, "the disk is full or not writable", str(path)) from error
