"""A rendered picture, in the colours of the display or in linear light, as PNG and multilayer EXR."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import atomic_write
from ..scenes.color import linear_from_srgb
from ..scenes.exr import read_parts, write_exr
from ..scenes.images import write_png

NO_DEPTH = 1e10
"""Depth where a pixel shows nothing, as Blender's renderers say it."""

_DEPTH = re.compile(r"(.*\.)?depth(\.[a-z])?|z|v", re.IGNORECASE)
"""Names of channels that hold a depth: a layer's Depth.Z or Depth.V, or a file's own Z or V."""

_STRIP = 1 << 20
"""Pixels that are coded at a time, about."""

_CLEAR = 0.02
"""Part of an 8-bit step that linear colours keep from the borders between two 8-bit values."""


@dataclass
class RenderedImage:
    """What a camera sees.

    Attributes:
        image: (H, W, 3) float32, display-coded (sRGB) colours over the background; over black, and so
            multiplied by alpha, where that is transparent. Not clamped above.
        alpha: (H, W) float32; ones unless the background is transparent, or held out.
        depth: (H, W) float32 along the camera's z axis in world units: of the splat that brings the light
            let through to a half, or where none does the mean of all; NOTHING where there is none. Empty
            where the pass was not drawn.
        levels: number of each of the masks.
        masks: (L, H, W) float32, how much of a pixel each level fills.
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
        """A picture of nothing but the background."""
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
        """(H, W) float32, the number of the level that fills most of a pixel; 0 where nothing does."""
        if not self.levels:
            return np.zeros(self.alpha.shape, np.float32)
        most = np.array(self.levels, np.float32)[self.masks.argmax(0)]
        return np.where(self.masks.max(0) > 0, most, np.float32(0))

    def eight_bit(self) -> np.ndarray:
        """(H, W, 3) uint8, or (H, W, 4) where something is transparent; colours not multiplied by alpha."""
        codes = np.empty((*self.alpha.shape, 3 if (self.alpha == 1).all() else 4), np.uint8)
        for rows in self._strips():
            values = np.concatenate([self._straight(rows), self.alpha[rows, :, None]], 2).astype(np.float64)
            codes[rows] = np.floor(values.clip(0, 1) * 255 + 0.5)[..., : codes.shape[2]]
        return codes

    def linear(self) -> np.ndarray:
        """(H, W, 4) float32, colours in linear light multiplied by alpha, and alpha.

        The colours under the alpha are decoded, as a display transform will code them. They and the alpha
        are first moved away, by 0.02 of an 8-bit step at most, from where rounding to 8 bits turns over: so
        whoever codes them again has the 8 bits of :meth:`eight_bit`, however exact their arithmetic is.
        """
        linear = np.empty((*self.alpha.shape, 4), np.float32)
        for rows in self._strips():
            alpha = _clear(self.alpha[rows, :, None].astype(np.float64)).clip(0, 1)
            colours = _clear(self._straight(rows).astype(np.float64)).clip(0)
            linear[rows, :, :3], linear[rows, :, 3:] = linear_from_srgb(colours) * alpha, alpha
        return linear

    def passes(self) -> dict[str, np.ndarray]:
        """Planes (H, W) by name as Blender calls them: Combined.R to .A, Depth.Z, Level.X, Level 1.X, ..."""
        combined = self.linear()
        planes = {f"Combined.{channel}": combined[..., i] for i, channel in enumerate("RGBA")}
        if self.depth.size:
            planes["Depth.Z"] = self.depth
        if self.levels:
            planes["Level.X"] = self.level
            planes |= {f"Level {n}.X": mask for n, mask in zip(self.levels, self.masks, strict=True) if n}
        return planes

    def _straight(self, rows: slice) -> np.ndarray:
        """Colours (H, W, 3) of some rows not multiplied by alpha, float32."""
        image, alpha = self.image[rows], self.alpha[rows, :, None]
        return np.divide(image, alpha, out=np.zeros_like(image), where=alpha > 0)

    def _strips(self) -> Iterator[slice]:
        """Rows that are worked on together, which takes some 200 bytes a pixel for a while."""
        height, width = self.alpha.shape
        step = max(_STRIP // width, 1)
        return (slice(top, top + step) for top in range(0, height, step))


def _clear(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1], moved off the borders between two 8-bit ones; those that are 0 or 1 stay."""
    codes = values * 255
    rest = codes - np.floor(codes) - 0.5
    return (codes + np.where(rest >= 0, np.maximum(_CLEAR - rest, 0), np.minimum(-_CLEAR - rest, 0))) / 255


def write_image(path: Path, picture: RenderedImage) -> None:
    """Writes a PNG, or a multilayer EXR with every pass, by the file's ending.

    Raises:
        LodgsError: another ending, or the file cannot be written.
    """
    writers = {".png": lambda to, shown: write_png(to, shown.eight_bit()), ".exr": _write_exr}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise LodgsError(f"{path.name} is neither .png nor .exr.", "Choose one of these endings.")
    with atomic_write(path) as temporary:
        writer(temporary, picture)


def read_depth(path: Path, width: int, height: int, window: tuple[int, int, int, int] | None) -> np.ndarray:
    """The Depth pass of an EXR as Blender's renderers and its compositor write it, (H, W) float32.

    Of several layers' depths the nearest counts in each pixel.

    Args:
        width, height: of the whole picture; an EXR of the window alone is taken as well.
        window: left, top, width and height of the part that is wanted; None: all.

    Raises:
        LodgsError: it cannot be read, has no depth, or is of another size.
    """
    if not path.is_file():
        raise LodgsError(f"There is no mesh depth {path}.", "Render it, or take the holdout away.")
    try:
        parts = read_parts(path)
        found = [
            np.asarray(plane, np.float32)
            for part, _, planes in parts
            for name, plane in planes.items()
            if _DEPTH.fullmatch(name) and (len(name) > 1 or len(parts) == 1 or _DEPTH.fullmatch(part))
        ]
    except (RuntimeError, OSError, ValueError, KeyError, TypeError) as error:
        raise LodgsError(f"{path.name} cannot be read as an EXR: {error}.", "Render it anew.") from error
    if not found or any(plane.shape != found[0].shape for plane in found):
        raise LodgsError(
            f"{path.name} has no Depth pass.", "Tick Depth among its view layer's passes and render it anew."
        )
    depth = np.nan_to_num(np.fmin.reduce(found), nan=NO_DEPTH, posinf=NO_DEPTH)  # half floats have no 1e10
    left, top, across, up = window or (0, 0, width, height)
    if depth.shape == (height, width):
        return depth[top : top + up, left : left + across]
    if depth.shape == (up, across):
        return depth
    raise LodgsError(
        f"{path.name} has {depth.shape[1]}x{depth.shape[0]} pixels, the picture {width}x{height}.",
        "Render the meshes' depth in the picture's size.",
    )


def _write_exr(path: Path, picture: RenderedImage) -> None:
    write_exr(path, {f"LODGS.{name}": plane for name, plane in picture.passes().items()})
