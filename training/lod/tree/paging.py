"""Trees of splats larger than memory: keep only the part of a bundle that a camera needs.

The file is read in pages of SIZE rows of a level. At any time, memory holds a complete tree: a node without
both children in memory acts as a leaf, so every cut is complete. Pages arrive coarse to fine as the camera
approaches, within a budget of splats; the least recently used pages are evicted first.

numpy only. A thread reads files (:class:`Pager`); the caller takes the results (:meth:`Pager.take`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from ..blocks import ROUNDING, SIZE, Blocks
from ..partial_read import BLOCKS
from ..query import LodQuery
from ..rule import axis_distances
from ..rules.cut import (
    MIN_DETAIL,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    RULE,
    detail_of,
)
from .pages import BOUNDS, parent_bounds
from .resident import COLUMNS, ResidentTree

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

Columns = Mapping[str, np.ndarray]


def is_tree(bundle: Bundle) -> bool:
    """Return whether the levels of a bundle are a tree of splats."""
    return bundle.rule == RULE.name


class TreeFile:
    """A bundle of the rule ``cut``, read page by page.

    Attributes:
        bundle: the bundle without splats.
        levels: (P,) level number of each page.
        begins, counts: (P,) first row in the level, and number of rows, of each page.
        total: number of splats in the file.

    Raises:
        LodgsError: as ``open_bundle``, or another rule.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.bundle, self._rows = open_bundle(path)
        if not is_tree(self.bundle):
            raise LodgsError(
                f"Cannot read {path} in pages: it is not a tree of splats "
                + (f"(its rule is '{self.bundle.rule}')." if self.bundle.rule else "(it has no rule)."),
                "Open the file completely.",
            )
        numbers = [level.number for level in self.bundle.levels]
        lengths = [len(self._rows[number]) for number in numbers]
        pages = [-(-length // SIZE) for length in lengths]
        self.total = sum(lengths)
        self.levels = np.repeat(numbers, pages)
        self.begins = np.concatenate([np.arange(0, length, SIZE) for length in lengths])
        self.counts = np.minimum(SIZE, np.repeat(lengths, pages) - self.begins)
        self._finest, self._index = numbers[-1], None

    def __len__(self) -> int:
        return len(self.levels)

    def read(self, pages: np.ndarray) -> list[Splats]:
        """Read the splats of each of some pages (M,), without undrawable ones."""
        splats_of: dict[int, Splats] = {}
        for number in self._rows:
            level_pages = pages[self.levels[pages] == number]
            rows = self.begins[level_pages, None] + np.arange(SIZE)
            exists = np.arange(SIZE) < self.counts[level_pages, None]
            splats = self.read_rows(number, rows[exists], {_PAGE: np.nonzero(exists)[0]})
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
        """Return by level number (N,) float32: the minimum detail k at which a camera needs each splat.

        A camera needs a splat if the parent is not fine enough. Without a position, return 1 / size_p.
        """
        details = {}
        for number, rows in self._rows.items():
            details[number] = np.empty(len(rows), np.float32)
            for begin in range(0, len(rows), _INDEX_BATCH * SIZE):
                block = slice(begin, begin + _INDEX_BATCH * SIZE)
                columns = _parent_columns(rows, block)
                parents = [columns[name] for name in PARENT]
                distance = 1.0 if position is None else axis_distances(parents, position)
                details[number][block] = distance / np.maximum(columns[PARENT_SIZE], np.float32(1e-30))
        return details

    def index(self, on_progress: Callable[[float], bool] = lambda share: True) -> PageIndex:
        """Return the index of pages, from the table of blocks or by reading the rule's columns once.

        Args:
            on_progress: called with the finished fraction; returns False to cancel.

        Raises:
            InterruptedError: cancelled.
        """
        if self._index is None:
            self._index = self._make_index(on_progress)
        return self._index

    def cut(self, query: LodQuery, camera: Camera | None = None, near: float = 0.0) -> dict[int, Splats]:
        """Return by level number the drawable splats that a query of the rule ``cut`` selects.

        Needs little more memory than these.

        Args:
            camera: in the splats' space; skip blocks outside its image.
            near: depth where its image begins, in the splats' units.
        """
        k = detail_of(query.focal_px, dict(query.values)["pixels"])
        pages = np.sort(self.index().order(np.array(query.eye, np.float32), k))
        parts: dict[int, list[Splats]] = {
            number: [self.read_rows(number, pages[:0])] for number in self._rows
        }
        for begin in range(0, len(pages), PAGES_PER_UPDATE):
            for number, rows in self._rows_of(pages[begin : begin + PAGES_PER_UPDATE]).items():
                columns = self._rows[number].columns(rows, (*COLUMNS, *"xyz"))
                means = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
                zeros = dict.fromkeys(COLUMNS, np.zeros(len(rows), np.float32))
                weights = query.weights(means, zeros | columns)
                splats = self.read_rows(number, rows[weights > 0])
                if camera is not None:
                    blocks = Blocks.of(splats.means, splats.log_scales)
                    splats = splats.select(blocks.rows(blocks.in_view(camera, near)))
                parts[number].append(splats)
        return {number: Splats.concatenated(level_parts) for number, level_parts in parts.items()}

    def _rows_of(self, pages: np.ndarray) -> dict[int, np.ndarray]:
        """Return the rows (M,) of some pages, ascending, by level number."""
        rows_of = {}
        for number in self._rows:
            level_pages = pages[self.levels[pages] == number]
            exists = np.arange(SIZE) < self.counts[level_pages, None]
            rows_of[number] = (self.begins[level_pages, None] + np.arange(SIZE))[exists]
        return rows_of

    def _make_index(self, on_progress: Callable[[float], bool]) -> PageIndex:
        table = self.bundle.tables.get(BLOCKS, {})
        required = {"level", PARENT_SIZE, *BOUNDS}
        if required <= table.keys() and np.array_equal(table["level"], self.levels):
            return PageIndex.of(table)
        parts = []
        for number, rows in ((level.number, self._rows[level.number]) for level in self.bundle.levels):
            for begin in range(0, len(rows), _INDEX_BATCH * SIZE):
                if not on_progress(sum(len(part["level"]) for part in parts) / max(len(self), 1)):
                    raise InterruptedError
                batch = slice(begin, begin + _INDEX_BATCH * SIZE)
                parts.append(parent_bounds(number, _parent_columns(rows, batch)))
        return PageIndex.of({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _parent_columns(rows: FileRows, index: slice) -> dict[str, np.ndarray]:
    columns = rows.columns(index, (PARENT_SIZE, *PARENT))
    zeros = np.zeros(len(rows.vertices[index]), np.float32)
    return {name: np.nan_to_num(columns.get(name, zeros)) for name in (PARENT_SIZE, *PARENT)}


@dataclass(frozen=True)
class PageIndex:
    """Bounds of P pages, which determine where each page is needed.

    Attributes:
        low, high: (P, 3) float64, bounds of the parents' positions.
        parent_size: (P,) float64, maximum size of the parents.
    """

    low: np.ndarray
    high: np.ndarray
    parent_size: np.ndarray

    @classmethod
    def of(cls, table: Columns) -> PageIndex:
        """Return the index of a table of blocks."""
        low, high = (np.stack([table[name] for name in part], 1) for part in (BOUNDS[:3], BOUNDS[3:]))
        return cls(low.astype(np.float64), high.astype(np.float64), table[PARENT_SIZE].astype(np.float64))

    def detail(self, position: np.ndarray) -> np.ndarray:
        """Return (P,) a lower bound of the detail k (``cut.detail_of``) at which a camera needs each page.

        A splat is needed if its parent is not fine enough, ‖c - μ_p‖ < k size_p.
        """
        position = np.asarray(position, np.float64)
        offset = np.maximum(np.maximum(self.low - position, position - self.high), 0)
        distance = np.sqrt(np.square(offset).sum(axis=1)) * (1 - ROUNDING)
        return distance / np.maximum(self.parent_size, 1e-30)

    def ahead(self, position: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return (P,) bool: pages within VIEW_ANGLE of the view direction, and ancestors of such pages.

        A parent's ball of radius MIN_DETAIL size contains those of its children.

        Args:
            direction: (3,) of length 1.
        """
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        reach = np.sqrt(np.square(half).sum(axis=1)) + MIN_DETAIL * self.parent_size
        offset = middle - np.asarray(position, np.float64)
        distance = np.sqrt(np.square(offset).sum(axis=1))
        angle = np.arccos(np.clip(offset @ direction / np.maximum(distance, 1e-30), -1, 1))
        radius = np.arcsin(np.clip(reach / np.maximum(distance, 1e-30), 0, 1))
        return (distance <= reach) | (angle <= VIEW_ANGLE + radius)

    def order(self, position: np.ndarray, k: float, direction: np.ndarray | None = None) -> np.ndarray:
        """Return the pages (M,) that a camera needs at a detail, parents before children.

        For k >= MIN_DETAIL, a ball of radius k size around a node is inside its parent's, so parents are
        needed from a lower k on. Pages needed from MIN_DETAIL on are sorted by size.

        Args:
            direction: (3,) of length 1, the view direction: pages outside the view come later, see
                BEHIND_FACTOR; None: the camera looks in all directions.
        """
        detail = self.detail(position)
        pages = np.flatnonzero(detail < k * (1 + ROUNDING))
        priority = np.maximum(detail[pages], MIN_DETAIL)
        if direction is not None:
            priority[~self.ahead(position, direction)[pages]] *= BEHIND_FACTOR
        return pages[np.lexsort((-self.parent_size[pages], priority))]


def read_budgeted(
    path: str | Path, budget: int, position: np.ndarray | None = None, k: float = inf
) -> tuple[Bundle, int]:
    """Read the top of a tree as a smaller, complete tree.

    Args:
        budget: maximum number of splats.
        position: (3,) of a camera to read for; None: for any.
        k: the camera's detail (``cut.detail_of``); if the budget suffices, its cut equals the full tree's.

    Returns:
        The bundle, and the number of splats in the file.

    Raises:
        LodgsError: as :class:`TreeFile`, or the budget is too small.
    """
    file = TreeFile(path)
    details, bundle = file.details(position), file.bundle
    all_details = np.concatenate([*details.values()])
    limit = np.float32(k)
    if np.count_nonzero(all_details < limit) > budget:
        limit = np.partition(all_details, budget)[budget]  # equal for siblings, which stay together
    splats = Splats.concatenated(
        [file.read_rows(n, np.flatnonzero(detail < limit)) for n, detail in details.items()]
    )
    if not len(splats):
        raise LodgsError(*_budget_too_small(budget, path))
    columns = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    inner, reached = ResidentTree(columns).update(np.arange(len(splats)))
    coarse, fine = splats.select(inner & reached), splats.select(~inner & reached)
    fine.extras[NODE_SIZE] = np.zeros(len(fine), np.float32)
    parts = zip((bundle.levels[0], bundle.levels[-1]), (coarse, fine), strict=True)
    bundle.levels = [Level(level.number, part, level.facts) for level, part in parts]
    bundle.tables.pop(BLOCKS, None)
    return bundle, file.total


def _budget_too_small(budget: int, path: str | Path) -> tuple[str, str]:
    return (
        f"Cannot show {Path(path).name}: a budget of {budget:,} splats is too small.",
        f"Use a budget of at least {SIZE} splats.",
    )


@dataclass(frozen=True)
class PageUpdate:
    """Pages to copy into memory.

    Attributes:
        pages: first row in memory, and splats, of each page.
        sizes: new ``node_size`` and ``parent_size`` of all rows, (rows,) each, for the rule.
    """

    pages: list[tuple[int, Splats]]
    sizes: tuple[np.ndarray, np.ndarray]


class Pager:
    """Reads the pages of a tree that a camera needs, in a thread.

    The caller owns the memory of ``rows`` splats and copies updates into it (:meth:`take`), where new pages
    replace old ones. With the sizes of the last update, the weights of the rule ``cut`` give a complete cut
    of the splats in memory. Empty rows have a parent size of 0, so that no camera sees them; initially all
    rows are empty.

    Args:
        path: a bundle of the rule ``cut``.
        budget: maximum number of splats in memory.

    Attributes:
        file: the file.
        rows: number of rows in memory.
        sh_degree: of the splats.
        arrived: number of updates so far.
        short: whether the camera needs more than the budget.
        problem: error that ended the thread, else "".

    Raises:
        LodgsError: as :class:`TreeFile`, or the budget is less than a page.
    """

    def __init__(self, path: str | Path, budget: int) -> None:
        self.file = TreeFile(path)
        slots = min(budget // SIZE, len(self.file))
        if not slots:
            raise LodgsError(*_budget_too_small(budget, path))
        (first,) = self.file.read(np.array([0]))
        self.rows, self.sh_degree = slots * SIZE, first.sh_degree
        self.arrived, self.short, self.problem = 0, False, ""
        self._columns = {name: np.zeros(self.rows, np.float32) for name in (*COLUMNS, *"xyz")}
        self._tree = ResidentTree(self._columns)
        self._slot_of, self._page_in = np.full(len(self.file), -1), np.full(slots, -1)
        self._used, self._tick = np.zeros(len(self.file), np.int64), 0
        self._index: PageIndex | None = None
        self._request: tuple[np.ndarray, float, np.ndarray | None] | None = None
        self._current = self._request
        self._settled = self._request
        self._changed, self._stopping = threading.Condition(), False
        self._ready: PageUpdate | None = None
        self._thread: threading.Thread | None = None

    @property
    def splats(self) -> int:
        """Number of splats in memory or being read."""
        return int(self.file.counts[self._page_in[self._page_in >= 0]].sum())

    @property
    def idle(self) -> bool:
        """Whether the caller has taken all pages that fit the budget, or the thread has ended."""
        with self._changed:
            return self._ready is None and (bool(self.problem) or self._settled is self._request)

    def step(
        self, position: np.ndarray | None, k: float, direction: np.ndarray | None = None
    ) -> PageUpdate | None:
        """Read the next pages for a camera; return None if there are none. The thread calls this repeatedly.

        Args:
            position: (3,) in the splats' space; None: unknown, read the first pages of the file.
            k: detail, see ``cut.detail_of``.
            direction: see ``PageIndex.order``.
        """
        slots = len(self._page_in)
        if position is None:
            order = np.arange(slots)
        else:
            if self._index is None:
                self._index = self.file.index(lambda share: not self._stopping)
            order = self._index.order(position, k, direction)
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
        return PageUpdate(pages, (sizes, np.where(reached, self._columns[PARENT_SIZE], np.float32(0))))

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

    def ask(self, position: np.ndarray, k: float, direction: np.ndarray | None = None) -> None:
        """Request pages for a camera's position, detail and view direction. Returns immediately."""
        with self._changed:
            self._request = np.array(position, np.float64), float(k), direction
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
