"""A binary tree of splats: its shape, sizes that keep cuts proper, and its levels. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...splats.gaussians import Splats, splat_area
from ...splats.levels import Level
from .nodes import (
    ABOVE_ROOT,
    COLUMNS,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    hash_rows,
    min_parent_size,
    node_keys,
    round_up,
    streaming_order,
)

NODES, LEAVES = 1, 2
"""Level numbers: inner nodes, and leaves, which are the full scene."""


@dataclass(frozen=True)
class Tree:
    """A binary tree: nodes 0 to N - 1 are leaves; N - 1 inner nodes have two children each.

    Attributes:
        children: (N - 1, 2) int32, of the nodes N, N + 1, ...; the last of these is the root.
        trees: number T of separate trees; then there are N - T inner nodes, and roots at any place.
    """

    children: np.ndarray
    trees: int = 1

    @property
    def leaves(self) -> int:
        """N."""
        return len(self.children) + self.trees

    def __len__(self) -> int:
        return 2 * self.leaves - self.trees

    @cached_property
    def parents(self) -> np.ndarray:
        """Parent of each node, (2N - 1,) int32; -1 for roots."""
        parents = np.full(len(self), -1, np.int32)
        parents[self.children] = np.arange(self.leaves, len(self), dtype=np.int32)[:, None]
        return parents

    @cached_property
    def layers(self) -> list[np.ndarray]:
        """Inner nodes by depth, (M,) int32 each, the root first."""
        layers, layer = [], np.flatnonzero(self.parents < 0).astype(np.int32)
        while len(layer := layer[layer >= self.leaves]):
            layers.append(layer)
            layer = self.children[layer - self.leaves].reshape(-1)
        return layers

    @cached_property
    def leaves_below(self) -> np.ndarray:
        """Number of leaves below each node, (2N - 1,) int32; 1 for a leaf."""
        below = np.ones(len(self), np.int32)
        for layer in reversed(self.layers):
            below[layer] = below[self.children[layer - self.leaves]].sum(axis=1)
        return below

    def sizes(
        self,
        means: np.ndarray,
        log_scales: np.ndarray,
        leaf_sizes: np.ndarray | float = 0.0,
        adjust: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda sizes, means: sizes,
        errors: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return saturated sizes (2N - 1,) float32: 0 for leaves, others at least :func:`own_sizes` and
        ``min_parent_size``.

        Args:
            means, log_scales: (2N - 1, 3) float32 of all nodes; log-scales of leaves are ignored.
            leaf_sizes: (N,) float32, if leaves are roots of other trees.
            errors: (2N - 1,) float32, see :func:`own_sizes`.
            adjust: maps sizes (M,) and means (M, 3) of a layer to the sizes to use, none of them smaller.
        """
        sizes = np.zeros(len(self), np.float32)
        sizes[: self.leaves] = leaf_sizes
        for layer in reversed(self.layers):
            below = self.children[layer - self.leaves]
            offset = means[below].astype(np.float64) - means[layer, None].astype(np.float64)
            minimum = min_parent_size(sizes[below], np.sqrt(np.square(offset).sum(axis=2))).max(axis=1)
            own = own_sizes(log_scales[layer], None if errors is None else errors[layer])
            saturated = round_up(np.maximum(minimum, own))
            sizes[layer] = adjust(saturated, means[layer])
        return sizes

    def columns(self, means: np.ndarray, sizes: np.ndarray) -> dict[str, np.ndarray]:
        """Return the rule's columns of all nodes, (2N - 1,) float32 each."""
        parent_sizes = np.append(sizes, np.float32(ABOVE_ROOT))[self.parents]  # -1 is the last one
        parents = means[self.parents].T.astype(np.float32)  # arbitrary for the root
        return {NODE_SIZE: sizes, PARENT_SIZE: parent_sizes, **dict(zip(PARENT, parents, strict=True))}

    def levels(self, splats: Splats) -> list[Level]:
        """Return the levels of a bundle from all nodes (2N - 1): inner nodes, and leaves.

        Both are sorted coarse to fine, with neighbours in space close together (``nodes.streaming_order``).
        """
        errors = splats.extras.get(NODE_SIZE)
        sizes = UniqueSizes().sizes(self, splats.means, splats.log_scales, errors=errors)
        splats.extras |= self.columns(splats.means, sizes)
        levels = []
        for number, begin, end in ((NODES, self.leaves, len(self)), (LEAVES, 0, self.leaves)):
            columns = {name: splats.extras[name][begin:end] for name in COLUMNS}
            levels.append(Level(number, splats.select(streaming_order(columns) + begin)))
        return levels


class UniqueSizes:
    """Sizes of nodes such that no two nodes have the same size and position.

    If only a part of a tree is read, children identify their parent by its size and position
    (``nodes.ResidentTree``), but equal splats have equal parents. Keeps 8 bytes per node in memory.
    """

    def __init__(self) -> None:
        self._taken: list[np.ndarray] = []  # sorted, each less than half as long as the previous
        self._rng = np.random.default_rng(0)

    def sizes(
        self,
        tree: Tree,
        means: np.ndarray,
        log_scales: np.ndarray,
        leaf_sizes: np.ndarray | float = 0.0,
        errors: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the sizes of ``Tree.sizes``, increased by some ulps for nodes that are not unique."""
        sizes = tree.sizes(means, log_scales, leaf_sizes, errors=errors)
        inner = np.flatnonzero(sizes[tree.leaves :]) + tree.leaves
        keys = hash_rows(node_keys(sizes[inner], *means[inner].T))
        if self._is_free(keys).all():
            self._take(keys)
            return sizes
        return tree.sizes(means, log_scales, leaf_sizes, self._make_unique, errors)

    def _make_unique(self, sizes: np.ndarray, means: np.ndarray) -> np.ndarray:
        sizes = sizes.copy()
        pending = np.flatnonzero(sizes)
        limit = 1
        while len(pending):
            keys = hash_rows(node_keys(sizes[pending], *means[pending].T))
            free = self._is_free(keys)
            self._take(keys[free])
            pending = pending[~free]
            # random steps, because other duplicates have started from the same value
            steps = self._rng.integers(1, limit, len(pending), np.int32, endpoint=True)
            sizes.view(np.int32)[pending] += steps
            limit = min(2 * limit, 1 << 20)
        return sizes

    def _is_free(self, keys: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the keys that are neither taken nor repeated from an earlier row."""
        free = np.zeros(len(keys), bool)
        free[np.unique(keys, return_index=True)[1]] = True
        for keys_taken in self._taken:
            free &= keys_taken[np.searchsorted(keys_taken, keys).clip(max=len(keys_taken) - 1)] != keys
        return free

    def _take(self, keys: np.ndarray) -> None:
        while self._taken and len(self._taken[-1]) <= 2 * len(keys):
            keys = np.concatenate([self._taken.pop(), keys])
        if len(keys):
            self._taken.append(np.sort(keys))


def splat_size(log_scales: np.ndarray) -> np.ndarray:
    """Return sqrt(s1 s2 + s1 s3 + s2 s3), (N,) float64, of log-scales (N, 3) (A LoD of Gaussians, Eq. 6)."""
    return np.sqrt(splat_area(log_scales))


def own_sizes(log_scales: np.ndarray, errors: np.ndarray | None) -> np.ndarray:
    """Return the sizes (N,) of nodes before saturation.

    Args:
        log_scales: (N, 3).
        errors: (N,) square roots of the area of wrong pixels of each node, in scene units (not in the paper).
            Where an error is 0, and without errors, the size is :func:`splat_size`.
    """
    sizes = splat_size(log_scales)
    return sizes if errors is None else np.where(errors > 0, errors, sizes)


def leaf_only_columns(count: int) -> Mapping[str, np.ndarray]:
    """Return columns (N,) of leaves without inner nodes, which every camera sees."""
    zeros = np.zeros(count, np.float32)
    parent_sizes = np.full(count, ABOVE_ROOT, np.float32)
    return {NODE_SIZE: zeros, PARENT_SIZE: parent_sizes} | dict.fromkeys(PARENT, zeros)
