"""A binary tree of splats: its shape, the sizes that make cuts of it proper, and its levels. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...scenes.view_tables import VIEW_TABLES
from ...splats.gaussians import Splats
from ...splats.levels import MAX_LEVELS, Bundle, Level
from ..rules.bands import RULE as BANDS
from ..rules.cut import (
    ABOVE_ROOT,
    NODE_SIZE,
    PARENT,
    PARENT_SIZE,
    RULE,
    hash_rows,
    min_parent_size,
    node_keys,
    round_up,
)
from .paging import streaming_order

NODES, LEAVES = 1, 2
"""Numbers of the levels: the nodes above, and the leaves, which are the full scene."""
THINNING = 4
"""How many times fewer splats a complete level has than the next finer one: half the detail of a surface."""
MIN_SPLATS = 500
"""Levels of fewer splats are not worth a file."""


@dataclass(frozen=True)
class Tree:
    """Which node is above which: nodes 0 to N - 1 are leaves, N - 1 further ones stand above two each.

    Attributes:
        children: (N - 1, 2) int32, of the nodes N, N + 1, ...; the last of these is the root.
        trees: how many stand side by side, T; then there are N - T nodes above leaves, roots anywhere.
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
        """(2N - 1,) int32; -1 for roots."""
        parents = np.full(len(self), -1, np.int32)
        parents[self.children] = np.arange(self.leaves, len(self), dtype=np.int32)[:, None]
        return parents

    @cached_property
    def layers(self) -> list[np.ndarray]:
        """The nodes above leaves, (M,) int32 each, by their number of nodes above them: the root first."""
        layers, layer = [], np.flatnonzero(self.parents < 0).astype(np.int32)
        while len(layer := layer[layer >= self.leaves]):
            layers.append(layer)
            layer = self.children[layer - self.leaves].reshape(-1)
        return layers

    @cached_property
    def leaves_below(self) -> np.ndarray:
        """(2N - 1,) int32: how many leaves each node stands for; 1 for a leaf."""
        below = np.ones(len(self), np.int32)
        for layer in reversed(self.layers):
            below[layer] = below[self.children[layer - self.leaves]].sum(axis=1)
        return below

    def sizes(
        self,
        means: np.ndarray,
        log_scales: np.ndarray,
        of_leaves: np.ndarray | float = 0.0,
        larger: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda sizes, means: sizes,
    ) -> np.ndarray:
        """(2N - 1,) float32, saturated: of leaves 0, of others at least :func:`splat_size` and ``least_size``.

        Args:
            means, log_scales: (2N - 1, 3) float32 of all nodes; of leaves log-scales are not looked at.
            of_leaves: (N,) float32, where they are roots of other trees.
            larger: given such sizes (M,) and means (M, 3) says sizes that are to be instead, not smaller.
        """
        sizes = np.zeros(len(self), np.float32)
        sizes[: self.leaves] = of_leaves
        for layer in reversed(self.layers):
            below = self.children[layer - self.leaves]
            apart = means[below].astype(np.float64) - means[layer, None].astype(np.float64)
            least = min_parent_size(sizes[below], np.sqrt(np.square(apart).sum(axis=2))).max(axis=1)
            sizes[layer] = larger(round_up(np.maximum(least, splat_size(log_scales[layer]))), means[layer])
        return sizes

    def columns(self, means: np.ndarray, sizes: np.ndarray) -> dict[str, np.ndarray]:
        """The rule's columns of all nodes, (2N - 1,) float32 each."""
        above = np.append(sizes, np.float32(ABOVE_ROOT))[self.parents]  # -1 is the last one
        places = means[self.parents].T  # of the root anything
        named = zip(PARENT, places.astype(np.float32), strict=True)
        return {NODE_SIZE: sizes, PARENT_SIZE: above, **dict(named)}

    def levels(self, splats: Splats) -> list[Level]:
        """All nodes, (2N - 1), as a bundle has them: those above, and the leaves, both from coarse to fine in
        the order in which ranges are of one place (``paging.streaming_order``)."""
        sizes = UniqueSizes().sizes(self, splats.means, splats.log_scales)
        splats.extras |= self.columns(splats.means, sizes)
        levels = []
        for number, begin, end in ((NODES, self.leaves, len(self)), (LEAVES, 0, self.leaves)):
            columns = {name: splats.extras[name][begin:end] for name in RULE.columns}
            levels.append(Level(number, splats.select(streaming_order(columns) + begin)))
        return levels


class UniqueSizes:
    """Sizes of nodes, no two of which are the same at the same place.

    By size and place children know their parent where a part of a tree is read (``paging.ResidentTree``), and
    equal splats make equal nodes. In memory are 8 bytes of each node.
    """

    def __init__(self) -> None:
        self._taken: list[np.ndarray] = []  # sorted, each less than half as long as the one before
        self._rng = np.random.default_rng(0)

    def sizes(
        self, tree: Tree, means: np.ndarray, log_scales: np.ndarray, of_leaves: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Those of ``Tree.sizes``; larger in the last places where a node has them that was here before."""
        sizes = tree.sizes(means, log_scales, of_leaves)
        some = np.flatnonzero(sizes[tree.leaves :]) + tree.leaves
        keys = hash_rows(node_keys(sizes[some], *means[some].T))
        if self._free(keys).all():
            self._take(keys)
            return sizes
        return tree.sizes(means, log_scales, of_leaves, self._apart)

    def _apart(self, sizes: np.ndarray, means: np.ndarray) -> np.ndarray:
        sizes, waiting, most = sizes.copy(), np.flatnonzero(sizes), 1
        while len(waiting):
            keys = hash_rows(node_keys(sizes[waiting], *means[waiting].T))
            free = self._free(keys)
            self._take(keys[free])
            waiting = waiting[~free]
            # by chance: others that are alike have begun here, too
            further = self._rng.integers(1, most, len(waiting), np.int32, endpoint=True)
            sizes.view(np.int32)[waiting] += further
            most = min(2 * most, 1 << 20)
        return sizes

    def _free(self, keys: np.ndarray) -> np.ndarray:
        """(N,) bool, which nobody has yet, nor an earlier one of these."""
        free = np.zeros(len(keys), bool)
        free[np.unique(keys, return_index=True)[1]] = True
        for taken in self._taken:
            free &= taken[np.searchsorted(taken, keys).clip(max=len(taken) - 1)] != keys
        return free

    def _take(self, keys: np.ndarray) -> None:
        while self._taken and len(self._taken[-1]) <= 2 * len(keys):
            keys = np.concatenate([self._taken.pop(), keys])
        if len(keys):
            self._taken.append(np.sort(keys))


def splat_size(log_scales: np.ndarray) -> np.ndarray:
    """sqrt(s1 s2 + s1 s3 + s2 s3), (N,) float64, of log-scales (N, 3) (A LoD of Gaussians, Eq. 6)."""
    return np.sqrt(splat_area(log_scales))


def splat_area(log_scales: np.ndarray) -> np.ndarray:
    """s1 s2 + s1 s3 + s2 s3, (N,) float64: 1 / 2π of a Gaussian ellipsoid's mean shadow, times 3 if round."""
    a, b, c = np.exp(np.minimum(log_scales, 60).T.astype(np.float64))
    return a * b + a * c + b * c


def leaf_only_columns(count: int) -> Mapping[str, np.ndarray]:
    """Columns (N,) of leaves with nothing above them: every eye is shown all of them."""
    nothing = np.zeros(count, np.float32)
    above = np.full(count, ABOVE_ROOT, np.float32)
    return {NODE_SIZE: nothing, PARENT_SIZE: above} | dict.fromkeys(PARENT, nothing)


def complete_levels(bundle: Bundle) -> Bundle:
    """A tree as levels each of which is complete by itself, for whoever has no rule for trees.

    The finest has the leaves; each coarser one is a cut at one size, the least at which it has no more than
    1 / THINNING of the finer one's splats, down to FEWEST. The rule ``bands`` chooses them by distance: where
    the size of a cut covers no more pixels than a node of the tree may.
    """
    splats = Splats.concatenated([level.splats for level in bundle.levels])
    own, above = (splats.extras[name] for name in (NODE_SIZE, PARENT_SIZE))
    splats = replace(
        splats, extras={name: x for name, x in splats.extras.items() if name not in RULE.columns}
    )
    sizes = np.unique(own)
    counts = np.searchsorted(np.sort(own), sizes, "right") - np.searchsorted(np.sort(above), sizes, "right")
    cuts = [0.0]
    most = counts[0] // THINNING
    while most >= MIN_SPLATS and len(cuts) < MAX_LEVELS:
        place = int(np.argmax(counts <= most))  # counts fall
        cuts.append(float(sizes[place]))
        most = counts[place] // THINNING
    levels = [
        Level(number, splats.select((own <= size) & (above > size)), {"s_min": size})
        for number, size in enumerate(reversed(cuts), 1)
    ]
    tables = {name: table for name, table in bundle.tables.items() if name in VIEW_TABLES}
    controls = {"gamma": bundle.controls.get("pixels", RULE.controls[0].default), "first": 1}
    return replace(bundle, levels=levels, rule=BANDS.name, controls=controls, tables=tables)
