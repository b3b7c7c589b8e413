"""A LoD of Gaussians' rule (Windisch et al. 2026, Sec. 4.3): a cut through a tree of splats, node by node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...scenes.view_tables import VIEW_TABLES
from ...splats.batches import batch_slices
from ...splats.gaussians import Splats
from ...splats.level_colors import LEVEL_COLORS
from ...splats.levels import MAX_LEVELS, Bundle, Level
from ...splats.ply import Columns
from ...splats.similarity import Similarity
from ..rule import (
    MIN_SPLATS,
    NO_COLUMNS,
    NO_TABLES,
    THINNING,
    Control,
    Masks,
    Relations,
    Rule,
    Values,
    distances,
)
from ..tree.nodes import (
    ABOVE_ROOT,
    BLOCK_BOUNDS,
    COLUMNS,
    MIN_DETAIL,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    ROUNDING,
    ResidentTree,
    detail_of,
    hash_rows,
    is_fine_enough,
    min_parent_size,
    node_keys,
    round_up,
)
from ..tree.paging import TreeFile

_BLOCK = 1 << 14
"""Splats per batch, so that a batch fits into the processor's cache."""
OCTAVES = len(LEVEL_COLORS) - 1
"""Number of colours for node sizes, one per factor of 2, repeating; leaves have a colour of their own."""


class TreeRelations(Relations):
    """Parents and children among the nodes of a tree, whose levels are concatenated.

    Clean-up tests leaves. An inner node remains while any leaf below it remains. If only one child remains,
    the child replaces it, so that every node still has two children or none, and every cut is complete.
    """

    columns = (*COLUMNS, *"xyz")

    def __init__(self, columns: Mapping[int, Columns]) -> None:
        self._numbers = list(columns)
        self._ends = np.cumsum([len(level_columns[NODE_SIZE]) for level_columns in columns.values()])
        self._columns = {
            name: np.concatenate([level_columns[name] for level_columns in columns.values()])
            for name in self.columns
        }

    @cached_property
    def _parents(self) -> np.ndarray:
        """Row of each node's parent, (N,) int32; -1 if there is none."""
        tree = ResidentTree(self._columns)
        tree.update(np.arange(self._ends[-1]))
        return tree.parents

    @cached_property
    def _children(self) -> np.ndarray:
        """Number of each node's children, (N,)."""
        return self._count_children(np.ones(self._ends[-1], bool))

    def testable(self, masks: Masks) -> Masks:
        """Return the leaves in the masks."""
        leaves = self._by_level(self._children == 0)
        return {number: mask & leaves[number] for number, mask in masks.items()}

    def completed(self, masks: Masks) -> Masks:
        """Return masks of the remaining leaves and all their ancestors."""
        return self._by_level(self._with_ancestors(masks))

    def pruned(self, masks: Masks) -> tuple[Masks, Mapping[int, Columns]]:
        remaining = self._with_ancestors(masks)
        single = remaining & (self._count_children(remaining) == 1)
        # each node takes the parent of its highest ancestor in a chain of nodes with one child
        own = np.arange(len(remaining), dtype=np.int32)
        replaced = np.where((self._parents >= 0) & single[self._parents], self._parents, own)
        while not np.array_equal(higher := replaced[replaced], replaced):
            replaced = higher
        remaining &= ~single
        columns = {name: self._columns[name] for name in COLUMNS}
        for name in (PARENT_SIZE, *PARENT):
            columns[name] = columns[name][replaced]
        masks = self._by_level(remaining)
        by_level = {name: self._by_level(column) for name, column in columns.items()}
        return masks, {
            number: {name: by_level[name][number][mask] for name in COLUMNS} for number, mask in masks.items()
        }

    def transformed(self, placement: Similarity) -> Mapping[int, Columns]:
        """Return sizes that keep cuts proper, and keep nodes at the same position distinguishable.

        Sizes are the scaled ones, or a few ulps larger. Needs about 150 bytes per node.
        """
        original = self._columns
        transformed = placement.transform_columns(
            original, (NODE_SIZE, PARENT_SIZE), (PARENT, ("x", "y", "z"))
        )
        inside = (original[PARENT_SIZE] > 0) & (original[PARENT_SIZE] < ABOVE_ROOT)
        # nodes refer to their parent by its size and position, so children of a parent share a key
        parent_hashes = hash_rows(node_keys(*(original[name] for name in (PARENT_SIZE, *PARENT)))[inside])
        keys, first, key_of_child = np.unique(parent_hashes, return_index=True, return_inverse=True)
        own_hashes = hash_rows(node_keys(*(original[name] for name in (NODE_SIZE, *"xyz"))))
        key_of_node = np.searchsorted(keys, own_hashes).clip(max=max(len(keys) - 1, 0))
        is_parent = original[NODE_SIZE] > 0
        if len(keys):
            is_parent &= keys[key_of_node] == own_hashes
        sizes = transformed[NODE_SIZE].copy()
        parents = np.stack([transformed[axis][inside] for axis in PARENT], axis=1)
        means = np.stack([transformed[axis][inside] for axis in "xyz"], axis=1)
        distance = np.sqrt(np.square(means.astype(np.float64) - parents).sum(axis=1))
        key_sizes = transformed[PARENT_SIZE][inside][first]
        key_positions = parents[first] + np.float32(0)
        while len(keys):
            sizes[is_parent] = key_sizes[key_of_node[is_parent]]
            minimum = np.zeros(len(keys))
            np.maximum.at(minimum, key_of_child, min_parent_size(sizes[inside], distance))
            larger = np.maximum(key_sizes, round_up(minimum))
            duplicate = np.ones(len(keys), bool)
            hashes = hash_rows(np.column_stack([larger, key_positions]))
            duplicate[np.unique(hashes, return_index=True)[1]] = False
            larger[duplicate] = np.nextafter(larger[duplicate], np.float32(np.inf))
            if np.array_equal(larger, key_sizes):
                break
            key_sizes = larger
        parent_sizes = original[PARENT_SIZE].copy()
        parent_sizes[inside] = key_sizes[key_of_child]
        transformed |= {NODE_SIZE: sizes, PARENT_SIZE: parent_sizes}
        by_level = {name: self._by_level(transformed[name]) for name in COLUMNS}
        return {number: {name: by_level[name][number] for name in COLUMNS} for number in self._numbers}

    def _with_ancestors(self, masks: Masks) -> np.ndarray:
        remaining = np.concatenate([masks[number] for number in self._numbers]) & (self._children == 0)
        added = np.flatnonzero(remaining)
        while len(added):
            parents = np.unique(self._parents[added])
            added = parents[(parents >= 0) & ~remaining[parents]]
            remaining[added] = True
        return remaining

    def _count_children(self, mask: np.ndarray) -> np.ndarray:
        """Return the number of each node's children (N,) in a mask."""
        parents = self._parents[mask]
        return np.bincount(parents[parents >= 0], minlength=len(mask))

    def _by_level(self, values: np.ndarray) -> dict[int, np.ndarray]:
        return dict(zip(self._numbers, np.split(values, self._ends[:-1]), strict=True))


class Cut(Rule):
    """Weight 1 if a node is fine enough and its parent is not, else 0 (Eq. 5).

    A node is fine enough if its size, sqrt(s1 s2 + s1 s3 + s2 s3) of its scales (Eq. 6), covers at most
    ``pixels`` pixels. There are two levels: the leaves, which are the full model and always fine enough, and
    the inner nodes.

    Sizes are saturated (:func:`min_parent_size`; not in the paper). So for every camera with k >= MIN_DETAIL,
    all descendants of a fine enough node are fine enough, and exactly one node on each path from the root to
    a leaf is drawn. The paper's M_d has the same triangle inequality with the root of an SPT; its Eq. 5 is
    proper only while training preserves the heap condition.
    """

    name = "cut"
    columns = COLUMNS
    lengths = (NODE_SIZE, PARENT_SIZE)
    places = (PARENT,)
    block_bounds = BLOCK_BOUNDS
    relations = TreeRelations
    paged_file = TreeFile
    controls = (
        Control(
            "pixels", 1.0, 0.1, 100.0, "Granularity",
            "Replace a branch of the tree by its root if that covers at most this many pixels. Smaller is "
            "finer",
            soft=(0.5, 16.0), unit="px",
        ),
    )  # fmt: skip
    sweep = ("pixels", (0.5, 1.0, 2.0, 4.0, 8.0, 16.0))

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        k = detail_of(focal_px, values["pixels"])
        weights = np.zeros(len(means), np.float32)
        for block in batch_slices(len(means), _BLOCK):
            parents = [columns[name][block] for name in PARENT]
            sizes = columns[NODE_SIZE][block]
            drawn = ~is_fine_enough(parents, columns[PARENT_SIZE][block], position, k)
            if sizes.any() and drawn.any():  # there are inner nodes, and some parents are too coarse
                drawn &= is_fine_enough([*means[block].T], sizes, position, k)
            weights[block] = drawn
        return weights

    def distance_band(self, focal_px, facts, values, highest=NO_COLUMNS) -> tuple[float, float | np.ndarray]:
        """Return 0 and the distance up to which parents are too coarse.

        A node is at most MIN_DETAIL times its parent's size away from the parent.
        """
        if PARENT_SIZE not in highest:
            return 0.0, np.inf
        k = detail_of(focal_px, values["pixels"])
        return 0.0, (k + MIN_DETAIL) * (1 + 4 * ROUNDING) * highest[PARENT_SIZE].astype(np.float64)

    @property
    def color_legend(self) -> str:
        return "Each colour stands for half the size of the previous one; white is the finest level."

    def splat_level(self, columns, facts) -> np.ndarray:
        """Return a colour number: the octave of a node's size, OCTAVES + 1 for leaves."""
        return _octave(columns[NODE_SIZE])

    def target_level(self, means, position, focal_px, facts, values) -> np.ndarray:
        """Return the colour number of the largest size that is fine enough at each splat."""
        return _octave(distances(means, position) / np.float32(detail_of(focal_px, values["pixels"])))

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "pixels")

    def standalone_levels(self, levels: Sequence[int]) -> Sequence[int]:
        """Return the level of the leaves."""
        return levels[-1:]

    def complete_levels(self, bundle: Bundle) -> Bundle:
        """Return cuts as levels of the rule ``bands``.

        The finest level has the leaves. Each coarser one is a cut at one node size, the smallest size with at
        most 1 / THINNING of the finer level's splats, down to MIN_SPLATS. The rule selects them by distance
        with the tree's limit of pixels per node.
        """
        levels = [level.rows for level in bundle.levels]
        splats = Splats.concatenated([rows.select(slice(0, len(rows))) for rows in levels])
        own = splats.extras[NODE_SIZE]
        parent = splats.extras[PARENT_SIZE]
        splats = replace(splats, extras={name: x for name, x in splats.extras.items() if name not in COLUMNS})
        sizes = np.unique(own)
        counts = np.searchsorted(np.sort(own), sizes, "right")
        counts -= np.searchsorted(np.sort(parent), sizes, "right")
        cuts = [0.0]
        limit = counts[0] // THINNING
        while limit >= MIN_SPLATS and len(cuts) < MAX_LEVELS:
            index = int(np.argmax(counts <= limit))  # counts decrease
            cuts.append(float(sizes[index]))
            limit = counts[index] // THINNING
        levels = [
            Level(number, splats.select((own <= size) & (parent > size)), {"s_min": size})
            for number, size in enumerate(reversed(cuts), 1)
        ]
        tables = {name: table for name, table in bundle.tables.items() if name in VIEW_TABLES}
        controls = {"gamma": bundle.controls.get("pixels", self.controls[0].default), "first": 1}
        return replace(bundle, levels=levels, rule="bands", controls=controls, tables=tables)

    def exceeds_budget(self, finest: int, budget: int) -> bool:
        """Return whether all nodes exceed the budget; about half of them are leaves."""
        return 2 * finest >= budget


def _octave(sizes: np.ndarray) -> np.ndarray:
    """Return (N,) float32 from 1 on, one higher for half the size."""
    with np.errstate(divide="ignore", invalid="ignore"):
        octaves = -np.floor(np.log2(sizes)) % np.float32(OCTAVES)
    return np.where(sizes > 0, octaves, np.float32(OCTAVES)) + np.float32(1)


RULE = Cut()
