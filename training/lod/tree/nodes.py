"""Nodes of a tree of splats: their columns, the detail at which they are drawn, and links. numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...splats.morton import morton_codes
from ..blocks import BOUNDS, BlockIndex, Columns
from ..rule import axis_distances

NODE_SIZE, PARENT_SIZE = "node_size", "parent_size"
"""Columns of sizes, in scene units: of the node (0 for leaves) and of its parent."""
PARENT = ("parent_x", "parent_y", "parent_z")
"""Columns of the parent's mean."""
ABOVE_ROOT = 3.0e38
"""Parent size of the root, which has no parent: larger than any distance, but finite for files."""
MIN_DETAIL = 8.0
"""Minimum detail k of a camera: cuts are proper for every k from here on."""
ROUNDING = 2.0**-20
"""Relative margin on a parent's size: 16 float32 ulps. Comparing a distance with k size, for parent and
child, has an error of at most 9 ulps."""
COLUMNS = (NODE_SIZE, PARENT_SIZE, *PARENT)
"""All columns of nodes, which are those of the rule ``cut``."""
BLOCK_BOUNDS = {
    PARENT_SIZE: (PARENT_SIZE, np.maximum),
    **{low: (name, np.minimum) for low, name in zip(BOUNDS[:3], PARENT, strict=True)},
    **{high: (name, np.maximum) for high, name in zip(BOUNDS[3:], PARENT, strict=True)},
}
"""Columns of the table of blocks: the largest parent, and the bounds of the parents' positions. They
determine where a block is needed."""


def detail_of(focal_px: float, pixels: float) -> float:
    """Return the detail k of a camera: a node is fine enough from the distance k size on."""
    return max(focal_px / pixels, MIN_DETAIL)


def is_fine_enough(
    axes: Sequence[np.ndarray], sizes: np.ndarray, position: np.ndarray, k: float
) -> np.ndarray:
    """Return a mask (N,) of the nodes that are fine enough, ‖c - μ‖ >= k size.

    All operations are float32, so that a node gives the same bits as itself and as a parent.

    Args:
        axes: x, y and z of means, (N,) float32 each.
        sizes: (N,) float32.
        position: (3,) c, of the camera.
        k: see :func:`detail_of`.
    """
    with np.errstate(over="ignore"):
        return axis_distances(axes, position) >= np.float32(k) * sizes


def min_parent_size(child_sizes: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the minimum sizes (N,) float64 of parents that keep cuts proper, with a margin for float32.

    The size is size_child + d / MIN_DETAIL, with the distance d of child and parent. If a parent is fine
    enough, ‖c - μ_p‖ >= k size_p, so is its child, because ‖c - μ_c‖ >= ‖c - μ_p‖ - d >= k size_p - d >=
    k size_child for every k >= MIN_DETAIL.

    Args:
        child_sizes: (N,).
        distance: (N,) of the children's means from their parents'.
    """
    return (child_sizes + np.asarray(distance, np.float64) / MIN_DETAIL) * (1 + ROUNDING)


def round_up(values: np.ndarray) -> np.ndarray:
    """Return the smallest float32 values (N,) that are not below float64 values."""
    rounded = values.astype(np.float32)
    return np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded)


def hash_rows(rows: np.ndarray) -> np.ndarray:
    """Return 64-bit hashes (N,) of rows (N, 4) float32."""
    words = np.ascontiguousarray(rows).view(np.uint32).astype(np.uint64)
    hashes = np.zeros(len(rows), np.uint64)
    for word in words.T:
        hashes = (hashes ^ word) * np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    return hashes


def node_keys(sizes: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return keys (N, 4) float32 that identify nodes, from sizes and positions (N,) float32."""
    return np.stack([sizes, x, y, z], axis=1) + np.float32(0)  # turns -0 into 0


def needed_detail(columns: Columns, position: np.ndarray | None) -> np.ndarray:
    """Return the minimum detail k at which a camera at a position (3,) needs splats, (N,).

    A camera needs a splat if the parent is not fine enough. Without a position, return 1 / size_p.

    Args:
        columns: PARENT_SIZE and PARENT, (N,) float32 each.
    """
    distance = 1.0 if position is None else axis_distances([columns[name] for name in PARENT], position)
    return distance / np.maximum(columns[PARENT_SIZE], np.float32(1e-30))


def streaming_order(columns: Columns) -> np.ndarray:
    """Return the order (N,) int64 of a level's splats in a file.

    Splats are sorted by octave of the parent's size, largest first, then by space. The parent determines
    where a splat is needed, so that blocks have similar sizes and positions, and siblings are adjacent.

    Args:
        columns: columns of the rule, (N,) each.
    """
    codes = morton_codes(np.stack([columns[name] for name in PARENT], axis=1))
    octaves = -np.floor(np.log2(np.maximum(columns[PARENT_SIZE], 1e-30)))
    return np.lexsort((codes, octaves.astype(np.int16)))


def parent_index(number: int, columns: Columns) -> BlockIndex:
    """Return the index of a level's splats, in streaming order, by their parents: see BLOCK_BOUNDS."""
    return BlockIndex.from_columns(number, columns, BLOCK_BOUNDS)


class ResidentTree:
    """Links between the N splats of a tree in memory; its other splats may be missing.

    Children identify their parent by its size and position, bit for bit. (Files have no two nodes of the same
    size and position, see ``shape.UniqueSizes``.) Links are cached and updated only where columns change.

    Args:
        columns: columns of the rule, and x, y, z, (N,) float32 each. Rows with a parent size of 0 are empty.
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
