"""Merge trained cells, one batch of splats in memory at a time.

The result is the bundle of all cells, or the base from which a seam's training starts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ...scenes.regions import Region
from ...splats.batches import BATCH_ROWS, batch_slices
from ...splats.bundle import open_bundle, write_bundle
from ...splats.dialects import comments_from_meta, drop_undrawable
from ...splats.file_rows import FileRows
from ...splats.gaussians import Splats
from ...splats.levels import NO_SPLATS, Bundle, Level
from ...splats.ply import write_ply
from ...splats.scratch import ScratchFile
from ..folder import RunFolder
from .plan import Division, Part


def merge(division: Division, path: Path) -> list[tuple[int, int]]:
    """Write the merged bundle of all parts.

    Each level takes from each cell's part the splats inside the cell. At full detail, their colours and
    opacities come from the cell's seam. Levels that no cell has come from the coarse part.

    Args:
        division: plan whose parts are all finished.
        path: bundle to write. Temporary files of the same size are created next to it.

    Returns:
        For each cell the number of splats inside it, and of all splats of its part.

    Raises:
        LodgsError: a part is not finished, parts do not belong together, or the disk is full.
    """
    opened = [open_bundle(cell.folder.bundle) for cell in division.cells]
    first = opened[0][0]
    for cell, bundle in zip(division.cells, opened, strict=True):
        _check_compatible(cell, bundle, first)
    facts = {level.number: level.facts for head, _ in opened for level in head.levels}
    seams = {seam.number: seam for seam in division.seams}
    counts = []
    with ExitStack() as stack:
        levels = {number: stack.enter_context(ScratchFile(path.parent)) for number in sorted(facts)}
        for cell, (head, rows) in zip(division.cells, opened, strict=True):
            assert cell.region is not None
            fitted = _FittedBorder(seams[cell.number]) if cell.number in seams else None
            detail = {level.number for level in head.drawn_levels(max(rows))}
            previous = sum(map(len, levels.values()))
            for number in sorted(rows):
                for splats in _inside(rows[number], cell.region):
                    if fitted is not None and number in detail:
                        splats = fitted.fit(splats)
                    levels[number].append(splats)
            counts.append((sum(map(len, levels.values())) - previous, sum(map(len, rows.values()))))
        merged = [
            Level(number, NO_SPLATS, facts[number], rows) for number, rows in levels.items() if len(rows)
        ]
        if division.coarse is not None:
            head, rows = bundle = open_bundle(division.coarse.folder.bundle)
            _check_compatible(division.coarse, bundle, first)
            coarser = [level for level in head.levels if level.number not in facts]
            merged = [replace(level, on_disk=rows[level.number]) for level in coarser] + merged
        write_bundle(path, replace(first, levels=merged))
    return counts


def write_surroundings(division: Division, seam: Part) -> None:
    """Write the base of a seam's training unless it exists.

    The base has the splats of full detail: inside the enlarged cell those that each cell's part has within
    its own cell, outside of it those of the seam's own cell.

    Raises:
        LodgsError: a required cell is not finished, or the disk is full.
    """
    path = seam.folder.base
    if path.exists():
        return
    assert seam.region is not None
    with ScratchFile(path.parent) as base:
        meta = {}
        for cell in division.cells:
            assert cell.region is not None
            if not seam.region.overlaps(cell.region):
                continue
            head, rows = open_bundle(cell.folder.bundle)
            meta |= head.meta
            for level in head.drawn_levels(max(rows)):
                for splats in _batches(rows[level.number]):
                    nearby = seam.region.in_enlarged_cell(splats.means)
                    selected = nearby & cell.region.contains(splats.means)
                    if cell.number == seam.number:
                        selected |= ~nearby
                    base.append(replace(splats.select(selected), extras={}))
        write_ply(path, base, comments_from_meta(meta))


class _FittedBorder:
    """Splats near a cell's borders as trained by its seam, in the order of the cell's part."""

    def __init__(self, seam: Part) -> None:
        assert seam.region is not None
        self._path = seam.folder.path
        self._region = seam.region
        self._offset = 0
        _, rows = open_bundle(seam.folder.bundle)
        parts = [splats.select(seam.region.near_border(splats.means)) for splats in _batches(rows[max(rows)])]
        self._splats = Splats.concatenated(parts)

    def fit(self, splats: Splats) -> Splats:
        """Return the next splats of the cell with fitted opacities and colours."""
        border = np.flatnonzero(self._region.near_border(splats.means))
        fitted = self._splats.select(slice(self._offset, self._offset + len(border)))
        self._offset += len(border)
        if not np.array_equal(fitted.means, splats.means[border]):
            raise LodgsError(
                f"Cannot merge {self._path}: it was not trained from the current cells.",
                f"Delete its bundle, events and {RunFolder('').base.name}, and resume.",
            )
        opacity_logits, sh = splats.opacity_logits.copy(), splats.sh.copy()
        opacity_logits[border] = fitted.opacity_logits
        sh[border] = fitted.sh
        return replace(splats, opacity_logits=opacity_logits, sh=sh)


def _inside(rows: FileRows, region: Region) -> Iterator[Splats]:
    for splats in _batches(rows):
        yield splats.select(region.contains(splats.means))


def _batches(rows: FileRows) -> Iterator[Splats]:
    for batch in batch_slices(len(rows), BATCH_ROWS):
        yield drop_undrawable(rows.select(batch), rows.path)


def _check_compatible(part: Part, bundle: tuple[Bundle, Mapping[int, FileRows]], first: Bundle) -> None:
    head, rows = bundle
    if not rows or _kind(head) != _kind(first):
        raise LodgsError(
            f"Cannot merge {part.folder.path}: its method, rule, facts or local origin differ from those of "
            "other cells.",
            "Train all cells with the jobs of the same plan.",
        )


def _kind(head: Bundle) -> tuple:
    """Return the parts of a header that all parts share."""
    return head.method, head.rule, head.facts, head.origin.tolist()
