"""Levels on disk: read only some levels, or the splats of a region or a camera. numpy only."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..scenes.cameras import Camera
from ..splats.bundle import open_bundle, read_bundle, read_header, read_tables
from ..splats.dialects import Warn, drop_undrawable, dropped_message, ignore
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
from ..splats.ply import extra_columns
from ..splats.ply import splat_columns as columns_in_file
from .blocks import BLOCKS, BOUNDS, SIZE, BlockIndex
from .query import LodQuery, PagedFile
from .rule import Region, Rule, find_rule, resolve_rule
from .selection import require_rule, rule_columns

MAX_IN_MEMORY = 4_000_000
"""Default maximum number of splats of a file that is kept in memory as a whole: 1 GB at degree 3."""
_FAR = np.float32(1e15)
"""Coordinate beyond every drawable splat."""
_BATCH = 64 * SIZE
"""Splats per batch of the first pass over a file."""
_GAP = 4
"""Maximum number of blocks in a gap that is read along with its neighbours instead of skipped."""
_MAX_SURPLUS = 2
"""Maximum number of blocks in memory, as a multiple of those that a camera can see."""


def read_header_and_tables(path: str | Path) -> Bundle:
    """Return a bundle with its tables and levels, but without splats.

    Raises:
        LodgsError: see ``read_bundle``.
    """
    return replace(read_header(path), tables=read_tables(path))


def read_part(
    path: str | Path, numbers: Collection[int], region: Region | None = None, warn: Warn = ignore
) -> tuple[Bundle, int]:
    """Read some levels of a bundle, or their splats that are visible in a region.

    Skips blocks without such splats. Splats keep the file's order; other levels are empty.

    Args:
        numbers: numbers of the levels.
        region: region of the splats. None reads all splats, and so does a file without a table of blocks.
        warn: see ``read_bundle``.

    Returns:
        The bundle, and the number of bytes read.

    Raises:
        LodgsError: see ``read_bundle``; or there is a region, but the rule is unknown.
    """
    size = 0

    def rows_of(bundle: Bundle) -> dict[int, np.ndarray]:
        nonlocal size
        size = sum(column.nbytes for table in bundle.tables.values() for column in table.values())
        rows = {level.number: np.zeros(0, np.int64) for level in bundle.levels if level.number not in numbers}
        table = bundle.tables.get(BLOCKS)
        if table is None or region is None:
            return rows
        index = BlockIndex.from_table(table)
        if index is None:
            return rows
        rule, zeros = require_rule(bundle), np.zeros(len(index), np.float32)
        columns = {name: index.columns.get(name, zeros) for name in rule.columns}
        level_rows = index.level_rows(rule.visible_in_region(columns, region))
        rows |= {number: level_rows.get(number, np.zeros(0, np.int64)) for number in numbers}
        return rows

    bundle = read_bundle(path, warn, rows_of)
    rule = None if region is None or BLOCKS not in bundle.tables else require_rule(bundle)
    for level in bundle.levels:
        columns = columns_in_file(level.splats) | extra_columns(level.splats)
        size += sum(column.dtype.itemsize for column in columns.values()) * len(level.splats)
        if rule is not None and region is not None:
            visible = rule.visible_in_region(rule_columns(rule, level.splats), region)
            level.splats = level.splats.select(visible)
    return bundle, size


def open_paged(path: str | Path) -> PagedFile:
    """Open a bundle whose rule allows reads of only the part that a camera needs.

    Raises:
        LodgsError: see ``read_bundle``, or the rule allows no such reads.
    """
    name = read_header(path).rule
    paged_file = resolve_rule(name).paged_file
    if paged_file is None:
        raise LodgsError(
            f"Cannot read {path} in pages: "
            + (f"its rule '{name}' needs the complete file." if name else "it has no rule."),
            "Open the file completely.",
        )
    return paged_file(Path(path))


def supports_culled_reads(rule: str) -> bool:
    """Return whether levels of a rule can be drawn from only the splats that a camera can see."""
    resolved = find_rule(rule)
    return resolved is not None and resolved.independent and not resolved.tables


def open_if_large(path: str | Path, limit: int = 0) -> Bundle | None:
    """Open a bundle with more splats than a limit; its levels stay on disk.

    Args:
        limit: number of splats; 0 means MAX_IN_MEMORY.

    Returns:
        The bundle with its tables; None if it has at most ``limit`` splats, is another PLY, or has a rule
        that needs all splats or regions.

    Raises:
        LodgsError: see ``read_bundle``.
    """
    if not supports_culled_reads(read_header(path).rule):
        return None
    bundle, rows = open_bundle(path)
    if sum(map(len, rows.values())) <= (limit or MAX_IN_MEMORY):
        return None
    for level in bundle.levels:
        level.on_disk = rows[level.number]
    return bundle


def read_or_open_bundle(path: str | Path) -> Bundle:
    """Read a bundle, or open it if it is large (see ``open_if_large``).

    Raises:
        LodgsError: see ``read_bundle``.
    """
    return open_if_large(path) or read_bundle(path)


class CulledReader:
    """Reader of the blocks of a level that a camera can see. It reads all splats once to find their bounds.

    Args:
        rows: rows of the level; blocks can be skipped only if rows are in spatial order.
        rule: rule of the levels, or None.
        path: file name for warnings.

    Attributes:
        splats_read: number of splats read so far.
    """

    def __init__(
        self, rows: SplatRows, rule: Rule | None = None, path: object = "", warn: Warn = ignore
    ) -> None:
        self._rows = rows
        self._rule = rule
        self._path = str(path)
        parts, undrawable = [], 0
        for begin in range(0, max(len(rows), 1), _BATCH):
            splats = rows.select(slice(begin, begin + _BATCH))
            missing = len(splats) - len(drop_undrawable(splats, self._path))
            undrawable += missing
            part = BlockIndex.of(splats.means, splats.log_scales)
            if missing:  # coordinates may be invalid
                for name in BOUNDS:
                    part.columns[name] = np.full(len(part), _FAR if name.startswith("high") else -_FAR)
            if rule is not None:
                part.add_maxima(rule_columns(rule, splats))
            parts.append(part)
        if undrawable:
            warn(dropped_message(undrawable, self._path))
        self._blocks = BlockIndex.joined(parts)
        self._in_memory: np.ndarray | None = None
        self.splats_read = len(rows)

    def __len__(self) -> int:
        return len(self._rows)

    def missing(self, camera: Camera, query: LodQuery | None = None) -> np.ndarray | None:
        """Return the blocks (B,) bool to read for a camera; None if those in memory suffice.

        Args:
            query: skip blocks whose splats have no weight by this query.
        """
        visible = self._blocks.in_view(camera, 0.0)
        if query is not None and self._rule is not None and query.region() is None:
            band = query.distance_band(self._blocks.columns)
            visible &= self._blocks.in_band(np.array(query.position, np.float32), *band)[0]
        limit = max(_MAX_SURPLUS * np.count_nonzero(visible), _BATCH // SIZE)
        in_memory = self._in_memory
        if in_memory is not None and not (visible & ~in_memory).any() and in_memory.sum() <= limit:
            return None
        return visible

    def read(self, blocks: np.ndarray) -> Splats:
        """Read the splats of blocks (B,) and of small gaps between them, in the order of rows."""
        parts = []
        self._in_memory = np.zeros_like(blocks)
        for begin, end in _runs(blocks):
            parts.append(self._rows.select(slice(begin * SIZE, end * SIZE)))
            self._in_memory[begin:end] = True
        splats = Splats.concatenated(parts) if parts else self._rows.select(slice(0, 0))
        self.splats_read += len(splats)
        return drop_undrawable(splats, self._path)


def read_visible(bundle: Bundle, camera: Camera) -> Bundle:
    """Return a bundle in memory that holds only splats that a camera can see."""
    levels = []
    for level in bundle.levels:
        reader = CulledReader(level.rows)
        blocks = reader.missing(camera)
        assert blocks is not None, "nothing has been read yet"
        levels.append(replace(level, splats=reader.read(blocks), on_disk=None))
    return replace(bundle, levels=levels)


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of runs of blocks (B,), with small gaps closed."""
    blocks = np.flatnonzero(mask)
    if not len(blocks):
        return []
    breaks = np.flatnonzero(np.diff(blocks) > _GAP) + 1
    borders = pairwise([0, *breaks.tolist(), len(blocks)])
    return [(int(blocks[begin]), int(blocks[end - 1]) + 1) for begin, end in borders]
