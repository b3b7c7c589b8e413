"""Export of splats to files for other programs, shared by Blender and both command lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..settings import setting, settings_of
from ..splats.formats import find_format, write_splats
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
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


EXPORT_OPTIONS = settings_of(ExportOptions)
"""The settings of exports, by name."""


def export_finest_level(path: Path, bundle: Bundle, antialiased: bool = False) -> Iterator[str]:
    """Write the finest level of a bundle in the format of the file name.

    Args:
        antialiased: keep opacities as trained; otherwise bake the filter into them
            (:func:`.bake_filter.bake_filter`), except in formats that record the filter.

    Yields:
        Progress messages, as :func:`..splats.formats.write_splats`.

    Raises:
        LodgsError: as :func:`..splats.formats.write_splats`.
    """
    if not (antialiased or find_format(path).antialiased):
        bundle = bake_filter(bundle)
    yield from write_splats(path, ConcatenatedRows.of_level(bundle, bundle.levels[-1].number), bundle.meta)


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
