"""Headers of image files: size and EXIF orientation. numpy and standard library only."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import IO

from ..documents import open_file
from ..errors import LodgsError, read_error
from ..splats.packed_files import webp_size
from .exr import MAGIC, Truncated, exr_size

MAX_PIXELS = 178_956_970
"""Maximum number of pixels of an input image: Pillow's own limit, at 4 bytes per pixel."""
ORIENTATION = 274
"""TIFF and EXIF tag."""

_BLOCK = 1 << 20
_MAX_BLOCKS = 1 << 10
"""Blocks of a file that are searched for its end: a gigabyte."""
_MAX_TAGS = 1 << 16
_MAX_CHUNKS = 1 << 20
"""Chunks of a PNG or WebP file that are searched for EXIF data."""
# JPEG markers with the size: all start-of-frame markers, which excludes DHT (C4), JPG (C8) and DAC (CC).
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_EXIF, _TIFF = b"Exif\0\0", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""Start of EXIF data, and of TIFF and BigTIFF files."""
_WIDTH, _HEIGHT = 256, 257
_QUARTER_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""Clockwise quarter turns by EXIF orientation; mirroring is ignored."""


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height in pixels from an image's header, without applying its EXIF orientation.

    The format (JPEG, PNG, TIFF, WebP, BMP or EXR) is detected from the content, not from the name. The size
    of an EXR is its display window; the size of a TIFF is that of its first image.

    Raises:
        LodgsError: the file is missing, not a regular file, empty, in another format or truncated, or has
            no pixels or more than MAX_PIXELS.
    """
    with open_file(path) as file:
        try:
            return check_image_size(path, _read_size(path, file))
        except OSError as error:
            raise read_error(path, error, "Check the image folder.") from error
        except (struct.error, IndexError, KeyError, ValueError, Truncated) as error:
            raise LodgsError(
                f"Cannot read {path}: the file is truncated.", "Copy the image again."
            ) from error


def _read_size(path: Path, file: IO[bytes]) -> tuple[int, int]:
    """Return width and height as stored in an image file, from its header.

    Raises:
        LodgsError: the file is empty or of another format.
        struct.error, IndexError, KeyError, ValueError, Truncated: the header is truncated.
    """
    head = file.read(8)
    if not head:
        raise LodgsError(f"Cannot read {path}: the file is empty.", "Copy the image again.")
    if head[:2] == b"\xff\xd8":
        return _jpeg_size(file)
    if head == b"\x89PNG\r\n\x1a\n":
        return _png_size(file)
    if head[:4] == MAGIC:
        return exr_size(file)
    if head[:4] in _TIFF:
        tags = _read_tiff_tags(file)
        return tags[_WIDTH], tags[_HEIGHT]
    if head[:4] == b"RIFF":
        return _webp_size(file)
    if head[:2] == b"BM":
        file.seek(14)
        (size,) = struct.unpack("<I", file.read(4))
        width, height = (
            struct.unpack("<HH", file.read(4)) if size == 12 else struct.unpack("<ii", file.read(8))
        )
        return width, abs(height)  # negative if the first row is the upper one
    if head[4:] == b"ftyp":
        raise LodgsError(
            f"Cannot read {path}: it is a HEIC or AVIF photo: convert the photos to JPEG.",
            "Keep their names; the suffix may differ.",
        )
    raise LodgsError(
        f"Cannot read {path}: it is not a JPEG, PNG, TIFF, WebP, BMP or EXR image.",
        "Convert it to one of these.",
    )


def check_image_size(path: Path, size: tuple[int, int]) -> tuple[int, int]:
    """Return the size (width, height) of an image file if it is within the limits.

    Raises:
        LodgsError: the image has no pixels or more than MAX_PIXELS.
    """
    width, height = size
    if width < 1 or height < 1:
        raise LodgsError(f"Cannot read {path}: the image has no pixels.", "Export the image again.")
    if width * height > MAX_PIXELS:
        raise LodgsError(
            f"Cannot read {path}: {width}x{height} pixels exceed the limit of {MAX_PIXELS:,}.",
            "Reduce the image.",
        )
    return size


def quarter_turns(path: Path) -> int:
    """Return the clockwise quarter turns that make a photo upright, from its EXIF data; 0 without EXIF.

    Phones and cameras store the sensor's image and record the orientation separately.
    """
    return _QUARTER_TURNS.get(exif_orientation(path), 0)


def exif_orientation(path: Path) -> int:
    """Return the EXIF orientation, 1 to 8; 1 without EXIF data."""
    try:
        with open_file(path) as file:
            start = _exif_start(file)
            orientation = 1 if start is None else _read_tiff_tags(file, start).get(ORIENTATION, 1)
    except (LodgsError, OSError, struct.error, IndexError, KeyError, ValueError, Truncated):
        return 1
    return orientation if 1 <= orientation <= 8 else 1


def _exif_start(file: IO[bytes]) -> int | None:
    """Return the position of an image's EXIF data, which is in TIFF format."""
    head = file.read(8)
    if head[:4] in _TIFF:
        return 0
    if head[:2] == b"\xff\xd8":
        segments = takewhile(lambda segment: segment[0] != 0xDA, _jpeg_segments(file))
        contents = (file.tell() for marker, _ in segments if marker == 0xE1)
    elif head[:4] in (b"\x89PNG", b"RIFF"):
        contents = _exif_chunks(file, is_png=head[:4] != b"RIFF")
    else:
        return None
    for start in contents:
        file.seek(start)
        head = file.read(len(_EXIF))
        if head == _EXIF or head[:4] in _TIFF:
            return start + len(_EXIF) * (head == _EXIF)
    return None


def _exif_chunks(file: IO[bytes], is_png: bool) -> Iterator[int]:
    """Yield the positions of the contents of EXIF chunks in a PNG or WebP file."""
    position = 8 if is_png else 12
    for _ in range(_MAX_CHUNKS):
        file.seek(position)
        head = file.read(8)
        length, kind = struct.unpack(">I4s", head) if is_png else struct.unpack("<4sI", head)[::-1]
        if kind in (b"eXIf", b"EXIF"):
            yield position + 8
        position += 8 + length + (4 if is_png else length % 2)


def _jpeg_size(file: IO[bytes]) -> tuple[int, int]:
    """Read the size from the frame header, and check that the end marker follows the first scan."""
    size = None
    for marker, _ in _jpeg_segments(file):
        if marker == 0xDA:
            _check_end(file, b"\xff\xd9")
            break
        if marker in _START_OF_FRAME:
            height, width = struct.unpack(">xHH", file.read(5))
            size = width, height
    if size is None:
        raise Truncated
    return size


def _jpeg_segments(file: IO[bytes]) -> Iterator[tuple[int, int]]:
    """Yield the marker and length of each segment, with the file positioned at the segment's content."""
    file.seek(2)
    while True:
        if file.read(1) != b"\xff":
            raise Truncated
        marker = file.read(1)[0]
        while marker == 0xFF:  # fill bytes
            marker = file.read(1)[0]
        if marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without content
            continue
        if marker == 0xD9:
            raise Truncated
        (length,) = struct.unpack(">H", file.read(2))
        content = file.tell()
        yield marker, length - 2
        file.seek(content + length - 2)


def _png_size(file: IO[bytes]) -> tuple[int, int]:
    length, kind, width, height = struct.unpack(">I4sII", file.read(16))
    if kind != b"IHDR" or length != 13:
        raise Truncated
    _check_end(file, b"IEND\xae\x42\x60\x82")
    return width, height


def _read_tiff_tags(file: IO[bytes], start: int = 0) -> dict[int, int]:
    """Read width, height and orientation by tag number from the first directory (TIFF 6.0).

    Args:
        start: position of the TIFF header, to which offsets refer.
    """
    file.seek(start)
    head = file.read(4)
    order = "<" if head[:2] == b"II" else ">"
    big = b"+" in head  # BigTIFF has 64-bit offsets and counts
    (directory,) = struct.unpack(order + ("4xQ" if big else "I"), file.read(12 if big else 4))
    file.seek(start + directory)
    (count,) = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))
    tags = {}
    for _ in range(min(count, _MAX_TAGS)):
        tag, kind, value = struct.unpack(
            order + ("HH8x8s" if big else "HH4x4s"), file.read(20 if big else 12)
        )
        if tag in (_WIDTH, _HEIGHT, ORIENTATION):  # values have 16, 32 or 64 bits
            tags[tag] = struct.unpack_from(order + {3: "H", 16: "Q"}.get(kind, "I"), value)[0]
    return tags


def _webp_size(file: IO[bytes]) -> tuple[int, int]:
    file.seek(0)
    head = file.read(30)
    if file.seek(0, 2) < int.from_bytes(head[4:8], "little") + 8:
        raise Truncated
    return webp_size(head)


def _check_end(file: IO[bytes], marker: bytes) -> None:
    """Raise Truncated unless the marker follows the current position; some cameras append data to it."""
    position = file.tell()
    file.seek(0, 2)
    file.seek(max(position, file.tell() - len(marker)))
    if file.read() == marker:
        return
    file.seek(position)
    end = block = b""
    for _ in range(_MAX_BLOCKS):
        end, block = block[-len(marker) :], file.read(_BLOCK)
        if marker in end + block:
            return
    raise Truncated
