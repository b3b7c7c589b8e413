"""Links between the splats of a tree that are in memory, while others are on disk. numpy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..rules.cut import ABOVE_ROOT, NODE_SIZE, PARENT, PARENT_SIZE, hash_rows, node_keys

COLUMNS = (NODE_SIZE, PARENT_SIZE, *PARENT)
"""Columns of the rule ``cut``."""
Columns = Mapping[str, np.ndarray]


class ResidentTree:
    """Links between the N splats in memory of a tree, of which others may be missing.

    Children identify their parent by its size and position, bit for bit. (Files have no two nodes of the same
    size and position, see ``shape.UniqueSizes``.) Links are cached and updated only where columns change.

    Args:
        columns: of the rule, and x, y, z, (N,) float32 each. Rows with a parent size of 0 are empty.
    """

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        self._parents = np.full(len(columns[NODE_SIZE]), -1, np.int32)
        self._keys, self._nodes = (
            np.zeros(0, np.uint64),
            np.zeros(0, np.int32),
        )  # of all inner nodes, sorted by key

    def update(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Update the links after columns have changed in some rows (M,).

        Returns:
            inner: (N,) bool, nodes with both children in memory. Others act as leaves.
            reached: (N,) bool, nodes whose ancestors are all in memory and inner. Others are never drawn.
        """
        size, parent_size = self._columns[NODE_SIZE], self._columns[PARENT_SIZE]
        count = len(self._parents)
        changed = np.zeros(count, bool)
        changed[rows] = True
        unchanged = ~changed[self._nodes]
        keys, nodes = self._keys[unchanged], self._nodes[unchanged]
        new_nodes = rows[size[rows] > 0]
        new_keys = hash_rows(self._node_keys(new_nodes, NODE_SIZE, "xyz"))
        order = np.argsort(new_keys, kind="stable")
        place = np.searchsorted(keys, new_keys[order], side="right")
        self._keys = np.insert(keys, place, new_keys[order])
        self._nodes = np.insert(nodes, place, new_nodes[order])

        root = parent_size >= np.float32(ABOVE_ROOT)
        self._parents[changed | changed[self._parents]] = -1
        orphans = np.flatnonzero((self._parents < 0) & (parent_size > size) & ~root)
        if len(self._nodes):
            parent_keys = self._node_keys(orphans, PARENT_SIZE, PARENT)
            place = np.searchsorted(self._keys, hash_rows(parent_keys)).clip(max=len(self._nodes) - 1)
            candidates = self._nodes[place]
            matches = (self._node_keys(candidates, NODE_SIZE, "xyz") == parent_keys).all(axis=1)
            self._parents[orphans[matches]] = candidates[matches]

        linked = self._parents >= 0
        inner = np.bincount(self._parents[linked], minlength=count)[:count] == 2
        # are all ancestors inner? doubles the distance to the ancestor in every iteration
        ancestor = np.where(linked, self._parents, np.arange(count, dtype=np.int32))
        reached = root | (linked & inner[ancestor])
        for _ in range(count.bit_length()):
            next_reached, next_ancestor = reached & reached[ancestor], ancestor[ancestor]
            if np.array_equal(next_reached, reached) and np.array_equal(ancestor, next_ancestor):
                break
            reached, ancestor = next_reached, next_ancestor
        return inner, reached

    @property
    def parents(self) -> np.ndarray:
        """Row of each splat's parent, (N,) int32; -1 if it is missing or there is none."""
        return self._parents

    def _node_keys(self, rows: np.ndarray, size: str, axes: Sequence[str]) -> np.ndarray:
        return node_keys(*(self._columns[name][rows] for name in (size, *axes)))
