"""The nodes of a tree outside memory: their records in a file of the run, cuts of subtrees in a cache.

In memory are the upper tree, what the cache holds within its budget, and some numbers for each subtree
(A LoD of Gaussians, Sec. 4.4). Of each node there are in the file the trained numbers, their moments and how
many steps they have made; in another one, for each subtree, the list of its nodes above leaves that HSPT
looks at: sorted by size, with means and sizes as they were when sizes were last made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...lod.rules.cut import MIN_DETAIL, detail_of
from ...lod.tree.forest import Forest, ForestShape, Piece, combine_trees
from ...lod.tree.shape import Tree
from ...optimize.memory import free_memory
from ...optimize.model import NAMES
from ...optimize.out_of_core.cut_cache import CutCache, CutTooLarge
from ...optimize.out_of_core.row_file import RowFile, RowLayout
from ...rasterize import Gaussians
from ...rasterize.records import gather_gaussians
from ...rasterize.sequential_point_tree import (
    LEAF,
    UpperTree,
    first_below,
    image_borders,
    node_bounds,
    search_lists,
)
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats

AT_ONCE = 1 << 14
"""Nodes that are looked at together where all are."""
MARK = 32
"""Of every so many entries of a list the size of the first is in memory."""
LIST_BLOCK = 64
"""Entries that are read and written together: of a list always the first ones."""
ENTRY = RowLayout({"node": (), "pair": (2,), "ranks": (2,), "ball": (4,)})
"""Of a list: a node and its children, by their numbers in the subtree, and these by their ranks in the list;
the node's mean and size."""


RecordPiece = tuple[torch.Tensor, Tree]
"""As ``lod.tree.forest.Piece``: the nodes' records, (., width), and the tree."""


def default_budget(device: torch.device | str = "cpu") -> int:
    """Bytes for the nodes that are in memory if nothing is said: half of what is free."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0] // 2
    return free_memory() // 2


def layout_of(sh_degree: int) -> RowLayout:
    """What a node's record holds, see ``rasterize.records``."""
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": ()}
    values: dict[str, tuple[int, ...]] = shapes | {"sh": ((sh_degree + 1) ** 2, 3)}
    count = sum(map(prod, values.values()))
    moments: dict[str, tuple[int, ...]] = {"first": (count,), "second": (count,)}
    return RowLayout({**values, **moments, "steps": (), "score": (), "seen": ()})


class Store:
    """The nodes of one tree.

    Args:
        folder: of the run, for files.
        budget: bytes of the cache.
        device: where what is drawn lives.

    Attributes:
        shape: where the pieces of the tree are among the rows.
        cache: of G + 1 groups: the subtrees, and the upper nodes, which are always all there.
        budget: of the cache, in bytes.
        coarsened: how many times coarser than asked for a view was shown at most; 1: none was.
        wanted: bytes of budget with which no view would have been.
    """

    shape: ForestShape
    cache: CutCache

    def __init__(self, folder: Path, sh_degree: int, budget: int, device: torch.device | str = "cpu") -> None:
        self.layout = layout_of(sh_degree)
        self._terms = (sh_degree + 1) ** 2
        self.budget, self._device = budget, device
        self.coarsened, self.wanted = 1.0, 0
        self.rows = RowFile(folder, self.layout)
        self._lists = RowFile(folder, ENTRY, block=LIST_BLOCK, name="lists")

    def __len__(self) -> int:
        return len(self.rows)

    # -- a tree comes in -------------------------------------------------------------------------------

    def fill(self, forest: Forest) -> None:
        """Takes a tree's pieces, one after the other; with them, it can be cut."""
        self.fill_records(
            ((self._records_of(splats), tree) for splats, tree in forest),
            lambda: (self._records_of(forest.upper[0]), forest.upper[1]),
        )

    def fill_records(self, subtrees: Iterable[RecordPiece], upper: Callable[[], RecordPiece]) -> None:
        """The same with records, which have moments; the upper tree is asked for when all others are here."""
        counts, waiting, nodes = [], [], 0
        for piece in subtrees:
            counts.append(piece[1].leaves)
            waiting.append(piece)
            nodes += len(piece[0])
            if nodes >= AT_ONCE:
                self._append(waiting)
                waiting, nodes = [], 0
        self._append(waiting)
        records, tree = upper()
        self.rows.append(records)
        self._take_shape(ForestShape(np.array(counts, np.int64), tree))
        self.resize()

    def _append(self, subtrees: list[RecordPiece]) -> None:
        if not subtrees:
            return
        records = torch.cat([records for records, _ in subtrees])
        counts = np.array([tree.leaves for _, tree in subtrees])
        many = 2 * counts - 1
        begins = np.cumsum(many) - many
        of_tree = np.repeat(np.arange(len(counts)), many)
        inside = np.arange(len(records)) - begins[of_tree] >= counts[of_tree]  # of the tree: not a leaf
        inner = np.flatnonzero(inside)
        children = np.concatenate([tree.children for _, tree in subtrees]) + begins[of_tree[inner], None]
        above = np.full(len(records), np.inf, np.float32)  # the size of the node above
        above[children] = self._sizes_of(counts, children, records)[inner, None]
        # what one cut has of a subtree has about as large ones above it: so it lies together in the file;
        # leaves are first all the same, and the root, above which is nothing, is last
        order = np.lexsort((above, inside, of_tree))
        number = np.empty_like(order)
        number[order] = np.arange(len(order))
        within = number - begins[of_tree]
        entries = np.zeros((len(inner), ENTRY.width), np.float32)
        entries[:, 0], entries[:, 1:3] = within[inner], within[children]
        self.rows.append(records[torch.from_numpy(order)])
        self._lists.append(torch.from_numpy(entries))

    def _sizes_of(self, counts: np.ndarray, children: np.ndarray, records: torch.Tensor) -> np.ndarray:
        """Sizes (N,) float32 of the records (N, width) of subtrees of so many leaves each.

        Args:
            children: (., 2) of the nodes above leaves in the order of their numbers, by number among all.
        """
        values = self.layout.split(records)
        order, tree = combine_trees(counts, children.astype(np.int32))
        sizes = np.empty(len(order), np.float32)
        sizes[order] = tree.sizes(values["means"].numpy()[order], values["log_scales"].numpy()[order])
        return sizes

    def _records_of(self, splats: Splats) -> torch.Tensor:
        records = np.zeros((len(splats), self.layout.width), np.float32)
        begin = 0
        for name in NAMES:
            end = begin + prod(self.layout.shapes[name])
            records[:, begin:end] = getattr(splats, name).reshape(len(splats), end - begin)
            begin = end
        return torch.from_numpy(records)

    def _take_shape(self, shape: ForestShape) -> None:
        self.shape = shape
        self._mark_ends = np.cumsum(-(-(shape.counts - 1) // MARK))
        self.cache = CutCache(self.rows, len(self.shape.counts) + 1, self.budget, self._device)

    # -- cuts ------------------------------------------------------------------------------------------

    def take(self, camera: Camera, pixels: float, near: float) -> np.ndarray:
        """Brings in what a view is shown at a granularity: places (M,) int64 in the cache, by their rows.

        Where there is no room for it, it is made coarser until there is.

        Raises:
            CutTooLarge: the budget is too small even for the coarsest cut.
        """
        coarser = 1.0
        while True:
            try:
                return self._take(camera, coarser * pixels, near)
            except CutTooLarge as error:
                if detail_of(camera.focal, coarser * pixels) == MIN_DETAIL:
                    raise
                if coarser == 1:
                    self.wanted = max(self.wanted, error.budget)
                # about as many times as few splats, as of a surface, but not so few that much room is left
                coarser *= min(max((error.needed / max(error.room, 1)) ** 0.5, 1.05), 4)
                self.coarsened = max(self.coarsened, coarser)

    def _take(self, camera: Camera, pixels: float, near: float) -> np.ndarray:
        """The same where there is room.

        A subtree's cut that is here serves from where it is not much too coarse or too fine (Eq. 7): the
        distances compared are those from its root, over the focal length, times the granularity.
        """
        k, eye = detail_of(camera.focal, pixels), camera.center
        nodes, lists, bands = self._top.traverse(eye, k, image_borders(camera, near))
        subtrees = len(self.shape.counts)
        alone, above = nodes[nodes < subtrees], nodes[nodes >= subtrees] - subtrees
        groups = np.append(alone, lists)
        bands = np.append(np.full((len(alone), 2), np.inf, np.float32), bands, axis=0)
        order = np.argsort(groups)
        groups, bands = groups[order], bands[order]
        distances = np.linalg.norm(self._top.balls[groups, :3] - eye, axis=1) / k

        def cut(anew: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            own = anew[anew < len(groups)]
            rows, counts = self.cut(groups[own], bands[own], eye, k)
            if len(own) < len(anew):
                rows = np.append(rows, np.arange(self.shape.ends[-1], len(self)))
                counts = np.append(counts, subtrees - 1)
            return rows, counts

        places = self.cache.acquire(np.append(groups, subtrees), np.append(distances, 1.0), cut)
        below, top = np.split(places, [len(places) - (subtrees - 1)])
        return np.append(below, top[np.sort(above)])

    def cut(
        self, groups: np.ndarray, bands: np.ndarray, eye: np.ndarray, k: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The rows (M,) int64 that an eye is shown of subtrees, ascending, and how many of each, (G,) int64.

        Args:
            groups: (G,) ascending.
            bands: (G, 2) as ``UpperTree.traverse`` says them; infinite where the root is fine enough.
        """
        counts = np.ones(len(groups), np.int64)
        alone = np.isinf(bands[:, 0])
        rows = [self.shape.ends[groups[alone]] - 1]
        searched = np.flatnonzero(~alone)
        lists, bands = groups[searched], bands[searched]
        begins, marks = self.shape.list_begins[lists], self._mark_ends[lists - 1] * (lists > 0)
        lengths = MARK * (first_below(self._marks, marks, self._mark_ends[lists], bands[:, 0]) - marks)
        lengths = np.minimum(lengths, self.shape.list_ends[lists] - begins)
        for some in _batches(lengths):
            entries = self._lists.read(_ranges(begins[some], lengths[some])).numpy()
            first = np.repeat(self.shape.begins[lists[some]], lengths[some])
            links = entries.view(np.int32)[:, 1:5]  # in the place of the same as float32
            links[:, :2], links[:, 2:] = entries[:, 1:3] + first[:, None], entries[:, 3:5]
            borders = np.append(0, np.cumsum(lengths[some]))
            these = np.arange(len(borders) - 1, dtype=np.int32)
            found, counts[searched[some]] = search_lists(
                links, entries[:, 5:], borders, these, bands[some], eye, k
            )
            rows.append(found)
        return np.sort(np.concatenate(rows).astype(np.int64)), counts

    def gaussians_at(self, places: np.ndarray) -> Gaussians:
        """A copy of the splats at places (M,) in the cache."""
        return gather_gaussians(self.cache.records, places, self._terms)

    def are_leaves(self, places: np.ndarray) -> np.ndarray:
        """Which (M,) bool of the records at places (M,) are leaves."""
        rows, groups = self.cache.rows_at(places), self.cache.groups_at(places)
        begins, counts = np.append(self.shape.begins, 0), np.append(self.shape.counts, 0)
        return rows - begins[groups] < counts[groups]

    # -- sizes -----------------------------------------------------------------------------------------

    def resize(self) -> None:
        """Cuts are made by the nodes as they are now."""
        self.cache.write_back()
        self.cache.release_cuts()
        found = [self._resized(some) for some in _batches(2 * self.shape.counts - 1)]
        self._marks, roots, shapes, *bounds = (np.concatenate(each) for each in zip(*found, strict=True))
        upper = self.layout.split(self.rows.read(np.arange(self.shape.ends[-1], len(self))))
        means = np.append(roots[:, :3], upper["means"].numpy(), axis=0)
        log_scales = np.append(shapes, upper["log_scales"].numpy(), axis=0)
        sizes = self.shape.upper.sizes(means, log_scales, roots[:, 3])
        low, high, reach = bounds
        self._top = UpperTree.from_bounds(self.shape.upper, means, log_scales, sizes, (low, high, reach))

    def _resized(self, some: slice) -> tuple[np.ndarray, ...]:
        """Sorts the lists of some subtrees anew; their marks, and of each subtree what stands above it has to
        know: mean and size of its root, (., 4), its log-scales, (., 3), and ``Bounds`` of all its nodes."""
        records, entries = self._read(some)
        counts = self.shape.counts[some]
        ends = np.cumsum(2 * counts - 1)
        begins = ends - (2 * counts - 1)
        of_list = np.repeat(np.arange(len(counts)), counts - 1)
        family = entries[:, :3].astype(np.int32) + begins[of_list, None].astype(np.int32)
        sizes = self._sizes_of(counts, family[np.argsort(family[:, 0]), 1:], records)
        values = self.layout.split(records)
        means, log_scales = (values[name].numpy() for name in ("means", "log_scales"))
        by_size = np.lexsort((-sizes[family[:, 0]], of_list))
        within = np.arange(len(entries)) - np.repeat(np.cumsum(counts - 1) - (counts - 1), counts - 1)
        balls = np.concatenate([means, sizes[:, None]], axis=1)
        ranks = np.full(len(balls), LEAF, np.float32)
        ranks[family[by_size, 0]] = within
        entries[:, :3] = entries[by_size, :3]
        entries[:, 3:5], entries[:, 5:] = ranks[family[by_size, 1:]], balls[family[by_size, 0]]
        self._lists.write(self._of_lists(some), torch.from_numpy(entries))
        bounds = node_bounds(means, log_scales, begins)
        return entries[within % MARK == 0, 8], balls[ends - 1], log_scales[ends - 1], *bounds

    def _read(self, some: slice) -> tuple[torch.Tensor, np.ndarray]:
        """The records (., width) and the lists' entries (., 9) of some subtrees."""
        begin, end = int(self.shape.begins[some.start]), int(self.shape.ends[some.stop - 1])
        entries = self._lists.read(self._of_lists(some)).numpy()
        return self.rows.read(np.arange(begin, end)), entries

    def _of_lists(self, some: slice) -> np.ndarray:
        """Where the lists of some subtrees are."""
        return np.arange(self.shape.list_begins[some.start], self.shape.list_ends[some.stop - 1])

    # -- the tree goes out -----------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Piece]:
        """The subtrees as they are now: a store is a ``Forest``."""
        for records, tree in self.records():
            yield self._splats(records), tree

    @property
    def upper(self) -> Piece:
        """The upper tree as it is now."""
        records, tree = self.upper_records()
        return self._splats(records), tree

    def records(self) -> Iterator[RecordPiece]:
        """The subtrees' records as they are now, (2n - 1, width) each."""
        self.cache.write_back()
        for some in _batches(2 * self.shape.counts - 1):
            records, entries = self._read(some)
            row = entry = 0
            for leaves in self.shape.counts[some].tolist():
                children = entries[entry : entry + leaves - 1, :3].astype(np.int32)
                children = children[np.argsort(children[:, 0]), 1:]
                yield records[row : row + 2 * leaves - 1], Tree(children)
                row, entry = row + 2 * leaves - 1, entry + leaves - 1

    def upper_records(self) -> RecordPiece:
        """The upper tree's, (G - 1, width)."""
        self.cache.write_back()
        return self.rows.read(np.arange(self.shape.ends[-1], len(self))), self.shape.upper

    def _splats(self, records: torch.Tensor) -> Splats:
        values = self.layout.split(records)
        means, quats, log_scales, opacity_logits, sh = (values[name].numpy().copy() for name in NAMES)
        return Splats(means, quats, log_scales, opacity_logits, sh)

    def rest(self) -> None:
        """Writes back what has changed, and gives the cache's memory back: no view can be taken any more."""
        self.cache.write_back()
        self.cache = CutCache(self.rows, 0, 0, self._device)

    # -- what lasts ------------------------------------------------------------------------------------

    def supersede(self, other: Store) -> None:
        """Takes the place of another store of the same run, see ``RowFile.supersede``."""
        self.rows.supersede(other.rows)
        self._lists.supersede(other._lists)

    def close(self) -> None:
        """Closes the files."""
        self.rows.close()
        self._lists.close()

    def state_dict(self) -> dict[str, Any]:
        """A checkpoint, for the file that is then written, see ``RowFile.state_dict``."""
        arrays = {
            "counts": self.shape.counts, "upper": self.shape.upper.children, "marks": self._marks,
            "balls": self._top.balls, "boxes": self._top.boxes,
        }  # fmt: skip
        return {
            "cache": self.cache.state_dict(),
            "lists": self._lists.state_dict(),
            **{name: torch.from_numpy(array.copy()) for name, array in arrays.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from what ``state_dict`` gave.

        Raises:
            ValueError: the files are not there, or are damaged.
        """
        arrays = {
            name: state[name].cpu().numpy().copy() for name in ("counts", "upper", "marks", "balls", "boxes")
        }
        self._take_shape(ForestShape(arrays["counts"], Tree(arrays["upper"])))
        self._marks = arrays["marks"]
        self._top = UpperTree(self.shape.upper, arrays["balls"], arrays["boxes"])
        self._lists.load_state_dict(state["lists"])
        self.cache.load_state_dict(state["cache"])


def _batches(lengths: np.ndarray) -> Iterator[slice]:
    """Consecutive ones, of about AT_ONCE together."""
    if len(lengths):
        number = (np.cumsum(lengths) - 1) // AT_ONCE
        borders = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(lengths)]
        yield from (slice(*ends) for ends in pairwise(borders))


def _ranges(begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """All numbers of some ranges, one after the other, int64."""
    ends = np.cumsum(lengths)
    return np.repeat(begins - (ends - lengths), lengths) + np.arange(ends[-1] if len(ends) else 0)
