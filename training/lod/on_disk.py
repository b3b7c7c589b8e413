"""Splats of a level that stay in their file: of them is read what one camera may see. numpy only."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..scenes.cameras import Camera
from ..splats.bundle import open_bundle, read_header
from ..splats.dialects import Warn, drop_undrawable, dropped_message, ignore
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
from .blocks import SIZE, Blocks
from .query import LodQuery
from .rule import Rule, find_rule
from .selection import rule_columns

MAX_IN_MEMORY = 4_000_000
"""Splats of a file that are all kept in memory, where nothing else is said: 1 GB of degree 3."""
_ANYWHERE = np.float32(1e15)
"""Farther than any splat is drawn."""
_AT_ONCE = 64 * SIZE
"""Splats that are looked at together when their places are found."""
_GAP = 4
"""So many blocks and fewer are read with those on both sides of them: less work than beginning again."""
_SPARE = 2
"""What has been read is kept as long as it is no more than so many times what a camera may see."""


def supports_culled_reads(rule: str) -> bool:
    """Whether levels of a rule can be drawn by those splats alone that a camera may see."""
    found = find_rule(rule)
    return found is not None and found.apart and not found.tables


def open_if_large(path: str | Path, most: int = 0) -> Bundle | None:
    """A bundle of many splats, with its tables, whose levels are elsewhere: in their file.

    None where it has fewer, or is another PLY, or its rule has to know of all splats at once or of regions.

    Args:
        most: splats that are not yet many; 0: IN_MEMORY.

    Raises:
        LodgsError: as ``read_bundle``.
    """
    if not supports_culled_reads(read_header(path).rule):
        return None
    bundle, rows = open_bundle(path)
    if sum(map(len, rows.values())) <= (most or MAX_IN_MEMORY):
        return None
    for level in bundle.levels:
        level.on_disk = rows[level.number]
    return bundle


class CulledReader:
    """A level's splats in blocks of rows, of which it is known where they are; all are read once for it.

    Args:
        rows: in an order in which neighbours come near each other, or few blocks are out of sight.
        rule: the levels' own, or None.
        path: of the file, for warnings.

    Attributes:
        count: how many splats have been read.
    """

    def __init__(
        self, rows: SplatRows, rule: Rule | None = None, path: object = "", warn: Warn = ignore
    ) -> None:
        self._rows, self._rule, self._path = rows, rule, str(path)
        parts, of_columns, undrawable = [], [], 0
        for begin in range(0, len(rows), _AT_ONCE):
            splats = rows.select(slice(begin, begin + _AT_ONCE))
            missing = len(splats) - len(drop_undrawable(splats, self._path))
            undrawable += missing
            blocks = Blocks.of(splats.means, splats.log_scales)
            if missing:  # no numbers to go by
                blocks.low[:], blocks.high[:] = -_ANYWHERE, _ANYWHERE
            parts.append((blocks.low, blocks.high, blocks.reach))
            columns = {} if rule is None else rule_columns(rule, splats)
            of_columns.append({name: blocks.highest(column) for name, column in columns.items()})
        if undrawable:
            warn(dropped_message(undrawable, self._path))
        none = Blocks.of(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
        low, high, reach = (
            np.concatenate([getattr(none, name), *(part[i] for part in parts)])
            for i, name in enumerate(("low", "high", "reach"))
        )
        self._blocks = Blocks(len(rows), low, high, reach)
        names = of_columns[0] if of_columns else {}
        self._highest = {name: np.concatenate([each[name] for each in of_columns]) for name in names}
        self._held: np.ndarray | None = None
        self.count = len(rows)

    def __len__(self) -> int:
        return len(self._rows)

    def missing(self, camera: Camera, choice: LodQuery | None = None) -> np.ndarray | None:
        """The blocks (B,) bool of all splats that a camera has in its image and, by a choice, a weight; None
        where what was read last will do."""
        wanted = self._blocks.in_view(camera, 0.0)
        if choice is not None and self._rule is not None and self._rule.apart and choice.region() is None:
            eye = np.array(choice.eye, np.float32)
            wanted &= self._blocks.between(eye, *choice.distance_band(self._highest))[0]
        most = max(_SPARE * np.count_nonzero(wanted), _AT_ONCE // SIZE)
        if self._held is not None and not (wanted & ~self._held).any() and self._held.sum() <= most:
            return None
        return wanted

    def read(self, blocks: np.ndarray) -> Splats:
        """The splats of blocks (B,), and of few between them, in the order of their rows."""
        parts, self._held = [], np.zeros_like(blocks)
        for begin, end in _runs(blocks):
            parts.append(self._rows.select(slice(begin * SIZE, end * SIZE)))
            self._held[begin:end] = True
        splats = Splats.concatenated(parts) if parts else self._rows.select(slice(0, 0))
        self.count += len(splats)
        return drop_undrawable(splats, self._path)


def read_visible(bundle: Bundle, camera: Camera) -> Bundle:
    """A bundle in memory as far as a camera may see it."""
    levels = []
    for level in bundle.levels:
        sight = CulledReader(level.rows)
        blocks = sight.missing(camera)
        assert blocks is not None, "nothing has been read yet"
        levels.append(replace(level, splats=sight.read(blocks), on_disk=None))
    return replace(bundle, levels=levels)


def _runs(wanted: np.ndarray) -> list[tuple[int, int]]:
    """Where blocks (B,) begin and end that are read together."""
    some = np.flatnonzero(wanted)
    if not len(some):
        return []
    breaks = np.flatnonzero(np.diff(some) > _GAP) + 1
    borders = pairwise([0, *breaks.tolist(), len(some)])
    return [(int(some[begin]), int(some[end - 1]) + 1) for begin, end in borders]
