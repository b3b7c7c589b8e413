"""A LoD of Gaussians' rule (Windisch et al. 2026, Sec. 4.3): a cut through a tree of splats, node by node."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...splats.ply import Columns
from ..colors import LEVEL_COLORS
from ..rule import NO_COLUMNS, NO_TABLES, Control, Rule, Values, axis_distances, distances

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
_BLOCK = 1 << 14
"""Splats per batch, so that a batch fits into the processor's cache."""
OCTAVES = len(LEVEL_COLORS) - 1
"""Number of colours for node sizes, one per factor of 2, repeating; leaves have a colour of their own."""


def detail_of(focal_px: float, pixels: float) -> float:
    """Return the detail k of a camera: a node is fine enough from the distance k size on."""
    return max(focal_px / pixels, MIN_DETAIL)


def is_fine_enough(
    axes: Sequence[np.ndarray], sizes: np.ndarray, position: np.ndarray, k: float
) -> np.ndarray:
    """Return (N,) bool: nodes that are fine enough, ‖c - μ‖ >= k size.

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
    complete = False
    columns = (NODE_SIZE, PARENT_SIZE, *PARENT)
    lengths = (NODE_SIZE, PARENT_SIZE)
    places = (PARENT,)
    linked_columns = True
    controls = (
        Control(
            "pixels", 1.0, 0.1, 100.0, "Granularity",
            "Replace a branch of the tree by its root if that covers at most this many pixels. Smaller is "
            "finer",
            soft=(0.5, 16.0), unit="PIXEL",
        ),
    )  # fmt: skip
    sweep = ("pixels", (0.5, 1.0, 2.0, 4.0, 8.0, 16.0))

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        k = detail_of(focal_px, values["pixels"])
        weights = np.zeros(len(means), np.float32)
        for begin in range(0, len(means), _BLOCK):
            block = slice(begin, begin + _BLOCK)
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

    def reconcile(self, original: Columns, transformed: Columns) -> Columns:
        """Return sizes that keep cuts proper, and keep nodes at the same position distinguishable.

        Sizes are the scaled ones, or a few ulps larger.
        """
        inside = (original[PARENT_SIZE] > 0) & (original[PARENT_SIZE] < ABOVE_ROOT)
        # nodes know their parent by size and position: one key per parent, shared by its children
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
        return {NODE_SIZE: sizes, PARENT_SIZE: parent_sizes}

    def splat_level(self, columns, facts) -> np.ndarray:
        """Return a colour number: the octave of a node's size, OCTAVES + 1 for leaves."""
        return _octave(columns[NODE_SIZE])

    def target_level(self, means, position, focal_px, facts, values) -> np.ndarray:
        """Return the colour number of the largest size that is fine enough at each splat."""
        return _octave(distances(means, position) / np.float32(detail_of(focal_px, values["pixels"])))

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "pixels")


def node_keys(sizes: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return keys (N, 4) float32 that identify nodes, from sizes and positions (N,) float32."""
    return np.stack([sizes, x, y, z], axis=1) + np.float32(0)  # turns -0 into 0


def _octave(sizes: np.ndarray) -> np.ndarray:
    """Return (N,) float32 from 1 on, one higher for half the size."""
    with np.errstate(divide="ignore", invalid="ignore"):
        octaves = -np.floor(np.log2(sizes)) % np.float32(OCTAVES)
    return np.where(sizes > 0, octaves, np.float32(OCTAVES)) + np.float32(1)


RULE = Cut()
