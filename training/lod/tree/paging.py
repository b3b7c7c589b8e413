"""A tree of splats larger than the memory that it may take: of its bundle the part that an eye needs.

The file is read in pages, ranges of SIZE rows of a level. What is in memory is a tree of its own at any time:
a node of which not both children are there stands for all that is below it, as if it were a leaf, so every
cut is complete. Pages come in coarse to fine, as the eye comes near; at most so many splats as the budget
says are there, and the pages that were of no use for longest go first.

numpy only. Files are read in a thread (:class:`Pager`); what it has found is taken over by whoever chooses
and draws (:meth:`Pager.take`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
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
from ..blocks import ROUNDING, SIZE, Blocks, morton_codes
from ..partial_read import BLOCKS
from ..query import LodQuery
from ..rule import axis_distances
from ..rules.cut import (
    ABOVE_ROOT,
    MIN_DETAIL,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    RULE,
    detail_of,
    hash_rows,
    node_keys,
)

BOUNDS = tuple(f"{end}_{axis}" for end in ("low", "high") for axis in "xyz")
"""Columns of the table of blocks beside ``level`` and ``parent_size``: bounds of the parents' places."""
COLUMNS = (NODE_SIZE, PARENT_SIZE, *PARENT)
PAGES_PER_UPDATE = 256
"""Pages that come in between two looks at where the eye is."""
VIEW_ANGLE = np.radians(50.0)
"""An angle that images reach from where their eye looks."""
BEHIND_FACTOR = 2.0
"""What an eye does not look at comes in as if seen with so many times less detail, while there is room."""
_PAGE = "page"
"""Column that tells of rows in which page they are, while they are read."""
_INDEXED = 1 << 11
"""Pages that are looked at together when there is no table of blocks."""

Columns = Mapping[str, np.ndarray]


def streaming_order(columns: Columns) -> np.ndarray:
    """(N,) int64, the order of a level's splats in a file: by octaves of their parents' sizes, the largest
    first, and within one as neighbours in space.

    Their parents tell from where splats are needed, so that pages are of one size and one place, and both
    children of a node come together.

    Args:
        columns: of the rule, (N,) each.
    """
    places = morton_codes(np.stack([columns[name] for name in PARENT], axis=1))
    octaves = -np.floor(np.log2(np.maximum(columns[PARENT_SIZE], 1e-30)))
    return np.lexsort((places, octaves.astype(np.int16)))


def page_table(columns: Mapping[int, Columns]) -> dict[str, np.ndarray]:
    """The table ``blocks`` of a tree: of every SIZE rows of a level, in the order of rows, the ``level``, the
    greatest ``parent_size``, and the BOUNDS of the parents' places.

    Args:
        columns: of the rule, (N,) each, by the level's number.
    """
    parts = [_bounds(number, own) for number, own in columns.items()]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _bounds(number: int, columns: Columns) -> dict[str, np.ndarray]:
    begins = np.arange(0, len(columns[PARENT_SIZE]), SIZE)
    found = {"level": np.full(len(begins), number, np.int32)}
    found[PARENT_SIZE] = np.maximum.reduceat(columns[PARENT_SIZE], begins)
    named = [(f"{end}_{name[-1]}", name) for end in ("low", "high") for name in PARENT]
    extremes = [np.minimum] * 3 + [np.maximum] * 3
    for (bound, name), extreme in zip(named, extremes, strict=True):
        found[bound] = extreme.reduceat(columns[name], begins)
    return found


def is_tree(bundle: Bundle) -> bool:
    """Whether the levels of a bundle are a tree of splats."""
    return bundle.rule == RULE.name


class TreeFile:
    """A bundle of the rule ``cut``, read page by page.

    Attributes:
        bundle: what it says of itself, without splats.
        levels: (P,) of each page, the level's number.
        begins, counts: (P,) its first row in the level, and its rows.
        total: splats of the whole file.

    Raises:
        LodgsError: as ``open_bundle``, or it has another rule.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.bundle, self._rows = open_bundle(path)
        if not is_tree(self.bundle):
            raise LodgsError(
                f"{path} is no tree of splats: it is made for "
                + (f"the rule '{self.bundle.rule}'." if self.bundle.rule else "no distances."),
                "Open it as a whole.",
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
        """The splats of each of some pages (M,); those that cannot be drawn are missing."""
        found: dict[int, Splats] = {}
        for number in self._rows:
            mine = pages[self.levels[pages] == number]
            each = self.begins[mine, None] + np.arange(SIZE)
            there = np.arange(SIZE) < self.counts[mine, None]
            splats = self.read_rows(number, each[there], {_PAGE: np.nonzero(there)[0]})
            begins = np.searchsorted(splats.extras.pop(_PAGE), np.arange(len(mine) + 1))
            parts = [splats.select(slice(*ends)) for ends in pairwise(begins)]
            found |= dict(zip(mine.tolist(), parts, strict=True))
        return [found[page] for page in pages.tolist()]

    def read_rows(self, number: int, rows: np.ndarray, beside: Columns | None = None) -> Splats:
        """The splats of some rows (M,) of a level, with further columns (M,); those that cannot be drawn are
        missing."""
        splats = self._rows[number].select(rows)
        nothing = np.zeros(len(splats), np.float32)
        splats.extras = dict.fromkeys(COLUMNS, nothing) | splats.extras | dict(beside or {})
        return drop_undrawable(splats, self.path)

    def details(self, eye: np.ndarray | None) -> dict[int, np.ndarray]:
        """By the level's number, (N,) float32: the least detail k at which an eye needs each splat, which is
        where its parent is not fine enough; for no eye in particular 1 / size_p."""
        found = {}
        for number, rows in self._rows.items():
            found[number] = np.empty(len(rows), np.float32)
            for begin in range(0, len(rows), _INDEXED * SIZE):
                block = slice(begin, begin + _INDEXED * SIZE)
                columns = _columns_of(rows, block)
                away = 1.0 if eye is None else axis_distances([columns[name] for name in PARENT], eye)
                found[number][block] = away / np.maximum(columns[PARENT_SIZE], np.float32(1e-30))
        return found

    def index(self, on_progress: Callable[[float], bool] = lambda share: True) -> PageIndex:
        """Where pages are needed: of the file's table of blocks, or found by reading the rule's columns once.

        Args:
            on_progress: called with the share that is done; where it returns False, an InterruptedError is
                raised.
        """
        if self._index is None:
            self._index = self._make_index(on_progress)
        return self._index

    def cut(self, choice: LodQuery, camera: Camera | None = None, near: float = 0.0) -> dict[int, Splats]:
        """By the level's number, the splats that a choice of the rule ``cut`` shows; those that cannot be
        drawn are missing.

        Memory holds little more than these.

        Args:
            camera: in the splats' own space; splats that are out of its sight may be left out.
            near: depth at which its drawing begins, in the splats' units.
        """
        k = detail_of(choice.focal_px, dict(choice.values)["pixels"])
        pages = np.sort(self.index().order(np.array(choice.eye, np.float32), k))
        found: dict[int, list[Splats]] = {
            number: [self.read_rows(number, pages[:0])] for number in self._rows
        }
        for begin in range(0, len(pages), PAGES_PER_UPDATE):
            for number, rows in self._rows_of(pages[begin : begin + PAGES_PER_UPDATE]).items():
                columns = self._rows[number].columns(rows, (*COLUMNS, *"xyz"))
                means = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
                zeros = dict.fromkeys(COLUMNS, np.zeros(len(rows), np.float32))
                weights = choice.weights(means, zeros | columns)
                splats = self.read_rows(number, rows[weights > 0])
                if camera is not None:
                    blocks = Blocks.of(splats.means, splats.log_scales)
                    splats = splats.select(blocks.rows(blocks.in_view(camera, near)))
                found[number].append(splats)
        return {number: Splats.concatenated(parts) for number, parts in found.items()}

    def _rows_of(self, pages: np.ndarray) -> dict[int, np.ndarray]:
        """The rows (M,) of some pages, ascending, by the level's number."""
        found = {}
        for number in self._rows:
            mine = pages[self.levels[pages] == number]
            there = np.arange(SIZE) < self.counts[mine, None]
            found[number] = (self.begins[mine, None] + np.arange(SIZE))[there]
        return found

    def _make_index(self, on_progress: Callable[[float], bool]) -> PageIndex:
        table = self.bundle.tables.get(BLOCKS, {})
        wanted = {"level", PARENT_SIZE, *BOUNDS}
        if wanted <= table.keys() and np.array_equal(table["level"], self.levels):
            return PageIndex.of(table)
        parts = []
        for number, rows in ((level.number, self._rows[level.number]) for level in self.bundle.levels):
            for begin in range(0, len(rows), _INDEXED * SIZE):
                if not on_progress(sum(len(part["level"]) for part in parts) / max(len(self), 1)):
                    raise InterruptedError
                parts.append(_bounds(number, _columns_of(rows, slice(begin, begin + _INDEXED * SIZE))))
        return PageIndex.of({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _columns_of(rows: FileRows, some: slice) -> dict[str, np.ndarray]:
    found = rows.columns(some, (PARENT_SIZE, *PARENT))
    nothing = np.zeros(len(rows.vertices[some]), np.float32)
    return {name: np.nan_to_num(found.get(name, nothing)) for name in (PARENT_SIZE, *PARENT)}


@dataclass(frozen=True)
class PageIndex:
    """From where on each of P pages is needed.

    Attributes:
        low, high: (P, 3) float64, bounds of the parents' places.
        parent_size: (P,) float64, the greatest.
    """

    low: np.ndarray
    high: np.ndarray
    parent_size: np.ndarray

    @classmethod
    def of(cls, table: Columns) -> PageIndex:
        """By a table of blocks."""
        low, high = (np.stack([table[name] for name in part], 1) for part in (BOUNDS[:3], BOUNDS[3:]))
        return cls(low.astype(np.float64), high.astype(np.float64), table[PARENT_SIZE].astype(np.float64))

    def detail(self, eye: np.ndarray) -> np.ndarray:
        """(P,) the least detail k (``cut.detail_of``) at which an eye needs a splat of each page, or less.

        A splat is needed where its parent is not fine enough, ‖c - μ_p‖ < k size_p.
        """
        eye = np.asarray(eye, np.float64)
        beside = np.maximum(np.maximum(self.low - eye, eye - self.high), 0)
        away = np.sqrt(np.square(beside).sum(axis=1)) * (1 - ROUNDING)
        return away / np.maximum(self.parent_size, 1e-30)

    def ahead(self, eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """(P,) bool, which pages are within SIGHT of where an eye looks, or have what others there need.

        Where a node's ball of K_LEAST size is, its parent's is, too.

        Args:
            direction: (3,) of length 1.
        """
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        reach = np.sqrt(np.square(half).sum(axis=1)) + MIN_DETAIL * self.parent_size
        to = middle - np.asarray(eye, np.float64)
        away = np.sqrt(np.square(to).sum(axis=1))
        aside = np.arccos(np.clip(to @ direction / np.maximum(away, 1e-30), -1, 1))
        return (away <= reach) | (
            aside <= VIEW_ANGLE + np.arcsin(np.clip(reach / np.maximum(away, 1e-30), 0, 1))
        )

    def order(self, eye: np.ndarray, k: float, direction: np.ndarray | None = None) -> np.ndarray:
        """The pages (M,) that an eye needs at a detail, those first without which others are of no use.

        Balls of k size around nodes lie within their parents' for every k of at least K_LEAST, so parents
        are needed from a lower k on; what is needed from K_LEAST on goes by size.

        Args:
            direction: (3,) of length 1, in which the eye looks: elsewhere so much detail can wait as BEHIND
                says; None: it looks everywhere.
        """
        detail = self.detail(eye)
        some = np.flatnonzero(detail < k * (1 + ROUNDING))
        wanted = np.maximum(detail[some], MIN_DETAIL)
        if direction is not None:
            wanted[~self.ahead(eye, direction)[some]] *= BEHIND_FACTOR
        return some[np.lexsort((-self.parent_size[some], wanted))]


class ResidentTree:
    """Which splats of a tree, at N places in memory, a cut can tell apart where others may be missing.

    Children know their parent by its size and place, bit for bit. (Of several nodes of one size at one place
    none is told apart; ``tree.Apart`` sees to it that a file has none.) Who is whose parent is kept, and
    looked for only where it may have changed.

    Args:
        columns: of the rule, and x, y, z, (N,) float32 each. No splat is where the parent's size is 0.
    """

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        self._parents = np.full(len(columns[NODE_SIZE]), -1, np.int32)
        self._keys, self._nodes = np.zeros(0, np.uint64), np.zeros(0, np.int32)  # of all nodes, by their keys

    def update(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Looks again after columns have changed at some places (M,).

        Returns:
            inner: (N,) bool, both children are there. Others stand for all below them.
            reached: (N,) bool, all nodes above are there and inner. Others are never drawn.
        """
        size, above, count = self._columns[NODE_SIZE], self._columns[PARENT_SIZE], len(self._parents)
        changed = np.zeros(count, bool)
        changed[places] = True
        stay = ~changed[self._nodes]
        keys, nodes = self._keys[stay], self._nodes[stay]
        come = places[size[places] > 0]
        new = hash_rows(self._family(come, NODE_SIZE, "xyz"))
        order = np.argsort(new, kind="stable")
        here = np.searchsorted(keys, new[order], side="right")
        self._keys, self._nodes = np.insert(keys, here, new[order]), np.insert(nodes, here, come[order])

        root = above >= np.float32(ABOVE_ROOT)
        self._parents[changed | changed[self._parents]] = -1
        seek = np.flatnonzero((self._parents < 0) & (above > size) & ~root)
        if len(self._nodes):
            sought = self._family(seek, PARENT_SIZE, PARENT)
            place = np.searchsorted(self._keys, hash_rows(sought)).clip(max=len(self._nodes) - 1)
            found = self._nodes[place]
            known = (self._family(found, NODE_SIZE, "xyz") == sought).all(axis=1)
            self._parents[seek[known]] = found[known]

        known = self._parents >= 0
        inner = np.bincount(self._parents[known], minlength=count)[:count] == 2
        # whether all nodes above are inner: twice as far up at every step
        up = np.where(known, self._parents, np.arange(count, dtype=np.int32))
        reached = root | (known & inner[up])
        for _ in range(count.bit_length()):
            further, higher = reached & reached[up], up[up]
            if np.array_equal(further, reached) and np.array_equal(up, higher):
                break
            reached, up = further, higher
        return inner, reached

    @property
    def parents(self) -> np.ndarray:
        """(N,) int32, at which place each splat's parent is; -1 where it is not there, or it has none."""
        return self._parents

    def _family(self, places: np.ndarray, size: str, axes: Sequence[str]) -> np.ndarray:
        """(M, 4) by which children and parents know each other."""
        return node_keys(*(self._columns[name][places] for name in (size, *axes)))


def read_budgeted(
    path: str | Path, budget: int, eye: np.ndarray | None = None, k: float = inf
) -> tuple[Bundle, int]:
    """The top of a tree as a smaller one, complete by itself; and how many splats the whole has.

    Args:
        budget: most splats of it.
        eye: (3,) for whom; None: for any.
        k: the eye's detail (``cut.detail_of``): where the budget has room for all that it needs, its cut is
            the whole tree's.

    Raises:
        LodgsError: as :class:`TreeFile`, or the budget leaves nothing.
    """
    file = TreeFile(path)
    details, bundle = file.details(eye), file.bundle
    everything = np.concatenate([*details.values()])
    most = np.float32(k)
    if np.count_nonzero(everything < most) > budget:
        most = np.partition(everything, budget)[budget]  # siblings have the same, and come together
    splats = Splats.concatenated(
        [file.read_rows(n, np.flatnonzero(each < most)) for n, each in details.items()]
    )
    if not len(splats):
        raise LodgsError(*_too_few(budget, path))
    columns = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    inner, reached = ResidentTree(columns).update(np.arange(len(splats)))
    coarse, fine = splats.select(inner & reached), splats.select(~inner & reached)
    fine.extras[NODE_SIZE] = np.zeros(len(fine), np.float32)
    parts = zip((bundle.levels[0], bundle.levels[-1]), (coarse, fine), strict=True)
    bundle.levels = [Level(level.number, part, level.facts) for level, part in parts]
    bundle.tables.pop(BLOCKS, None)
    return bundle, file.total


def _too_few(budget: int, path: str | Path) -> tuple[str, str]:
    return f"{budget:,} splats are too few to show {Path(path).name}.", f"Take {SIZE} or more of them."


@dataclass(frozen=True)
class PageUpdate:
    """What comes in at once.

    Attributes:
        pages: from which row in memory on each stands, and its splats.
        sizes: ``node_size`` and ``parent_size`` that the rule is to have then of all rows, (rows,) each.
    """

    pages: list[tuple[int, Splats]]
    sizes: tuple[np.ndarray, np.ndarray]


class Pager:
    """Finds out, in a thread, what of a tree in a file an eye needs in memory, and reads it.

    Memory is kept by who takes what comes (:meth:`take`): ``rows`` splats, of which pages take the place of
    others. With the sizes of the last update the weights of the rule ``cut`` make a complete cut of what is
    there; rows without a splat have a parent size of 0, so that no eye is shown them, as all rows have at
    first.

    Args:
        path: a bundle of the rule ``cut``.
        budget: most splats in memory.

    Attributes:
        file: what is read.
        rows: of memory.
        sh_degree: of the splats.
        arrived: how many updates there have been to take.
        short: whether the eye needs more than there is room for.
        problem: why the thread has ended by itself; empty as long as it has not.

    Raises:
        LodgsError: as :class:`TreeFile`, or the budget is less than a page.
    """

    def __init__(self, path: str | Path, budget: int) -> None:
        self.file = TreeFile(path)
        slots = min(budget // SIZE, len(self.file))
        if not slots:
            raise LodgsError(*_too_few(budget, path))
        (first,) = self.file.read(np.array([0]))
        self.rows, self.sh_degree = slots * SIZE, first.sh_degree
        self.arrived, self.short, self.problem = 0, False, ""
        self._columns = {name: np.zeros(self.rows, np.float32) for name in (*COLUMNS, *"xyz")}
        self._standing = ResidentTree(self._columns)
        self._slot_of, self._page_in = np.full(len(self.file), -1), np.full(slots, -1)
        self._used, self._tick = np.zeros(len(self.file), np.int64), 0
        self._index: PageIndex | None = None
        self._asked: tuple[np.ndarray, float, np.ndarray | None] | None = None
        self._done = self._asked
        self._settled = self._asked
        self._changed, self._stopping = threading.Condition(), False
        self._ready: PageUpdate | None = None
        self._thread: threading.Thread | None = None

    @property
    def splats(self) -> int:
        """How many splats are in memory, or on their way."""
        return int(self.file.counts[self._page_in[self._page_in >= 0]].sum())

    @property
    def idle(self) -> bool:
        """Whether all has been taken that the eye needs, as far as there is room; or nothing more comes."""
        with self._changed:
            return self._ready is None and (bool(self.problem) or self._settled is self._asked)

    def step(
        self, eye: np.ndarray | None, k: float, direction: np.ndarray | None = None
    ) -> PageUpdate | None:
        """The next pages for an eye: what the thread does again and again; None where there are no more.

        Args:
            eye: (3,) in the splats' space; None: nowhere yet, the first pages of the file.
            k: its detail, see ``cut.detail_of``.
            direction: see ``PageIndex.order``.
        """
        slots = len(self._page_in)
        if eye is None:
            order = np.arange(slots)
        else:
            if self._index is None:
                self._index = self.file.index(lambda share: not self._stopping)
            order = self._index.order(eye, k, direction)
            self.short, order = len(order) > slots, order[:slots]
        self._tick += 1
        self._used[order] = self._tick
        missing = order[self._slot_of[order] < 0][:PAGES_PER_UPDATE]
        if not len(missing):
            return None
        free = np.flatnonzero(self._page_in < 0)
        if len(free) < len(missing):
            there = np.flatnonzero(self._page_in >= 0)
            oldest = np.argsort(self._used[self._page_in[there]], kind="stable")
            gone = there[oldest[: len(missing) - len(free)]]
            self._slot_of[self._page_in[gone]] = self._page_in[gone] = -1
            free = np.concatenate([free, gone])
        pages = []
        for page, slot, splats in zip(missing, free, self.file.read(missing), strict=False):
            begin = int(slot) * SIZE
            rows = slice(begin, begin + len(splats))
            for name, column in self._columns.items():
                column[begin : begin + SIZE] = 0
                column[rows] = splats.extras[name] if name in COLUMNS else splats.means[:, "xyz".index(name)]
            self._slot_of[page], self._page_in[slot] = slot, page
            pages.append((begin, splats))
        begins = np.array([begin for begin, _ in pages])
        inner, reached = self._standing.update((begins[:, None] + np.arange(SIZE)).reshape(-1))
        # nodes that stand for all below them are leaves; what is not drawn is fine enough for nobody
        sizes = np.where(inner, self._columns[NODE_SIZE], np.float32(0))
        return PageUpdate(pages, (sizes, np.where(reached, self._columns[PARENT_SIZE], np.float32(0))))

    def start(self) -> None:
        """Begins to read in a thread: the first pages of the file, and then what is asked for."""
        self._thread = threading.Thread(target=self._run, name="lodgs-paging", daemon=True)
        self._thread.start()

    def ask(self, eye: np.ndarray, k: float, direction: np.ndarray | None = None) -> None:
        """Says where the eye is, its detail, and in which direction it looks. Returns at once."""
        with self._changed:
            self._asked = np.array(eye, np.float64), float(k), direction
            self._changed.notify_all()

    def take(self) -> PageUpdate | None:
        """What has come in, to be taken over before the next is asked for; None where there is nothing."""
        with self._changed:
            update, self._ready = self._ready, None
            self._changed.notify_all()
        return update

    def stop(self) -> None:
        """Ends the thread; does not wait for it, which may be reading from a slow disk."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._done = self._asked
                # first the file's first pages: where they are needed is not known yet
                update = self.step(None, 0.0) if self._index is None else None
                if update is None and self._done is not None:
                    update = self.step(*self._done)
                with self._changed:
                    if update is None:
                        self._settled = self._done
                        self._changed.wait_for(lambda: self._stopping or self._asked is not self._done)
                    else:
                        self._changed.wait_for(lambda: self._stopping or self._ready is None)
                        self._ready = update
                        self.arrived += 1
        except InterruptedError:
            return
        except Exception as error:  # a disk that is gone, a file that is not what it says
            self.problem = str(error) or type(error).__name__
