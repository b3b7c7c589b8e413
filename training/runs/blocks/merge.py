"""Blocks put together: of each the splats in its own cell, level by level, one block in memory at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from ...errors import LodgsError
from ...splats.bundle import NO_SPLATS, Level, open_bundle, write_bundle
from ...splats.ply import AT_ONCE
from ...splats.scratch import Scratch
from .plan import Block


def merge(blocks: Sequence[Block], path: Path) -> list[tuple[int, int]]:
    """Writes the bundle of all blocks' splats, each from the block in whose cell it stands.

    Args:
        blocks: all finished.
        path: of the bundle; files of its size are made beside it meanwhile.

    Returns:
        For each block how many splats were kept, and of how many.

    Raises:
        LodgsError: a block is not finished, they do not belong together, or the disk is full.
    """
    heads = [open_bundle(block.folder.bundle) for block in blocks]
    first = heads[0][0]
    numbers = sorted({number for _, rows in heads for number in rows})
    for block, (head, rows) in zip(blocks, heads, strict=True):
        same = (head.method, head.rule, head.facts) == (first.method, first.rule, first.facts)
        if not same or not rows:
            raise LodgsError(
                f"{block.folder.path} is of another kind than {blocks[0].folder.path}.",
                "Train all blocks with the jobs of one plan.",
            )
    kept = []
    with ExitStack() as stack:
        levels = {number: stack.enter_context(Scratch(path.parent)) for number in numbers}
        for block, (_, rows) in zip(blocks, heads, strict=True):
            kept.append((0, sum(map(len, rows.values()))))
            for number, those in rows.items():
                for begin in range(0, len(those), AT_ONCE):
                    splats = those.select(slice(begin, begin + AT_ONCE))
                    splats = splats.select(block.region.contains(splats.means))
                    levels[number].append(splats)
                    kept[-1] = kept[-1][0] + len(splats), kept[-1][1]
        facts = {level.number: level.facts for head, _ in heads for level in head.levels}
        write_bundle(path, replace(first, levels=[
            Level(number, NO_SPLATS, facts[number], rows) for number, rows in levels.items() if len(rows)
        ]))  # fmt: skip
    return kept
