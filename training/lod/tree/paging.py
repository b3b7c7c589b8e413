"""Trees of splats larger than memory: keep only the part of a bundle that a camera needs.

The file is read in pages of SIZE rows of a level. At any time, memory holds a complete tree: a node without
both children in memory acts as a leaf, so every cut is complete. Pages arrive coarse to fine as the camera
approaches, within a budget of splats; the least recently used pages are evicted first.

numpy only. A thread reads files (:class:`TreePager`); the caller takes the results (``take``).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf
from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ...scenes.cameras import Camera
from ...splats.bundle import open_bundle
from ...splats.dialects import drop_undrawable
from ...splats.file_rows import FileRows
from ...splats.gaussians import Splats
from ...splats.levels import Bundle, Level
from ..blocks import BLOCKS, ROUNDING, SIZE, BlockIndex, Columns
from ..query import LodQuery, PageUpdate
from .nodes import (
    BLOCK_BOUNDS,
    COLUMNS,
    MIN_DETAIL,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    ResidentTree,
    detail_of,
    needed_detail,
    parent_index,
)

PAGES_PER_UPDATE = 256
"""Pages read between two checks of the camera position."""
VIEW_ANGLE = np.radians(50.0)
"""Angle from the view direction that counts as inside the image."""
BEHIND_FACTOR = 2.0
"""Outside the view, pages are needed as if the detail were divided by this factor."""
_PAGE = "page"
"""Temporary column: page of each row while reading."""
_INDEX_BATCH = 1 << 11
"""Pages per batch when indexing a file without a table of blocks."""


class TreeFile:
    """A bundle of a tree, read page by page; see ``query.PagedFile``.

    Attributes:
        bundle: the bundle without splats.
        pages: the P pages: blocks of the levels, without bounds.
        total: number of splats in the file.

    Raises:
        LodgsError: see ``open_bundle``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bundle, self._rows = open_bundle(path)
        lengths = {level.number: len(self._rows[level.number]) for level in self.bundle.levels}
        self.pages = BlockIndex(lengths, {})
        self.total = self.pages.count
        self._index: BlockIndex | None = None

    def __len__(self) -> int:
        return len(self.pages)

    def read(self, pages: np.ndarray) -> list[Splats]:
        """Read the splats of each of some pages (M,), without undrawable ones."""
        splats_of: dict[int, Splats] = {}
        for number in self._rows:
            level_pages = pages[self.pages.levels[pages] == number]
            rows = self.pages.level_rows(level_pages)[number]
            page = np.repeat(np.arange(len(level_pages)), self.pages.sizes[level_pages])
            splats = self.read_rows(number, rows, {_PAGE: page})
            begins = np.searchsorted(splats.extras.pop(_PAGE), np.arange(len(level_pages) + 1))
            parts = [splats.select(slice(*ends)) for ends in pairwise(begins)]
            splats_of |= dict(zip(level_pages.tolist(), parts, strict=True))
        return [splats_of[page] for page in pages.tolist()]

    def read_rows(self, number: int, rows: np.ndarray, extras: Columns | None = None) -> Splats:
        """Read the splats of some rows (M,) of a level, with extra columns (M,), without undrawable ones."""
        splats = self._rows[number].select(rows)
        zeros = np.zeros(len(splats), np.float32)
        splats.extras = dict.fromkeys(COLUMNS, zeros) | splats.extras | dict(extras or {})
        return drop_undrawable(splats, self.path)

    def details(self, position: np.ndarray | None) -> dict[int, np.ndarray]:
        """Return :func:`.nodes.needed_detail` of all splats, (N,) float32 by level number."""
        details = {}
        for number, rows in self._rows.items():
            details[number] = np.empty(len(rows), np.float32)
            for begin in range(0, len(rows), _INDEX_BATCH * SIZE):
                block = slice(begin, begin + _INDEX_BATCH * SIZE)
                details[number][block] = needed_detail(_parent_columns(rows, block), position)
        return details

    def index(self, on_progress: Callable[[float], bool] = lambda share: True) -> BlockIndex:
        """Return the pages with ``nodes.BLOCK_BOUNDS``, from the file's table or by reading columns once.

        Args:
            on_progress: called with the finished fraction; returns False to cancel.

        Raises:
            InterruptedError: cancelled.
        """
        if self._index is None:
            self._index = self._make_index(on_progress)
        return self._index

    def visible(self, query: LodQuery, camera: Camera | None = None, near: float = 0.0) -> dict[int, Splats]:
        """Return the splats that a query selects, see ``query.PagedFile``; needs little more memory."""
        pages = np.sort(page_order(self.index(), np.array(query.position, np.float32), query_detail(query)))
        parts: dict[int, list[Splats]] = {
            number: [self.read_rows(number, pages[:0])] for number in self._rows
        }
        for begin in range(0, len(pages), PAGES_PER_UPDATE):
            for number, rows in self.pages.level_rows(pages[begin : begin + PAGES_PER_UPDATE]).items():
                columns = self._rows[number].columns(rows, (*COLUMNS, *"xyz"))
                means = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
                zeros = dict.fromkeys(COLUMNS, np.zeros(len(rows), np.float32))
                weights = query.weights(means, zeros | columns)
                splats = self.read_rows(number, rows[weights > 0])
                if camera is not None:
                    blocks = BlockIndex.of(splats.means, splats.log_scales)
                    splats = splats.select(blocks.rows(blocks.in_view(camera, near)))
                parts[number].append(splats)
        return {number: Splats.concatenated(level_parts) for number, level_parts in parts.items()}

    def top(self, budget: int, position: np.ndarray | None = None, k: float = inf) -> Bundle:
        """Read the top of the tree as a smaller, complete tree, see ``query.PagedFile``.

        Args:
            budget: maximum number of splats.
            position: (3,) of a camera to read for; None means any camera.
            k: the camera's detail (``detail_of``); if the budget suffices, its cut equals the full tree's.

        Raises:
            LodgsError: cannot read the file, or the budget is too small.
        """
        details = self.details(position)
        all_details = np.concatenate([*details.values()])
        limit = np.float32(k)
        if np.count_nonzero(all_details < limit) > budget:
            limit = np.partition(all_details, budget)[budget]  # equal for siblings, which stay together
        splats = Splats.concatenated(
            [self.read_rows(n, np.flatnonzero(detail < limit)) for n, detail in details.items()]
        )
        if not len(splats):
            raise self.budget_error(budget)
        columns = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
        inner, reached = ResidentTree(columns).update(np.arange(len(splats)))
        coarse, fine = splats.select(inner & reached), splats.select(~inner & reached)
        fine.extras[NODE_SIZE] = np.zeros(len(fine), np.float32)
        parts = zip((self.bundle.levels[0], self.bundle.levels[-1]), (coarse, fine), strict=True)
        levels = [Level(level.number, part, level.facts) for level, part in parts]
        tables = {name: table for name, table in self.bundle.tables.items() if name != BLOCKS}
        return replace(self.bundle, levels=levels, tables=tables)

    def pager(self, budget: int) -> TreePager:
        """Return a pager of the file, not started yet, see ``query.PagedFile``."""
        return TreePager(self, budget)

    def budget_error(self, budget: int) -> LodgsError:
        """Return the error for a budget that is too small."""
        return LodgsError(
            f"Cannot show {self.path.name}: a budget of {budget:,} splats is too small.",
            f"Use a budget of at least {SIZE} splats.",
        )

    def _make_index(self, on_progress: Callable[[float], bool]) -> BlockIndex:
        table = self.bundle.tables.get(BLOCKS, {})
        if {"level", *BLOCK_BOUNDS} <= table.keys():
            index = BlockIndex.from_table(table, self.pages.lengths)
            if index is not None:
                return index
        parts, finished = [], 0
        for number, rows in ((level.number, self._rows[level.number]) for level in self.bundle.levels):
            for begin in range(0, len(rows), _INDEX_BATCH * SIZE):
                if not on_progress(finished / max(len(self), 1)):
                    raise InterruptedError
                batch = slice(begin, begin + _INDEX_BATCH * SIZE)
                parts.append(parent_index(number, _parent_columns(rows, batch)))
                finished += len(parts[-1])
        return BlockIndex.joined(parts)


def _parent_columns(rows: FileRows, index: slice) -> dict[str, np.ndarray]:
    columns = rows.columns(index, (PARENT_SIZE, *PARENT))
    zeros = np.zeros(len(rows.vertices[index]), np.float32)
    return {name: np.nan_to_num(columns.get(name, zeros)) for name in (PARENT_SIZE, *PARENT)}


def query_detail(query: LodQuery) -> float:
    """Return the detail k of a query of the rule ``cut``."""
    return detail_of(query.focal_px, dict(query.values)["pixels"])


def page_order(
    index: BlockIndex, position: np.ndarray, k: float, direction: np.ndarray | None = None
) -> np.ndarray:
    """Return the pages (M,) that a camera needs at a detail, parents before children.

    A splat is needed if its parent is not fine enough, ‖c - μ_p‖ < k size_p. For k >= MIN_DETAIL, a ball of
    radius k size around a node is inside its parent's, so parents are needed from a lower k on. Pages needed
    from MIN_DETAIL on are sorted by size.

    Args:
        index: index of the parents, :func:`.nodes.parent_index`.
        direction: (3,) of length 1, the view direction: pages outside the view come later, see BEHIND_FACTOR;
            None: the camera looks in all directions.
    """
    sizes = index.columns[PARENT_SIZE].astype(np.float64)
    nearest, _ = index.distances(position)
    detail = nearest * (1 - ROUNDING) / np.maximum(sizes, 1e-30)
    pages = np.flatnonzero(detail < k * (1 + ROUNDING))
    priority = np.maximum(detail[pages], MIN_DETAIL)
    if direction is not None:
        priority[~pages_ahead(index, position, direction)[pages]] *= BEHIND_FACTOR
    return pages[np.lexsort((-sizes[pages], priority))]


def pages_ahead(index: BlockIndex, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return (P,) bool: pages within VIEW_ANGLE of the view direction, and ancestors of such pages.

    A parent's ball of radius MIN_DETAIL size contains those of its children.

    Args:
        direction: (3,) of length 1.
    """
    middle, half = index.boxes
    reach = np.sqrt(np.square(half).sum(axis=0)) + MIN_DETAIL * index.columns[PARENT_SIZE].astype(np.float64)
    offset = middle - np.asarray(position, np.float64)[:, None]
    distance = np.sqrt(np.square(offset).sum(axis=0))
    angle = np.arccos(np.clip(direction @ offset / np.maximum(distance, 1e-30), -1, 1))
    radius = np.arcsin(np.clip(reach / np.maximum(distance, 1e-30), 0, 1))
    return (distance <= reach) | (angle <= VIEW_ANGLE + radius)


class TreePager:
    """Reader of the pages of a tree that a camera needs, in a thread; see ``query.Pager``.

    Empty rows have a parent size of 0, so that no camera sees them.

    Args:
        file: the file.
        budget: maximum number of splats in memory.

    Raises:
        LodgsError: the budget is less than a page.
    """

    def __init__(self, file: TreeFile, budget: int) -> None:
        self.file = file
        slots = min(budget // SIZE, len(file))
        if not slots:
            raise file.budget_error(budget)
        (first,) = file.read(np.array([0]))
        self.rows, self.sh_degree = slots * SIZE, first.sh_degree
        self.arrived, self.short, self.problem = 0, False, ""
        self._columns = {name: np.zeros(self.rows, np.float32) for name in (*COLUMNS, *"xyz")}
        self._tree = ResidentTree(self._columns)
        self._slot_of, self._page_in = np.full(len(self.file), -1), np.full(slots, -1)
        self._used, self._tick = np.zeros(len(self.file), np.int64), 0
        self._index: BlockIndex | None = None
        self._request: tuple[np.ndarray, float, np.ndarray | None] | None = None
        self._current: tuple[np.ndarray, float, np.ndarray | None] | None = None
        self._settled: tuple[np.ndarray, float, np.ndarray | None] | None = None
        self._changed, self._stopping = threading.Condition(), False
        self._ready: PageUpdate | None = None
        self._thread: threading.Thread | None = None

    @property
    def splats(self) -> int:
        """Number of splats in memory or being read."""
        return int(self.file.pages.sizes[self._page_in[self._page_in >= 0]].sum())

    @property
    def idle(self) -> bool:
        """True if the caller has taken all pages that fit the budget, or the thread has ended."""
        with self._changed:
            return self._ready is None and (bool(self.problem) or self._settled is self._request)

    def step(
        self, position: np.ndarray | None, k: float, direction: np.ndarray | None = None
    ) -> PageUpdate | None:
        """Read the next pages for a camera; return None if there are none. The thread calls this repeatedly.

        Args:
            position: (3,) in the splats' space; None means unknown: the first pages of the file.
            k: detail, see ``detail_of``.
            direction: see :func:`page_order`.
        """
        slots = len(self._page_in)
        if position is None:
            order = np.arange(slots)
        else:
            if self._index is None:
                self._index = self.file.index(lambda share: not self._stopping)
            order = page_order(self._index, position, k, direction)
            self.short, order = len(order) > slots, order[:slots]
        self._tick += 1
        self._used[order] = self._tick
        missing = order[self._slot_of[order] < 0][:PAGES_PER_UPDATE]
        if not len(missing):
            return None
        pages = []
        free = self._free_slots(len(missing))
        for page, slot, splats in zip(missing, free, self.file.read(missing), strict=False):
            begin = int(slot) * SIZE
            rows = slice(begin, begin + len(splats))
            for name, column in self._columns.items():
                column[begin : begin + SIZE] = 0
                column[rows] = splats.extras[name] if name in COLUMNS else splats.means[:, "xyz".index(name)]
            self._slot_of[page], self._page_in[slot] = slot, page
            pages.append((begin, splats))
        begins = np.array([begin for begin, _ in pages])
        inner, reached = self._tree.update((begins[:, None] + np.arange(SIZE)).reshape(-1))
        # nodes without both children act as leaves; unreachable nodes get a parent that is always fine enough
        sizes = np.where(inner, self._columns[NODE_SIZE], np.float32(0))
        parent_sizes = np.where(reached, self._columns[PARENT_SIZE], np.float32(0))
        return PageUpdate(pages, {NODE_SIZE: sizes, PARENT_SIZE: parent_sizes})

    def _free_slots(self, count: int) -> np.ndarray:
        """Return at least ``count`` free slots, after evicting the least recently used pages."""
        free = np.flatnonzero(self._page_in < 0)
        if len(free) >= count:
            return free
        occupied = np.flatnonzero(self._page_in >= 0)
        oldest = np.argsort(self._used[self._page_in[occupied]], kind="stable")
        evicted = occupied[oldest[: count - len(free)]]
        self._slot_of[self._page_in[evicted]] = self._page_in[evicted] = -1
        return np.concatenate([free, evicted])

    def start(self) -> None:
        """Start the thread, which reads the first pages of the file, then requested ones."""
        self._thread = threading.Thread(target=self._run, name="lodgs-paging", daemon=True)
        self._thread.start()

    def ask(self, query: LodQuery, direction: Sequence[float] | None = None) -> None:
        """Request the pages that a query selects, see ``query.Pager``."""
        view = None if direction is None else np.array(direction)
        with self._changed:
            self._request = np.array(query.position, np.float64), query_detail(query), view
            self._changed.notify_all()

    def take(self) -> PageUpdate | None:
        """Return the next update, if there is one; the caller must apply it before the next call."""
        with self._changed:
            update, self._ready = self._ready, None
            self._changed.notify_all()
        return update

    def stop(self) -> None:
        """Stop the thread, without waiting for reads from a slow disk."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._current = self._request
                # start with the first pages, until the index is known
                update = self.step(None, 0.0) if self._index is None else None
                if update is None and self._current is not None:
                    update = self.step(*self._current)
                with self._changed:
                    if update is None:
                        self._settled = self._current
                        self._changed.wait_for(lambda: self._stopping or self._request is not self._current)
                    else:
                        self._changed.wait_for(lambda: self._stopping or self._ready is None)
                        self._ready = update
                        self.arrived += 1
        except InterruptedError:
            return
        except Exception as error:  # for example a missing disk or a corrupt file
            self.problem = str(error) or type(error).__name__
