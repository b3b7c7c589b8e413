"""Blocks put together, level by level, one of them in memory at a time: what a seam's training begins with,
and the bundle of all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ...scenes.regions import Region
from ...splats.bundle import NO_SPLATS, Bundle, FileRows, Level, open_bundle, write_bundle
from ...splats.dialects import comments_from_meta, drop_undrawable
from ...splats.gaussians import Splats
from ...splats.ply import BATCH_ROWS, write_ply
from ...splats.scratch import ScratchFile
from ..folder import RunFolder
from .plan import Block, Division


def merge(division: Division, path: Path) -> list[tuple[int, int]]:
    """Writes the bundle of all parts.

    Each level has the splats of the block in whose cell they stand, with the colours and opacities that the
    block's seam gave those at full detail. What no block has are the coarse levels.

    Args:
        division: every part of it finished.
        path: of the bundle; files of its size are made beside it meanwhile.

    Returns:
        For each block how many splats were kept, and of how many.

    Raises:
        LodgsError: a part is not finished, they do not belong together, or the disk is full.
    """
    opened = [open_bundle(block.folder.bundle) for block in division.blocks]
    first = opened[0][0]
    for block, found in zip(division.blocks, opened, strict=True):
        _check_alike(block, found, first)
    facts = {level.number: level.facts for head, _ in opened for level in head.levels}
    seams = {seam.number: seam for seam in division.seams}
    kept = []
    with ExitStack() as stack:
        levels = {number: stack.enter_context(ScratchFile(path.parent)) for number in sorted(facts)}
        for block, (head, rows) in zip(division.blocks, opened, strict=True):
            assert block.region is not None
            fitted = _Fitted(seams[block.number]) if block.number in seams else None
            detail = {level.number for level in head.drawn_levels(max(rows))}
            before = sum(map(len, levels.values()))
            for number in sorted(rows):
                for splats in _cropped(rows[number], block.region):
                    if fitted is not None and number in detail:
                        splats = fitted.fit(splats)
                    levels[number].append(splats)
            kept.append((sum(map(len, levels.values())) - before, sum(map(len, rows.values()))))
        made = [Level(number, NO_SPLATS, facts[number], rows) for number, rows in levels.items() if len(rows)]
        if division.coarse is not None:
            head, rows = found = open_bundle(division.coarse.folder.bundle)
            _check_alike(division.coarse, found, first)
            coarser = [level for level in head.levels if level.number not in facts]
            made = [replace(level, on_disk=rows[level.number]) for level in coarser] + made
        write_bundle(path, replace(first, levels=made))
    return kept


def write_surroundings(division: Division, seam: Block) -> None:
    """Writes what the training of a seam begins with, if it is not there yet.

    That is, at full detail, what stands in the enlarged cell, each splat from the block in whose cell it
    stands; and beyond it what the cell's own block has learned of what its views see there.

    Raises:
        LodgsError: a block that is needed is not finished, or the disk is full.
    """
    path = seam.folder.base
    if path.exists():
        return
    assert seam.region is not None
    with ScratchFile(path.parent) as found:
        meta = {}
        for block in division.blocks:
            assert block.region is not None
            if not seam.region.overlaps(block.region):
                continue
            head, rows = open_bundle(block.folder.bundle)
            meta |= head.meta
            for level in head.drawn_levels(max(rows)):
                for splats in _pieces(rows[level.number]):
                    around = seam.region.in_enlarged_cell(splats.means)
                    chosen = around & block.region.contains(splats.means)
                    if block.number == seam.number:
                        chosen |= ~around
                    found.append(replace(splats.select(chosen), extras={}))
        write_ply(path, found, comments_from_meta(meta))


class _Fitted:
    """What a seam has made of the splats at its cell's borders, in the order in which the block has them."""

    def __init__(self, seam: Block) -> None:
        assert seam.region is not None
        self._path, self._region, self._taken = seam.folder.path, seam.region, 0
        _, rows = open_bundle(seam.folder.bundle)
        parts = [splats.select(seam.region.near_border(splats.means)) for splats in _pieces(rows[max(rows)])]
        self._splats = Splats.concatenated(parts)

    def fit(self, splats: Splats) -> Splats:
        """The next splats of the cell, with fitted opacities and colours."""
        where = np.flatnonzero(self._region.near_border(splats.means))
        found = self._splats.select(slice(self._taken, self._taken + len(where)))
        self._taken += len(where)
        if not np.array_equal(found.means, splats.means[where]):
            raise LodgsError(
                f"{self._path} was not trained from the blocks that are there.",
                f"Delete its bundle, events and {RunFolder('').base.name}, and go on.",
            )
        opacity_logits, sh = splats.opacity_logits.copy(), splats.sh.copy()
        opacity_logits[where], sh[where] = found.opacity_logits, found.sh
        return replace(splats, opacity_logits=opacity_logits, sh=sh)


def _cropped(rows: FileRows, region: Region) -> Iterator[Splats]:
    for splats in _pieces(rows):
        yield splats.select(region.contains(splats.means))


def _pieces(rows: FileRows) -> Iterator[Splats]:
    for begin in range(0, len(rows), BATCH_ROWS):
        yield drop_undrawable(rows.select(slice(begin, begin + BATCH_ROWS)), rows.path)


def _check_alike(block: Block, found: tuple[Bundle, Mapping[int, FileRows]], first: Bundle) -> None:
    head, rows = found
    if not rows or (head.method, head.rule, head.facts) != (first.method, first.rule, first.facts):
        raise LodgsError(
            f"{block.folder.path} is of another kind than the other blocks.",
            "Train all blocks with the jobs of one plan.",
        )
