"""Photographs as arrays: sizes from file headers (numpy and stdlib only), pixels with Pillow and OpenEXR."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .color import srgb_from_linear

# JPEG markers that carry the size: every start of frame, which excludes DHT (C4), JPG (C8) and DAC (CC).
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels of a JPEG, PNG or EXR file, from its header; EXIF rotation is ignored.

    The kind is told by the file's content, not by its name. The size of an EXR is its display window.

    Raises:
        LodgsError: the file is missing, empty, of another kind, or cut short.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(8)
            if not head:
                raise LodgsError(f"{path} is empty.", "Copy the image again.")
            if head[:2] == b"\xff\xd8":
                return _jpeg_size(file)
            if head == b"\x89PNG\r\n\x1a\n":
                return _png_size(file)
            if head[:4] == b"\x76\x2f\x31\x01":
                return _exr_size(file)
    except OSError as error:
        raise LodgsError(f"{path} cannot be read: {error.strerror}.", "Check the image folder.") from error
    except (struct.error, IndexError, KeyError, ValueError, _Truncated) as error:
        raise LodgsError(f"{path} is cut short.", "Copy the image again.") from error
    raise LodgsError(f"{path} is not a JPEG, PNG or EXR image.", "Convert it to one of these.")


class _Truncated(Exception):
    """The file ends before its end marker."""


def _jpeg_size(file) -> tuple[int, int]:
    """Walk the segments to the frame header, then make sure that the end marker follows the first scan."""
    size = None
    file.seek(2)
    while True:
        if file.read(1) != b"\xff":
            raise _Truncated
        marker = file.read(1)[0]
        while marker == 0xFF:  # fill bytes
            marker = file.read(1)[0]
        if marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a segment
            continue
        if marker == 0xD9:
            raise _Truncated
        (length,) = struct.unpack(">H", file.read(2))
        if marker == 0xDA:
            _expect_end(file, b"\xff\xd9")
            if size is None:
                raise _Truncated
            return size
        segment = file.tell()
        if marker in _START_OF_FRAME:
            height, width = struct.unpack(">xHH", file.read(5))
            size = width, height
        file.seek(segment + length - 2)


def _png_size(file) -> tuple[int, int]:
    length, kind, width, height = struct.unpack(">I4sII", file.read(16))
    if kind != b"IHDR" or length != 13:
        raise _Truncated
    _expect_end(file, b"IEND\xae\x42\x60\x82")
    return width, height


def _expect_end(file, marker: bytes) -> None:
    """The marker ends the file or, before what some cameras append, stands somewhere after this place."""
    here = file.tell()
    file.seek(0, 2)
    file.seek(max(here, file.tell() - len(marker)))
    if file.read() == marker:
        return
    file.seek(here)
    if marker not in file.read():
        raise _Truncated


def _exr_size(file) -> tuple[int, int]:
    """The displayWindow of the (first) header, after a look at the chunks that follow it.

    File layout: https://openexr.com/en/latest/OpenEXRFileLayout.html
    """
    file.seek(4)
    (version,) = struct.unpack("<I", file.read(4))
    attributes = {}
    while name := _exr_string(file):
        _exr_string(file)  # its type
        (size,) = struct.unpack("<I", file.read(4))
        attributes[name] = file.read(size)
    left, top, right, bottom = struct.unpack("<4i", attributes[b"displayWindow"])
    _, first, _, last = struct.unpack("<4i", attributes[b"dataWindow"])
    lines = _EXR_LINES.get(attributes[b"compression"][0])
    if lines and not version & _EXR_NOT_SCANLINES:
        _expect_chunks(file, -(-(last - first + 1) // lines))
    return right - left + 1, bottom - top + 1


# Lines in a chunk by compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_EXR_LINES = dict(enumerate([1, 1, 1, 16, 32, 16, 32, 32, 32, 256]))
_EXR_NOT_SCANLINES = 0x200 | 0x800 | 0x1000  # tiles, deep data, several parts


def _expect_chunks(file, count: int) -> None:
    """The table of chunk offsets is filled in, and the chunk that is last in the file is whole."""
    table = file.read(8 * count)
    offsets = np.frombuffer(table, "<u8")
    end = file.seek(0, 2)
    if len(table) < 8 * count or not offsets.all() or offsets.max() + 8 > end:
        raise _Truncated
    file.seek(int(offsets.max()) + 4)
    (size,) = struct.unpack("<I", file.read(4))
    if file.tell() + size > end:
        raise _Truncated


def _exr_string(file) -> bytes:
    """A null-terminated name of at most 255 bytes."""
    text = b""
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > 255:
            raise _Truncated
        text += byte
    return text


def load_image(path: Path, width: int, height: int, exposure: float = 0.0) -> np.ndarray:
    """An image at the given size, (height, width, 3) float32 in [0, 1], display (sRGB) coded.

    Sizes below the file's are area averages (each pixel the mean of the rectangle that it covers: an exact
    2x2 box at half size). JPEG and PNG are averaged as they are coded; an EXR is taken as linear, averaged
    so, multiplied by 2**exposure and coded by the sRGB transfer function (IEC 61966-2-1). Alpha is ignored
    and grey becomes RGB.

    Args:
        exposure: stops, for EXR only.

    Raises:
        LodgsError: the file cannot be read.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            is_exr = file.read(4) == b"\x76\x2f\x31\x01"
        pixels = _exr_pixels(path) if is_exr else _pillow_pixels(path)
    except LodgsError:
        raise
    except Exception as error:  # the libraries raise many kinds for damaged files
        raise LodgsError(
            f"{path} cannot be read as an image: {error}.", "Copy or export it again."
        ) from error
    pixels = _area_average(_area_average(pixels, height, 0), width, 1)
    if is_exr:
        pixels = srgb_from_linear(np.clip(pixels * 2.0**exposure, 0.0, 1.0))
    return np.clip(pixels, 0.0, 1.0).astype(np.float32)


def _pillow_pixels(path: Path) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1]."""
    from PIL import Image

    with Image.open(path) as image:
        if image.mode.startswith("I"):  # 16-bit grey, which convert("RGB") would clip
            grey = np.asarray(image, np.float32) / 65535
            return np.repeat(grey[..., None], 3, axis=2)
        return np.asarray(image.convert("RGB"), np.float32) / 255


def _exr_pixels(path: Path) -> np.ndarray:
    """(H, W, 3) float32, linear, over the display window; black where the data window leaves it empty."""
    import OpenEXR

    image_size(path)  # refuses a file cut short, of which OpenEXR would print and give nothing
    with OpenEXR.File(str(path), separate_channels=True) as file:
        part = next((p for p in file.parts if _rgb_names(p.channels)), None)
        if part is None:
            raise LodgsError(f"{path} has no R, G and B channels.", "Export the combined pass.")
        data = np.stack([part.channels[name].pixels for name in _rgb_names(part.channels)], axis=2)
        (left, top), _ = part.header["dataWindow"]
        display_low, display_high = (np.asarray(corner) for corner in part.header["displayWindow"])
    width, height = display_high - display_low + 1
    x, y = int(left - display_low[0]), int(top - display_low[1])
    pixels = np.zeros((height, width, 3), np.float32)
    seen = pixels[max(y, 0) : max(y + data.shape[0], 0), max(x, 0) : max(x + data.shape[1], 0)]
    seen[:] = data[max(-y, 0) :, max(-x, 0) :][: seen.shape[0], : seen.shape[1]]
    return np.nan_to_num(pixels, posinf=float(np.finfo(np.float32).max))


def _rgb_names(channels) -> list[str]:
    """The colour channels: plain R, G, B, else those of the combined pass or first layer, else luminance."""
    layers = [name[:-1] for name in channels if name.rpartition(".")[2] == "R"]
    layers.sort(key=lambda layer: (layer != "", "Combined" not in layer, layer))
    for layer in layers:
        if all(layer + channel in channels for channel in "RGB"):
            return [layer + channel for channel in "RGB"]
    return ["Y"] * 3 if "Y" in channels else []


def _area_average(pixels: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Resample one axis to `size` cells, each the mean of what it covers: differences of the running sum."""
    old = pixels.shape[axis]
    if size == old:
        return pixels
    pixels = np.moveaxis(pixels, axis, 0)
    if old % size == 0:
        mean = pixels.reshape(size, old // size, *pixels.shape[1:]).mean(axis=1)
    else:
        total = np.zeros((old + 1, *pixels.shape[1:]))
        np.cumsum(pixels, axis=0, out=total[1:])
        edges = np.arange(size + 1) * (old / size)
        below = np.minimum(edges.astype(int), old - 1)
        part = (edges - below).reshape(-1, *[1] * (pixels.ndim - 1))
        mean = np.diff(total[below] * (1 - part) + total[below + 1] * part, axis=0) * (size / old)
    return np.moveaxis(mean, 0, axis)


def write_png(path: Path, codes: np.ndarray) -> None:
    """Writes (H, W, 3) or (H, W, 4) uint8, display-coded, colours not multiplied by alpha.

    By hand (https://www.w3.org/TR/png-3/): Pillow's corrupts memory once pycolmap is loaded.
    """
    height, width, channels = codes.shape
    # the filter "up": each row less the one above, which packs smooth pictures well
    lines = np.empty((height, 1 + width * channels), np.uint8)
    lines[:, 0] = 2
    rows = codes.reshape(height, -1)
    lines[0, 1:], lines[1:, 1:] = rows[0], rows[1:] - rows[:-1]

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"sRGB", b"\0")
        + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6))
        + chunk(b"IEND", b"")
    )
