"""Pixels of image files, with Pillow and OpenEXR."""

from __future__ import annotations

import errno
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..color import srgb_from_linear
from ..documents import open_file
from ..errors import LodgsError, is_system_problem, read_error
from ..files import name_errors
from .exr import MAGIC, read_parts
from .image_headers import ORIENTATION, check_image_size, image_size

if TYPE_CHECKING:
    from PIL import Image

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
"""Lower-case file name suffixes of photos, without ``.exr``, which only renderers write."""

_LARGE = 1 << 25
"""Number of pixels above which an image is reduced while decoding, to at least twice the requested size."""
_STRIP = 1 << 20
"""Approximate number of pixels averaged at a time; each takes about 100 bytes."""

_LAYOUT = 258, 259, 284
"""TIFF tags: bits per channel; compression, 1 for none; planes, 2 for one per channel."""
_UNDO_TRANSPOSE = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}
"""``Image.Transpose`` value that reverts Pillow's transposition, by EXIF orientation."""


@dataclass(frozen=True)
class _LazyImage:
    """Lazily decoded image.

    Attributes:
        rows: function of ``top`` and ``bottom`` that returns (bottom - top, width, channels) float32.
        channels: 3, or 4 with alpha; colours are then premultiplied.
        linear: True for linear light, False for display-coded values.
    """

    width: int
    height: int
    rows: Callable[[int, int], np.ndarray]
    channels: int = 3
    linear: bool = False


def load_image(path: Path, width: int, height: int, exposure: float = 0.0, alpha: bool = False) -> np.ndarray:
    """Load an image at the given size, (height, width, 3) float32 in [0, 1], display (sRGB) coded.

    Smaller sizes are area averages: each pixel is the mean of the rectangle that it covers, at half size an
    exact 2x2 box. Display-coded values are averaged as stored. An EXR is averaged as linear light, multiplied
    by 2**exposure and encoded with the sRGB transfer function (IEC 61966-2-1). Grey images become RGB.

    Args:
        exposure: exposure in stops, for EXR only.
        alpha: return colours over black and alpha as a fourth channel. By default, alpha is ignored.

    Raises:
        LodgsError: the file cannot be read.
    """
    with _open_image(path, width, height, large=_LARGE, alpha=alpha) as image:
        result = np.empty((height, width, 4 if alpha else 3), np.float32)
        top = 0
        for strip in _strips(image, height):
            pixels = area_average(strip, width, 1)
            if image.linear:
                light = np.clip(pixels[..., :3] * 2.0**exposure, 0.0, 1.0)
                pixels = np.concatenate([srgb_from_linear(light), pixels[..., 3:]], axis=-1)
            result[top : top + len(pixels)] = np.clip(pixels, 0.0, 1.0)
            top += len(pixels)
        return result


def load_mask(path: Path, width: int, height: int) -> np.ndarray:
    """Load a photo's mask at the given size, (height, width) float32; 0 marks ignored pixels.

    Pixels are ignored if they are black or transparent. The values 0 and 1 of 8 or 16 bits count as black and
    white.

    Raises:
        LodgsError: the file cannot be read, or its aspect ratio differs from the given size.
    """
    check_mask(path, width, height)
    mask = load_image(path, width, height, alpha=True)[..., :3].max(axis=-1)
    for white in 65535, 255:
        if 0 < white * mask.max() < 1.5:
            mask *= white
    lossy = path.suffix.lower() in (".jpg", ".jpeg", ".webp")  # nearly black and nearly white
    return (mask >= 0.5).astype(np.float32) if lossy else mask


def check_mask(path: Path, width: int, height: int) -> None:
    """Check the header of a mask for a photo of the given size.

    Raises:
        LodgsError: the file is not an image, or its aspect ratio differs from the photo's.
    """
    mask_width, mask_height = image_size(path)
    if not same_proportions(mask_width, mask_height, width, height):
        raise LodgsError(
            f"Cannot use mask {path}: its size {mask_width}x{mask_height} does not match the "
            f"aspect ratio of its photo ({width}x{height}).",
            "Export the mask again, or remove it.",
        )


def same_proportions(
    width_a: int, height_a: int, width_b: int, height_b: int, tolerance: float = 0.01
) -> bool:
    """Return True if two aspect ratios differ by less than the tolerance and rounding to whole pixels."""
    shortest = min(width_a, height_a, width_b, height_b)
    return bool(abs(np.log(width_a * height_b / (height_a * width_b))) <= tolerance + 1 / shortest)


def check_image(path: Path) -> None:
    """Decode an image at the smallest size that its format supports, and discard the result.

    Raises:
        LodgsError: the file cannot be read.
    """
    with _open_image(path, 1, 1, large=0):
        pass


@contextmanager
def _open_image(path: Path, width: int, height: int, large: int, alpha: bool = False) -> Iterator[_LazyImage]:
    """Open an image for loading at the given size, and convert every failure to a LodgsError.

    Args:
        large: number of pixels above which the image is reduced to at least twice the given size: a JPEG
            while decoding, other formats by an integer factor.
    """
    try:
        with open_file(path) as file:
            if file.read(4) == MAGIC:
                yield _open_exr(path, alpha)
                return
            from PIL import Image

            file.seek(0)
            with Image.open(file, formats=("JPEG", "PNG", "TIFF", "WEBP", "BMP")) as image:
                if image.format == "TIFF":  # the only format that Pillow transposes by its orientation
                    tags = image.getexif()
                    bits, compression, planes = (tags.get(tag) for tag in _LAYOUT)
                    if (compression, planes) == (1, 2) and np.max(bits or 1) > 8:  # Pillow 13 misreads them
                        raise LodgsError(
                            f"Cannot read {path}: its 16-bit colours are stored per channel.",
                            "Save it interleaved or compressed.",
                        )
                    orientation = tags.get(ORIENTATION, 1)
                    image.load()
                    if orientation in _UNDO_TRANSPOSE:
                        image = image.transpose(Image.Transpose(_UNDO_TRANSPOSE[orientation]))
                if image.width * image.height > large:
                    image.draft(None, (2 * width, 2 * height))
                    factor = min(image.width // (2 * width), image.height // (2 * height))
                    if factor > 1 and image.mode in ("L", "RGB"):
                        image = image.reduce(factor)
                image.load()

                def rows(top: int, bottom: int) -> np.ndarray:
                    return _pillow_rows(image, top, bottom, alpha)

                yield _LazyImage(image.width, image.height, rows, 4 if alpha else 3)
    except LodgsError:
        raise
    except Exception as error:  # the libraries raise many exception types for damaged files
        if is_system_problem(error):
            problem = error if isinstance(error, OSError) else OSError(errno.ENOMEM, "not enough memory")
            raise read_error(path, problem, "Check the image folder.") from error
        raise LodgsError(f"Cannot read {path} as an image: {error}.", "Copy or export it again.") from error


def _pillow_rows(image: Image.Image, top: int, bottom: int, alpha: bool) -> np.ndarray:
    """Return rows of a Pillow image, (H, W, 3) float32 in [0, 1], or (H, W, 4) with alpha."""
    rows = image.crop((0, top, image.width, bottom))
    if alpha:
        codes = np.ones((rows.height, rows.width, 4), np.float32)
        if "A" in rows.mode or "transparency" in rows.info:
            codes[:] = np.asarray(rows.convert("RGBA"), np.float32) / 255
            codes[..., :3] *= codes[..., 3:]
        else:
            codes[..., :3] = _pillow_rows(image, top, bottom, alpha=False)
        return codes
    if rows.mode.startswith("I"):  # convert("RGB") would clip 16-bit grey
        gray = np.asarray(rows, np.float32) / 65535
        return np.repeat(gray[..., None], 3, axis=2)
    if rows.mode == "F":  # convert("RGB") would treat grey from 0 to 1 as 0 to 255
        return np.repeat(np.nan_to_num(np.asarray(rows, np.float32))[..., None], 3, axis=2)
    return np.asarray(rows.convert("RGB"), np.float32) / 255


def _open_exr(path: Path, alpha: bool) -> _LazyImage:
    """Return linear light over the display window, black outside the data window."""
    image_size(path)  # rejects a truncated file, for which OpenEXR only prints a message
    part = next((part for part in read_parts(path) if _rgb_names(part[2])), None)
    if part is None:
        raise LodgsError(f"Cannot read {path}: it has no R, G and B channels.", "Export the combined pass.")
    _, header, channels = part
    (data_left, data_top), _ = header["dataWindow"]
    low, high = (np.asarray(corner) for corner in header["displayWindow"])
    columns, lines = high - low + 1
    width, height = check_image_size(path, (int(columns), int(lines)))
    x, y = int(data_left - low[0]), int(data_top - low[1])
    names = _rgb_names(channels)
    planes = [channels[name] for name in names]
    if alpha:
        alpha_name = names[0][:-1] + "A"
        planes.append(channels[alpha_name] if alpha_name in channels else np.ones_like(planes[0]))

    def rows(top: int, bottom: int) -> np.ndarray:
        pixels = np.zeros((bottom - top, width, len(planes)), np.float32)
        for plane, channel in zip(planes, np.moveaxis(pixels, 2, 0), strict=True):
            data = plane[max(top - y, 0) : max(bottom - y, 0), max(-x, 0) :]
            overlap = channel[max(y - top, 0) :, max(x, 0) :][: data.shape[0], : data.shape[1]]
            overlap[:] = data[: overlap.shape[0], : overlap.shape[1]]
        return np.nan_to_num(pixels, posinf=float(np.finfo(np.float32).max))

    return _LazyImage(width, height, rows, len(planes), linear=True)


def load_exr(path: Path) -> np.ndarray:
    """Load premultiplied linear light and alpha of an EXR over its display window, (H, W, 4) float32.

    Raises:
        LodgsError: the file cannot be read.
    """
    with _open_image(path, 1, 1, large=_LARGE, alpha=True) as image:
        if not image.linear:
            raise LodgsError(f"Cannot read {path}: it is not an EXR image.", "Export it again.")
        return image.rows(0, image.height)


def _rgb_names(channels: Collection[str]) -> list[str]:
    """Return the colour channels: R, G, B, else those of the combined pass or first layer, else luminance."""
    layers = [name[:-1] for name in channels if name.rpartition(".")[2] == "R"]
    layers.sort(key=lambda layer: (layer != "", "Combined" not in layer, layer))
    for layer in layers:
        if all(layer + channel in channels for channel in "RGB"):
            return [layer + channel for channel in "RGB"]
    return ["Y"] * 3 if "Y" in channels else []


def _strips(image: _LazyImage, height: int) -> Iterator[np.ndarray]:
    """Yield strips of the image at another height, bit-identical to :func:`area_average`."""
    max_rows = max(_STRIP // image.width, 1)
    old = image.height
    if old % height == 0:
        factor = old // height
        step = max(max_rows // factor, 1)
        for top in range(0, height, step):
            bottom = min(top + step, height)
            yield area_average(image.rows(top * factor, bottom * factor), bottom - top, 0)
        return
    cells, fractions = _cell_edges(old, height)
    step = max(max_rows * height // old, 1)
    preceding = np.zeros((image.width, image.channels))  # sum of all rows above the strip
    for top in range(0, height, step):
        edges = slice(top, min(top + step, height) + 1)
        first, last = cells[edges][0], cells[edges][-1]
        total = np.concatenate([preceding[None], image.rows(first, last + 1)], dtype=np.float64)
        np.cumsum(total, axis=0, out=total)
        preceding = total[last - first]
        yield _sums_between(total, cells[edges] - first, fractions[edges]) * (height / old)


def area_average(pixels: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Resample one axis of (H, W, C) to ``size`` cells, each the mean of the area that it covers.

    The means are differences of the running sum.
    """
    old = pixels.shape[axis]
    if size == old:
        return pixels
    pixels = np.moveaxis(pixels, axis, 0)
    if old % size == 0:
        mean = pixels.reshape(size, old // size, *pixels.shape[1:]).mean(axis=1)
    else:
        total = np.zeros((old + 1, *pixels.shape[1:]))
        np.cumsum(pixels, axis=0, out=total[1:])
        mean = _sums_between(total, *_cell_edges(old, size)) * (size / old)
    return np.moveaxis(mean, 0, axis)


def _cell_edges(old: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the old cell of each of the ``size + 1`` new edges, and the edge's fractional position in it."""
    edges = np.arange(size + 1) * (old / size)
    cells = np.minimum(edges.astype(int), old - 1)
    return cells, (edges - cells).reshape(-1, 1, 1)


def _sums_between(total: np.ndarray, cells: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Return differences between edges of a running sum, interpolated linearly inside its cells."""
    return np.diff(total[cells] * (1 - fractions) + total[cells + 1] * fractions, axis=0)


def check_suffix(path: Path, *suffixes: str) -> None:
    """Check the name of an image to write.

    Raises:
        LodgsError: it ends with none of the suffixes.
    """
    if path.suffix.lower() not in suffixes:
        raise LodgsError(
            f"Cannot write {path}: unsupported image format.", f"End its name with {' or '.join(suffixes)}."
        )


def write_png(path: Path, codes: np.ndarray) -> None:
    """Write a PNG from display-coded (H, W, 3) or (H, W, 4) uint8 with straight alpha.

    Pillow's encoder corrupts memory after pycolmap is loaded. Format: https://www.w3.org/TR/png-3/.
    """
    height, width, channels = codes.shape
    # Filter "up" stores the difference to the row above, which compresses smooth images well.
    lines = np.empty((height, 1 + width * channels), np.uint8)
    lines[:, 0] = 2
    rows = codes.reshape(height, -1)
    lines[0, 1:], lines[1:, 1:] = rows[0], rows[1:] - rows[:-1]

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    data = zlib.compress(lines.tobytes(), 6)
    chunks = chunk(b"IHDR", head), chunk(b"sRGB", b"\0"), chunk(b"IDAT", data), chunk(b"IEND", b"")
    with name_errors(path):
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
