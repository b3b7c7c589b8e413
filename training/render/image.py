"""Rendered images, display-coded or linear, as PNG and multilayer EXR."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..color import linear_from_srgb
from ..errors import LodgsError
from ..files import atomic_write
from ..scenes.exr import read_parts, write_exr
from ..scenes.images import check_suffix, write_png

SUFFIXES = ".png", ".exr"
"""Endings of the images that can be written."""

NO_DEPTH = 1e10
"""Depth of empty pixels, as in Blender's renderers."""

_DEPTH = re.compile(r"(.*\.)?depth(\.[a-z])?|z|v", re.IGNORECASE)
"""Names of depth channels: a layer's Depth.Z or Depth.V, or a file's Z or V."""

_STRIP_PIXELS = 1 << 20
"""Approximate number of pixels that are coded at a time."""

_ROUNDING_MARGIN = 0.02
"""Distance of linear colours to the rounding thresholds of 8-bit values, in 8-bit steps."""


@dataclass
class RenderedImage:
    """A rendered image with its passes.

    Attributes:
        image: (H, W, 3) float32, display-coded (sRGB) colours over the background. Over a transparent
            background they are multiplied by alpha. Not clamped above.
        alpha: (H, W) float32; ones unless the background is transparent or held out.
        depth: (H, W) float32 along the camera's z axis in world units: the depth at which half of the light
            is stopped, or the mean depth if less is stopped, or NO_DEPTH. Empty if the pass was not drawn.
        levels: level number of each mask.
        masks: (L, H, W) float32, share of each pixel that a level covers.
    """

    image: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    levels: list[int]
    masks: np.ndarray

    @classmethod
    def empty(
        cls,
        width: int,
        height: int,
        background: tuple[float, float, float] | None,
        depth: bool = False,
        levels: list[int] | None = None,
    ) -> RenderedImage:
        """Create an image of the background.

        Args:
            width, height: size in pixels.
            background: display-coded colour; None is transparent.
            depth: whether the image has a depth pass.
            levels: numbers of the levels with a mask.
        """
        shape = height, width
        image = np.empty((*shape, 3), np.float32)
        image[:] = background or (0.0, 0.0, 0.0)
        return cls(
            image=image,
            alpha=np.full(shape, 0.0 if background is None else 1.0, np.float32),
            depth=np.full(shape if depth else (0, 0), NO_DEPTH, np.float32),
            levels=levels or [],
            masks=np.zeros((len(levels or []), *shape), np.float32),
        )

    @property
    def level(self) -> np.ndarray:
        """Number of the level that covers most of each pixel, (H, W) float32; 0 for empty pixels."""
        if not self.levels:
            return np.zeros(self.alpha.shape, np.float32)
        dominant = np.array(self.levels, np.float32)[self.masks.argmax(0)]
        return np.where(self.masks.max(0) > 0, dominant, np.float32(0))

    def eight_bit(self) -> np.ndarray:
        """Convert to (H, W, 3) uint8, or (H, W, 4) with straight alpha if a pixel is transparent."""
        codes = np.empty((*self.alpha.shape, 3 if (self.alpha == 1).all() else 4), np.uint8)
        for rows in self._strips():
            values = np.concatenate([self.straight(rows), self.alpha[rows, :, None]], 2).astype(np.float64)
            codes[rows] = np.floor(values.clip(0, 1) * 255 + 0.5)[..., : codes.shape[2]]
        return codes

    def linear(self) -> np.ndarray:
        """Convert to (H, W, 4) float32: linear colours multiplied by alpha, and alpha.

        Straight colours are decoded, because a display transform encodes them. Colours and alpha first move
        away from 8-bit rounding thresholds by at most 0.02 of an 8-bit step. So programs that encode them
        again obtain the 8 bits of :meth:`eight_bit`, even with inexact arithmetic.
        """
        linear = np.empty((*self.alpha.shape, 4), np.float32)
        for rows in self._strips():
            alpha = _avoid_thresholds(self.alpha[rows, :, None].astype(np.float64)).clip(0, 1)
            colors = _avoid_thresholds(self.straight(rows).astype(np.float64)).clip(0)
            linear[rows, :, :3], linear[rows, :, 3:] = linear_from_srgb(colors) * alpha, alpha
        return linear

    def passes(self) -> dict[str, np.ndarray]:
        """Return planes (H, W) by their Blender names: Combined.R to .A, Depth.Z, Level.X, Level 1.X, ..."""
        combined = self.linear()
        planes = {f"Combined.{channel}": combined[..., i] for i, channel in enumerate("RGBA")}
        if self.depth.size:
            planes["Depth.Z"] = self.depth
        if self.levels:
            planes["Level.X"] = self.level
            planes |= {f"Level {n}.X": mask for n, mask in zip(self.levels, self.masks, strict=True) if n}
        return planes

    def straight(self, rows: slice = slice(None)) -> np.ndarray:
        """Return straight colours (H, W, 3) of a range of rows, float32: not multiplied by alpha."""
        image, alpha = self.image[rows], self.alpha[rows, :, None]
        return np.divide(image, alpha, out=np.zeros_like(image), where=alpha > 0)

    def _strips(self) -> Iterator[slice]:
        """Return ranges of rows that are converted together, with about 200 temporary bytes per pixel."""
        height, width = self.alpha.shape
        step = max(_STRIP_PIXELS // width, 1)
        return (slice(top, top + step) for top in range(0, height, step))


def _avoid_thresholds(values: np.ndarray) -> np.ndarray:
    """Move values in [0, 1] away from the rounding thresholds of 8-bit values; 0 and 1 stay."""
    codes = values * 255
    offset = codes - np.floor(codes) - 0.5
    above = np.maximum(_ROUNDING_MARGIN - offset, 0)
    below = np.minimum(-_ROUNDING_MARGIN - offset, 0)
    return (codes + np.where(offset >= 0, above, below)) / 255


def write_image(path: Path, image: RenderedImage) -> None:
    """Write a PNG, or a multilayer EXR with every pass, depending on the suffix.

    Raises:
        LodgsError: the suffix is not supported, or the file cannot be written.
    """
    check_suffix(path, *SUFFIXES)
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".png":
            write_png(temporary, image.eight_bit())
        else:
            write_exr(temporary, {f"LODGS.{name}": plane for name, plane in image.passes().items()})


def read_depth(path: Path, width: int, height: int, window: tuple[int, int, int, int] | None) -> np.ndarray:
    """Read the Depth pass of an EXR from Blender's renderers or compositor, (H, W) float32.

    If several layers have depths, the nearest counts in each pixel.

    Args:
        width, height: size of the full image; the EXR may have the size of the window instead.
        window: left, top, width and height of the part to return; None means all.

    Raises:
        LodgsError: the file cannot be read, has no depth, or has another size.
    """
    if not path.is_file():
        raise LodgsError(
            f"Cannot read the mesh depth {path}: it does not exist.", "Render it, or remove the holdout."
        )
    try:
        parts = read_parts(path)
        planes = [
            np.asarray(plane, np.float32)
            for part, _, channels in parts
            for name, plane in channels.items()
            if _DEPTH.fullmatch(name) and (len(name) > 1 or len(parts) == 1 or _DEPTH.fullmatch(part))
        ]
    except (RuntimeError, OSError, ValueError, KeyError, TypeError) as error:
        raise LodgsError(f"Cannot read {path.name} as an EXR: {error}.", "Render it again.") from error
    if not planes or any(plane.shape != planes[0].shape for plane in planes):
        raise LodgsError(
            f"Cannot use {path.name} as a holdout: it has no Depth pass.",
            "Enable the Depth pass of its view layer and render it again.",
        )
    depth = np.nan_to_num(np.fmin.reduce(planes), nan=NO_DEPTH, posinf=NO_DEPTH)  # half floats have no 1e10
    left, top, window_width, window_height = window or (0, 0, width, height)
    if depth.shape == (height, width):
        return depth[top : top + window_height, left : left + window_width]
    if depth.shape == (window_height, window_width):
        return depth
    raise LodgsError(
        f"Cannot use {path.name} as a holdout: its size is {depth.shape[1]}x{depth.shape[0]} pixels, "
        f"that of the image {width}x{height}.",
        "Render the depth of the meshes in the size of the image.",
    )
