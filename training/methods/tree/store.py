"""Out-of-core storage for the nodes of a tree: records on disk, cuts of subtrees in a cache.

Memory holds the upper tree, the cache within its budget, and a few numbers per subtree (A LoD of Gaussians,
Sec. 4.4). One file holds each node's trained values, their moments and step count. A second file holds a
list of inner nodes per subtree for HSPT: sorted by size, with means and sizes as of the last size update.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...lod.tree.forest import Forest, ForestShape, Piece, combine_trees
from ...lod.tree.nodes import MIN_DETAIL, NODE_SIZE, detail_of
from ...lod.tree.shape import Tree
from ...optimize.memory import free_memory
from ...optimize.model import NAMES
from ...optimize.out_of_core.cut_cache import CutCache, CutTooLarge
from ...optimize.out_of_core.row_file import RowFile, RowLayout
from ...rasterize import Gaussians
from ...rasterize.records import gather_gaussians
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from .sequential_point_tree import (
    LEAF,
    UpperTree,
    first_below,
    image_borders,
    node_bounds,
    search_lists,
)

BATCH_NODES = 1 << 14
"""Number of nodes to process at a time in passes over all nodes."""
MARK_INTERVAL = 32
"""Interval of list entries whose size is kept in memory."""
LIST_BLOCK = 64
"""List entries to read and write at a time; searches read lists from the start."""
ENTRY_LAYOUT = RowLayout({"node": (), "pair": (2,), "ranks": (2,), "ball": (4,)})
"""List entry: a node and its children by number in the subtree, the children's ranks in the list, and the
node's mean and size."""


RecordPiece = tuple[torch.Tensor, Tree]
"""The records of nodes, (., width), and their tree; like ``lod.tree.forest.Piece``."""


def default_budget(device: torch.device | str = "cpu") -> int:
    """Return the default memory budget for nodes in bytes: half of the free memory."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0] // 2
    return free_memory() // 2


def record_layout(sh_degree: int) -> RowLayout:
    """Return the layout of a node's record, see ``rasterize.records``."""
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "opacity_logits": (),
    }
    values = shapes | {"sh": ((sh_degree + 1) ** 2, 3)}
    count = sum(map(prod, values.values()))
    moments: dict[str, tuple[int, ...]] = {"first": (count,), "second": (count,)}
    return RowLayout({**values, **moments, "steps": (), "score": (), "seen": (), "error": ()})


class NodeStore:
    """Nodes of one tree on disk, with a cache in memory.

    Args:
        folder: folder of the run, for the files.
        budget: size of the cache in bytes.
        device: device of the cached records.

    Attributes:
        shape: row ranges of the pieces of the tree.
        cache: G + 1 groups: the subtrees, and the upper nodes, which are always cached.
        budget: size of the cache in bytes.
        max_coarsening: maximum factor by which a view's granularity was coarsened to fit; 1 if none was.
        needed_budget: budget in bytes that avoids coarsening; 0 if no view was coarsened.
    """

    shape: ForestShape
    cache: CutCache

    def __init__(self, folder: Path, sh_degree: int, budget: int, device: torch.device | str = "cpu") -> None:
        self.layout = record_layout(sh_degree)
        self._coefficients = (sh_degree + 1) ** 2
        self.budget, self._device = budget, device
        self.max_coarsening, self.needed_budget = 1.0, 0
        self.rows = RowFile(folder, self.layout)
        self._lists = RowFile(folder, ENTRY_LAYOUT, block=LIST_BLOCK, name="lists")

    def __len__(self) -> int:
        return len(self.rows)

    # -- filling ---------------------------------------------------------------------------------------

    def fill(self, forest: Forest) -> None:
        """Store the pieces of a tree one after the other, and prepare it for cuts."""
        self.fill_records(
            ((self._records_of(splats), tree) for splats, tree in forest),
            lambda: (self._records_of(forest.upper[0]), forest.upper[1]),
        )

    def fill_records(self, subtrees: Iterable[RecordPiece], upper: Callable[[], RecordPiece]) -> None:
        """Store records, which include moments; ``upper`` is called after the last subtree."""
        counts, pending, nodes = [], [], 0
        for piece in subtrees:
            counts.append(piece[1].leaves)
            pending.append(piece)
            nodes += len(piece[0])
            if nodes >= BATCH_NODES:
                self._append(pending)
                pending, nodes = [], 0
        self._append(pending)
        records, tree = upper()
        self.rows.append(records)
        self._set_shape(ForestShape(np.array(counts, np.int64), tree))
        self.update_sizes()

    def _append(self, subtrees: list[RecordPiece]) -> None:
        """Append the records and list entries of subtrees to the files."""
        if not subtrees:
            return
        records = torch.cat([records for records, _ in subtrees])
        counts = np.array([tree.leaves for _, tree in subtrees])
        node_counts = 2 * counts - 1
        begins = np.cumsum(node_counts) - node_counts
        of_tree = np.repeat(np.arange(len(counts)), node_counts)
        is_inner = np.arange(len(records)) - begins[of_tree] >= counts[of_tree]  # inner nodes
        inner_nodes = np.flatnonzero(is_inner)
        children = (
            np.concatenate([tree.children for _, tree in subtrees]) + begins[of_tree[inner_nodes], None]
        )
        parent_sizes = np.full(len(records), np.inf, np.float32)  # the size of the node above
        parent_sizes[children] = self._sizes_of(counts, children, records)[inner_nodes, None]
        # sort by parent size, which is similar within a cut, so that cuts are contiguous on disk; leaves come
        # first, and the root, which has no parent, comes last
        order = np.lexsort((parent_sizes, is_inner, of_tree))
        number = np.empty_like(order)
        number[order] = np.arange(len(order))
        within = number - begins[of_tree]
        entries = np.zeros((len(inner_nodes), ENTRY_LAYOUT.width), np.float32)
        entries[:, 0], entries[:, 1:3] = within[inner_nodes], within[children]
        self.rows.append(records[torch.from_numpy(order)])
        self._lists.append(torch.from_numpy(entries))

    def _sizes_of(self, counts: np.ndarray, children: np.ndarray, records: torch.Tensor) -> np.ndarray:
        """Return the sizes (N,) float32 of the records (N, width) of several subtrees.

        Args:
            counts: number of leaves of each subtree.
            children: (., 2) of the inner nodes ordered by number, as numbers among all records.
        """
        values = self.layout.split(records)
        order, tree = combine_trees(counts, children.astype(np.int32))
        sizes = np.empty(len(order), np.float32)
        means, log_scales, errors = (values[name].numpy()[order] for name in ("means", "log_scales", "error"))
        sizes[order] = tree.sizes(means, log_scales, errors=errors)
        return sizes

    def _records_of(self, splats: Splats) -> torch.Tensor:
        """Return the records (N, width) of splats, whose moments are zero."""
        records = np.zeros((len(splats), self.layout.width), np.float32)
        begin = 0
        for name in NAMES:
            end = begin + prod(self.layout.shapes[name])
            records[:, begin:end] = getattr(splats, name).reshape(len(splats), end - begin)
            begin = end
        if NODE_SIZE in splats.extras:
            records[:, -1] = splats.extras[NODE_SIZE]
        return torch.from_numpy(records)

    def _set_shape(self, shape: ForestShape) -> None:
        self.shape = shape
        self._mark_ends = np.cumsum(-(-(shape.counts - 1) // MARK_INTERVAL))
        self.cache = CutCache(self.rows, len(self.shape.counts) + 1, self.budget, self._device)

    # -- cuts ------------------------------------------------------------------------------------------

    def load_cut(self, camera: Camera, pixels: float, near: float) -> np.ndarray:
        """Load the cut of a view into the cache.

        The granularity is coarsened until the cut fits.

        Args:
            pixels: granularity in pixels.

        Returns:
            Cache indices (M,) int64, ordered by row.

        Raises:
            CutTooLarge: even the coarsest cut does not fit.
        """
        factor = 1.0
        while True:
            try:
                return self._load_exact_cut(camera, factor * pixels, near)
            except CutTooLarge as error:
                if detail_of(camera.focal, factor * pixels) == MIN_DETAIL:
                    raise
                if factor == 1:
                    self.needed_budget = max(self.needed_budget, error.budget)
                # splats of a surface fall with the square; small enough steps keep the cache well filled
                factor *= min(max((error.needed / max(error.room, 1)) ** 0.5, 1.05), 4)
                self.max_coarsening = max(self.max_coarsening, factor)

    def _load_exact_cut(self, camera: Camera, pixels: float, near: float) -> np.ndarray:
        """Load the cut of a view into the cache without coarsening.

        The cached cut of a subtree is reused while it is not much too coarse or too fine (Eq. 7). That
        compares distances from the subtree's root over the focal length, times the granularity.
        """
        k, position = detail_of(camera.focal, pixels), camera.center
        nodes, lists, bands = self._top.traverse(position, k, image_borders(camera, near))
        subtrees = len(self.shape.counts)
        roots = nodes[nodes < subtrees]
        upper = nodes[nodes >= subtrees] - subtrees
        groups = np.append(roots, lists)
        bands = np.append(np.full((len(roots), 2), np.inf, np.float32), bands, axis=0)
        order = np.argsort(groups)
        groups, bands = groups[order], bands[order]
        distances = np.linalg.norm(self._top.balls[groups, :3] - position, axis=1) / k

        def find_missing(missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            own = missing[missing < len(groups)]
            rows, counts = self.find_cut(groups[own], bands[own], position, k)
            if len(own) < len(missing):
                rows = np.append(rows, np.arange(self.shape.ends[-1], len(self)))
                counts = np.append(counts, subtrees - 1)
            return rows, counts

        indices = self.cache.acquire(np.append(groups, subtrees), np.append(distances, 1.0), find_missing)
        below, top = np.split(indices, [len(indices) - (subtrees - 1)])
        return np.append(below, top[np.sort(upper)])

    def find_cut(
        self, groups: np.ndarray, bands: np.ndarray, position: np.ndarray, k: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the cut of subtrees for a camera position.

        Args:
            groups: (G,) subtrees, ascending.
            bands: (G, 2) from ``UpperTree.traverse``; infinite if the root is fine enough.

        Returns:
            The rows (M,) int64, ascending, and their number per subtree, (G,) int64.
        """
        counts = np.ones(len(groups), np.int64)
        is_root_cut = np.isinf(bands[:, 0])
        rows = [self.shape.ends[groups[is_root_cut]] - 1]
        search_groups = np.flatnonzero(~is_root_cut)
        lists, bands = groups[search_groups], bands[search_groups]
        begins, marks = self.shape.list_begins[lists], self._mark_ends[lists - 1] * (lists > 0)
        lengths = MARK_INTERVAL * (
            first_below(self._marks, marks, self._mark_ends[lists], bands[:, 0]) - marks
        )
        lengths = np.minimum(lengths, self.shape.list_ends[lists] - begins)
        for part in _batches(lengths):
            entries = self._lists.read(_ranges(begins[part], lengths[part])).numpy()
            first = np.repeat(self.shape.begins[lists[part]], lengths[part])
            links = entries.view(np.int32)[:, 1:5]  # overwrites the float32 values
            links[:, :2], links[:, 2:] = entries[:, 1:3] + first[:, None], entries[:, 3:5]
            borders = np.append(0, np.cumsum(lengths[part]))
            list_numbers = np.arange(len(borders) - 1, dtype=np.int32)
            cut_rows, counts[search_groups[part]] = search_lists(
                links, entries[:, 5:], borders, list_numbers, bands[part], position, k
            )
            rows.append(cut_rows)
        return np.sort(np.concatenate(rows).astype(np.int64)), counts

    def gaussians_at(self, indices: np.ndarray) -> Gaussians:
        """Copy the splats at cache indices (M,)."""
        return gather_gaussians(self.cache.records, indices, self._coefficients)

    def is_leaf(self, indices: np.ndarray) -> np.ndarray:
        """Return which records at cache indices (M,) are leaves, (M,) bool."""
        rows, groups = self.cache.rows_at(indices), self.cache.groups_at(indices)
        begins, counts = np.append(self.shape.begins, 0), np.append(self.shape.counts, 0)
        return rows - begins[groups] < counts[groups]

    # -- sizes -----------------------------------------------------------------------------------------

    def update_sizes(self) -> None:
        """Update the node sizes that decide the cuts to the current values."""
        self.cache.write_back()
        self.cache.release_cuts()
        parts = [self._sort_lists(part) for part in _batches(2 * self.shape.counts - 1)]
        self._marks, roots, shapes, *bounds = (np.concatenate(column) for column in zip(*parts, strict=True))
        upper = self.layout.split(self.rows.read(np.arange(self.shape.ends[-1], len(self))))
        means = np.append(roots[:, :3], upper["means"].numpy(), axis=0)
        log_scales = np.append(shapes, upper["log_scales"].numpy(), axis=0)
        errors = np.append(np.zeros(len(roots), np.float32), upper["error"].numpy())
        sizes = self.shape.upper.sizes(means, log_scales, roots[:, 3], errors=errors)
        low, high, reach = bounds
        self._top = UpperTree.from_bounds(self.shape.upper, means, log_scales, sizes, (low, high, reach))

    def _sort_lists(self, part: slice) -> tuple[np.ndarray, ...]:
        """Sort the lists of some subtrees by current size.

        Returns:
            Their marks, and for each subtree its root's mean and size (., 4) and log scales (., 3), and the
                ``Bounds`` of all its nodes.
        """
        records, entries = self._read(part)
        counts = self.shape.counts[part]
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
        self._lists.write(self._list_rows(part), torch.from_numpy(entries))
        bounds = node_bounds(means, log_scales, begins)
        return entries[within % MARK_INTERVAL == 0, 8], balls[ends - 1], log_scales[ends - 1], *bounds

    def _read(self, part: slice) -> tuple[torch.Tensor, np.ndarray]:
        """Read the records (., width) and list entries (., 9) of some subtrees."""
        begin, end = int(self.shape.begins[part.start]), int(self.shape.ends[part.stop - 1])
        entries = self._lists.read(self._list_rows(part)).numpy()
        return self.rows.read(np.arange(begin, end)), entries

    def _list_rows(self, part: slice) -> np.ndarray:
        """Return the list rows of some subtrees."""
        return np.arange(self.shape.list_begins[part.start], self.shape.list_ends[part.stop - 1])

    # -- reading ---------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Piece]:
        """Yield the current subtrees; a store is a ``Forest``."""
        for records, tree in self.records():
            yield self._splats(records), tree

    @property
    def upper(self) -> Piece:
        """The current upper tree."""
        records, tree = self.upper_records()
        return self._splats(records), tree

    def records(self) -> Iterator[RecordPiece]:
        """Yield the current records of the subtrees, (2n - 1, width) each."""
        self.cache.write_back()
        for part in _batches(2 * self.shape.counts - 1):
            records, entries = self._read(part)
            row = entry = 0
            for leaves in self.shape.counts[part].tolist():
                children = entries[entry : entry + leaves - 1, :3].astype(np.int32)
                children = children[np.argsort(children[:, 0]), 1:]
                yield records[row : row + 2 * leaves - 1], Tree(children)
                row, entry = row + 2 * leaves - 1, entry + leaves - 1

    def upper_records(self) -> RecordPiece:
        """Return the records of the upper tree, (G - 1, width)."""
        self.cache.write_back()
        return self.rows.read(np.arange(self.shape.ends[-1], len(self))), self.shape.upper

    def _splats(self, records: torch.Tensor) -> Splats:
        values = self.layout.split(records)
        means, quats, log_scales, opacity_logits, sh = (values[name].numpy().copy() for name in NAMES)
        return Splats(
            means, quats, log_scales, opacity_logits, sh, {NODE_SIZE: values["error"].numpy().copy()}
        )

    def release_cache(self) -> None:
        """Write back changes and free the cache; afterwards no cut can be loaded."""
        self.cache.write_back()
        self.cache = CutCache(self.rows, 0, 0, self._device)

    # -- checkpoints -----------------------------------------------------------------------------------

    def supersede(self, previous: NodeStore) -> None:
        """Replace another store of the same run, see ``RowFile.supersede``."""
        self.rows.supersede(previous.rows)
        self._lists.supersede(previous._lists)

    def close(self) -> None:
        """Close the files."""
        self.rows.close()
        self._lists.close()

    def state_dict(self) -> dict[str, Any]:
        """Return a checkpoint; it belongs to the file written then, see ``RowFile.state_dict``."""
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
        """Restore a checkpoint.

        Raises:
            ValueError: the files are missing or corrupt.
        """
        arrays = {
            name: state[name].cpu().numpy().copy() for name in ("counts", "upper", "marks", "balls", "boxes")
        }
        self._set_shape(ForestShape(arrays["counts"], Tree(arrays["upper"])))
        self._marks = arrays["marks"]
        self._top = UpperTree(self.shape.upper, arrays["balls"], arrays["boxes"])
        self._lists.load_state_dict(state["lists"])
        self.cache.load_state_dict(state["cache"])


def _batches(lengths: np.ndarray) -> Iterator[slice]:
    """Yield slices of consecutive lengths, each summing up to about BATCH_NODES."""
    if len(lengths):
        number = (np.cumsum(lengths) - 1) // BATCH_NODES
        borders = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(lengths)]
        yield from (slice(*ends) for ends in pairwise(borders))


def _ranges(begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Concatenate the numbers of several ranges, int64."""
    ends = np.cumsum(lengths)
    return np.repeat(begins - (ends - lengths), lengths) + np.arange(ends[-1] if len(ends) else 0)
