"""A LoD of Gaussians' rule (Windisch et al. 2026, Sec. 4.3): a cut through a tree of splats, node by node."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...splats.ply import Columns
from ..colors import LEVEL_COLORS
from ..rule import NO_COLUMNS, NO_TABLES, Control, Rule, Values, axis_distances, distances

NODE_SIZE, PARENT_SIZE = "node_size", "parent_size"
"""Columns of sizes, in scene units: a splat's own, 0 for leaves, and its parent's."""
PARENT = ("parent_x", "parent_y", "parent_z")
"""Columns of the parent's mean."""
ABOVE_ROOT = 3.0e38
"""The parent size of the root, which has none: larger than any distance, and finite, as files have it."""
MIN_DETAIL = 8.0
"""The least detail of an eye: sizes are made so that cuts are proper from there on."""
ROUNDING = 2.0**-20
"""Share by which a parent's size is larger still: 16 units in float32's last place, of which comparing a
distance with k size, for parent and child, can get 9 wrong."""
_BLOCK = 1 << 14
"""Splats that are looked at together, which stay in the processor's cache."""
OCTAVES = len(LEVEL_COLORS) - 1
"""Colours for sizes, each for twice the size of the next, over and over; the one after is the leaves'."""


def detail_of(focal_px: float, pixels: float) -> float:
    """k: the distance, over a node's size, from which on the node is fine enough for an eye."""
    return max(focal_px / pixels, MIN_DETAIL)


def is_fine_enough(axes: Sequence[np.ndarray], sizes: np.ndarray, eye: np.ndarray, k: float) -> np.ndarray:
    """(N,) bool, which nodes are fine enough: ‖c - μ‖ >= k size.

    The same bits wherever the same node is asked for, as itself or as a parent: all is float32, operation by
    operation.

    Args:
        axes: x, y and z of means, (N,) float32 each.
        sizes: (N,) float32.
        eye: (3,).
        k: see :func:`detail_of`.
    """
    with np.errstate(over="ignore"):
        return axis_distances(axes, eye) >= np.float32(k) * sizes


def min_parent_size(child_sizes: np.ndarray, away: np.ndarray) -> np.ndarray:
    """The least sizes (N,) float64 of parents that keep cuts proper, rounding in float32 included.

    size_child + away / K_LEAST: where a parent is fine enough, ‖c - μ_p‖ >= k size_p, its child is, because
    ‖c - μ_c‖ >= ‖c - μ_p‖ - away >= k size_p - away >= k size_child for every k >= K_LEAST.

    Args:
        child_sizes: (N,).
        away: (N,) distances of the children's means from their parents'.
    """
    return (child_sizes + np.asarray(away, np.float64) / MIN_DETAIL) * (1 + ROUNDING)


def round_up(values: np.ndarray) -> np.ndarray:
    """The next float32 (N,) that are not below float64 values."""
    rounded = values.astype(np.float32)
    return np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded)


def hash_rows(rows: np.ndarray) -> np.ndarray:
    """(N,) uint64 of rows (N, 4) float32: equal ones have equal numbers, and hardly any others."""
    words = np.ascontiguousarray(rows).view(np.uint32).astype(np.uint64)
    found = np.zeros(len(rows), np.uint64)
    for word in words.T:
        found = (found ^ word) * np.uint64(0x9E3779B97F4A7C15)
        found ^= found >> np.uint64(29)
    return found


class Cut(Rule):
    """1 where a node is fine enough and its parent is not, 0 elsewhere (Eq. 5).

    A node is fine enough where its size, sqrt(s1 s2 + s1 s3 + s2 s3) of its scales (Eq. 6), covers no more
    than ``pixels`` pixels. Two levels: the leaves, which are the full model and always fine enough, and the
    nodes above them.

    Sizes are saturated (:func:`min_parent_size`), which is not in the paper. So from every eye whose k is at least
    K_LEAST a node that is fine enough has no descendant that is not, and of every leaf and the nodes above it
    exactly one is drawn. The paper's M_d has the same triangle inequality with the root of an SPT, and its
    Eq. 5 is proper only as long as training leaves the heap condition whole.
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
            "A splat stands for all that is below it in the tree where it covers no more than so many "
            "pixels. Smaller is finer",
            soft=(0.5, 16.0), unit="PIXEL",
        ),
    )  # fmt: skip
    sweep = ("pixels", (0.5, 1.0, 2.0, 4.0, 8.0, 16.0))

    def weights(self, means, eye, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        k = detail_of(focal_px, values["pixels"])
        shown = np.zeros(len(means), np.float32)
        for begin in range(0, len(means), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            parents, sizes = [columns[name][block] for name in PARENT], columns[NODE_SIZE][block]
            chosen = ~is_fine_enough(parents, columns[PARENT_SIZE][block], eye, k)
            if sizes.any() and chosen.any():  # there are others than leaves, and some are not too fine
                chosen &= is_fine_enough([*means[block].T], sizes, eye, k)
            shown[block] = chosen
        return shown

    def distance_band(self, focal_px, facts, values, highest=NO_COLUMNS) -> tuple[float, float | np.ndarray]:
        """As far as parents are too coarse: a node is at most K_LEAST of its parent's sizes away from it."""
        if PARENT_SIZE not in highest:
            return 0.0, np.inf
        k = detail_of(focal_px, values["pixels"])
        return 0.0, (k + MIN_DETAIL) * (1 + 4 * ROUNDING) * highest[PARENT_SIZE].astype(np.float64)

    def reconcile(self, before: Columns, after: Columns) -> Columns:
        """Sizes with which cuts are proper still, and no two nodes are the same at the same place.

        They are what scaling makes of them, or larger in the last places.
        """
        inside = (before[PARENT_SIZE] > 0) & (before[PARENT_SIZE] < ABOVE_ROOT)
        above = hash_rows(node_keys(*(before[name] for name in (PARENT_SIZE, *PARENT)))[inside])
        keys, first, family = np.unique(above, return_index=True, return_inverse=True)
        own = hash_rows(node_keys(*(before[name] for name in (NODE_SIZE, *"xyz"))))
        heads = np.searchsorted(keys, own).clip(max=max(len(keys) - 1, 0))
        is_head = before[NODE_SIZE] > 0
        if len(keys):
            is_head &= keys[heads] == own
        sizes, places = after[NODE_SIZE].copy(), np.stack([after[axis][inside] for axis in PARENT], axis=1)
        means = np.stack([after[axis][inside] for axis in "xyz"], axis=1)
        away = np.sqrt(np.square(means.astype(np.float64) - places).sum(axis=1))
        of_keys, places = after[PARENT_SIZE][inside][first], places[first] + np.float32(0)
        while len(keys):
            sizes[is_head] = of_keys[heads[is_head]]
            least = np.zeros(len(keys))
            np.maximum.at(least, family, min_parent_size(sizes[inside], away))
            larger = np.maximum(of_keys, round_up(least))
            alike = np.ones(len(keys), bool)
            alike[np.unique(hash_rows(np.column_stack([larger, places])), return_index=True)[1]] = False
            larger[alike] = np.nextafter(larger[alike], np.float32(np.inf))
            if np.array_equal(larger, of_keys):
                break
            of_keys = larger
        parent_sizes = before[PARENT_SIZE].copy()
        parent_sizes[inside] = of_keys[family]
        return {NODE_SIZE: sizes, PARENT_SIZE: parent_sizes}

    def told_level(self, columns, facts) -> np.ndarray:
        """The number of a colour: the octave of a node's size, OCTAVES + 1 for leaves."""
        return _octave(columns[NODE_SIZE])

    def wanted_level(self, means, eye, focal_px, facts, values) -> np.ndarray:
        """The same of the largest size that is fine enough where splats are."""
        return _octave(distances(means, eye) / np.float32(detail_of(focal_px, values["pixels"])))

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "pixels")


def node_keys(sizes: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(N, 4) float32 by which children and parents know each other, of sizes and places (N,) float32."""
    return np.stack([sizes, x, y, z], axis=1) + np.float32(0)  # no zero below zero


def _octave(sizes: np.ndarray) -> np.ndarray:
    """(N,) float32, from 1 on: one more for half the size."""
    with np.errstate(divide="ignore", invalid="ignore"):
        octaves = -np.floor(np.log2(sizes)) % np.float32(OCTAVES)
    return np.where(sizes > 0, octaves, np.float32(OCTAVES)) + np.float32(1)


RULE = Cut()
