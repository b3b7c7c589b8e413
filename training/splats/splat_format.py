"""Declaration of a file format for splats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..errors import LodgsError
from .gaussians import SplatRows
from .portable_levels import PortableLevels


class NeedsTrainer(LodgsError):
    """Raised for files that need a package which this Python lacks and the trainer has."""


class SplatFormat(NamedTuple):
    """A file format for the splats of one level.

    Attributes:
        suffix: end of the file name.
        label: name in menus.
        about: tooltip in menus.
        splat_bytes: bytes per splat for each SH degree from 0 on. For formats that compress by content, these
            are averages of trained scenes (``docs/reference/formats.md``).
        max_degree: highest SH degree that the format stores. Writers drop or refuse a higher one
            (:func:`require_degree`).
        palette_size: maximum number of coefficient sets, a power of two, if splats share sets of SH
            coefficients; else 0.
        antialiased: True if the format stores that splats need Mip-Splatting's 2D filter.
        write: function that writes splats with the meta of their bundle.
        read: function that reads splats and meta of a file; None for PLY. It may raise
            :class:`NeedsTrainer`.
        write_levels: function that writes all levels for selection by distance; None if the format has none.
            It replaces ``write``.
        read_levels: function that converts a file with levels to a bundle, with the splats that cannot be
            drawn, which readers of bundles drop; it replaces ``read``.
        require: function that raises a LodgsError without the packages of the format, which Blender lacks;
            None if it needs none.
        readable: False if files cannot be imported.
        georeferenced: True if the format stores the scene's georeference.
    """

    suffix: str
    label: str
    about: str
    splat_bytes: tuple[float, ...]
    max_degree: int
    palette_size: int = 0
    antialiased: bool = False
    write: Callable[[Path, SplatRows, dict], None] | None = None
    read: Callable[[Path], tuple[SplatRows, dict]] | None = None
    write_levels: Callable[[Path, PortableLevels], None] | None = None
    read_levels: Callable[[Path, Path], None] | None = None
    require: Callable[[], object] | None = None
    readable: bool = True
    georeferenced: bool = False

    @property
    def in_trainer(self) -> bool:
        """True if only the trainer reads and writes the format."""
        return self.require is not None

    def size(self, count: int, degree: int) -> float:
        """Estimate the file size of splats in bytes."""
        degree = min(degree, len(self.splat_bytes) - 1)
        palette = min(1 << count.bit_length() - 1, self.palette_size) if count else 0
        return count * self.splat_bytes[degree] + 0.88 * palette * higher_coefficients(degree)


def require_degree(splats: SplatRows, max_degree: int, label: str) -> int:
    """Return the degree of the splats' spherical harmonics.

    Raises:
        LodgsError: it is above ``max_degree`` of the format with the label.
    """
    degree = splats.select(slice(0, 0)).sh_degree
    if degree > max_degree:
        raise LodgsError(
            f"Cannot write SH degree {degree} as {label}: the maximum is {max_degree}.",
            f"Write a PLY, or reduce the degree with lodgs compress --sh-degree {max_degree}.",
        )
    return degree


def higher_coefficients(degree: int) -> int:
    """Return the number of SH coefficients of three channels beyond the base colour."""
    return 3 * ((degree + 1) ** 2 - 1)
