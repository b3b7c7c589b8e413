"""Export of splats to files for other programs, shared by Blender and both command lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..settings import setting, settings_of
from ..splats.coding import MAX_CODES
from ..splats.dialects import comments_from_meta
from ..splats.formats import PLY, find_format, write_splats
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
from ..splats.origin import NO_ORIGIN
from ..splats.ply import write_ply
from .bake_filter import bake_filter


@dataclass(frozen=True)
class ExportOptions:
    """Options of exports in Blender's dialogs and in both command lines."""

    placed: bool = setting(
        False,
        "Apply the scene's location, rotation and scale in Blender; otherwise keep COLMAP's coordinates. "
        "Transforms of single levels and instances are ignored.",
        label="As Placed",
    )
    looked: bool = setting(
        True,
        "Apply the colours and opacities of the Look panel; otherwise export the splats as trained.",
        label="With Look",
    )
    antialiased: bool = setting(
        False,
        "Keep opacities as trained, for viewers with Mip-Splatting's filter; otherwise bake the filter for "
        "other viewers, which would draw small splats too bold. SPZ files store this choice themselves.",
    )
    original_place: bool = setting(
        False,
        "Write a georeferenced scene at its original place, with positions in double precision; otherwise "
        "relative to its local origin. PLY only.",
        label="Original Place",
    )


EXPORT_OPTIONS = settings_of(ExportOptions)
"""The settings of exports, by name."""


@dataclass(frozen=True)
class Compression:
    """Settings of a compression."""

    prune: float = setting(
        0.2,
        "Fraction of each level's splats to remove: those of least significance in the training views.",
        high=0.99,
    )
    distill_steps: int = setting(
        100,
        "Steps that train each level's remaining splats to show the same images as before. Increase it "
        "with the removed fraction.",
        unit="steps",
    )
    sh_degree: int = setting(
        3, "Highest degree of spherical harmonics to keep. Lower ones hardly make the file smaller.",
        label="SH Degree", high=4,
    )  # fmt: skip
    codes: int = setting(
        4096, "Number of sets of spherical harmonics that all splats share.", low=1, high=MAX_CODES
    )


COMPRESSION_SETTINGS = settings_of(Compression)
"""The settings of compressed bundles, by name."""


def export_finest_level(
    path: Path, bundle: Bundle, antialiased: bool = False, original_place: bool = False
) -> Iterator[str]:
    """Write the finest level of a bundle in the format of the file name.

    Args:
        antialiased: keep opacities as trained; otherwise bake the filter into them
            (:func:`.bake_filter.bake_filter`), except in formats that record the filter.
        original_place: add the local origin, see :class:`ExportOptions`.

    Yields:
        Progress messages, as :func:`..splats.formats.write_splats`.

    Raises:
        LodgsError: as :func:`..splats.formats.write_splats`, or the format has no double precision.
    """
    origin = bundle.origin if original_place else NO_ORIGIN
    if origin.any() and find_format(path) is not PLY:
        raise LodgsError(
            f"Cannot write {path} at the original place: only PLY has positions in double precision.",
            "Write a PLY, or keep the local origin.",
        )
    if not (antialiased or find_format(path).antialiased):
        bundle = bake_filter(bundle)
    rows = ConcatenatedRows.of_level(bundle, bundle.levels[-1].number)
    if origin.any():
        meta = {name: value for name, value in bundle.meta.items() if name != "origin"}
        write_ply(path, rows, comments_from_meta(meta), origin)
        return
    yield from write_splats(path, rows, bundle.meta)


def run_to_end(steps: Iterator[str]) -> None:
    """Exhaust an iterator of progress messages."""
    for _ in steps:
        pass


@dataclass(frozen=True)
class ConcatenatedRows:
    """Several sets of splats on disk as one."""

    sets: Sequence[SplatRows]

    @classmethod
    def of_level(cls, bundle: Bundle, number: int) -> ConcatenatedRows:
        """Return all splats that are drawn at a level."""
        return cls([level.rows for level in bundle.drawn_levels(number)])

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Read a range of all rows."""
        assert isinstance(index, slice)
        begin, end, _ = index.indices(len(self))
        parts, first = [], 0
        for rows in self.sets:
            parts.append(rows.select(slice(max(begin - first, 0), max(min(end - first, len(rows)), 0))))
            first += len(rows)
        return Splats.concatenated(parts)
