"""Density control of a tree (A LoD of Gaussians, Sec. 4.2 and A.6): split leaves and remove dead ones.

A split leaf becomes an inner node with the same values over two new leaves. A dead leaf is removed with its
parent, and its sibling subtree takes the parent's place. The freed nodes allow splits elsewhere, so that a
tree with a limited number of leaves follows the detail of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.special import logit

from ...lod.crop import Crop
from ...lod.tree.forest import extract_subtrees, forest_shape, max_subtree_leaves, merge_trees
from ...lod.tree.shape import Tree
from ...optimize.density_control import split_longest_axis
from .store import NodeStore, RecordPiece

MAX_GROWTH = 2
"""A subtree is divided if it exceeds its target number of leaves by this factor."""


def edit_tree(tree: Tree, split: np.ndarray, dead: np.ndarray) -> tuple[Tree, np.ndarray]:
    """Remove dead leaves from a tree and split others.

    Of two dead siblings only the right one is removed; the left one remains dead until the next call (A.6).
    The tree keeps at least one leaf. Dead leaves are not split. Inner nodes have higher numbers than the
    nodes below them, before and after, as in the trees of ``build``.

    Args:
        tree: tree of N leaves.
        split, dead: (N,) bool, for the leaves.

    Returns:
        The tree of M leaves in their original order, and the source node of each new node, (2M - 1,) int64.
            Three new nodes have a split leaf as source: the inner node with its values, and its two
            children, which are consecutive.
    """
    count, rows = tree.leaves, tree.children
    split = split & ~dead
    lost = _lost_children(tree, dead)
    # the node in each one's place: itself, or, if it lost a child, the replacement of its other child
    place = np.arange(len(tree))
    loses_child = lost.any(axis=1)
    place[count:][loses_child] = np.where(lost[loses_child, 0], rows[loses_child, 1], rows[loses_child, 0])
    while not np.array_equal(next_place := place[place], place):
        place = next_place
    removed = np.zeros(len(tree), bool)
    removed[rows[lost]] = True
    # new numbers: leaves (two for a split one), then split leaves and the other inner nodes
    counts = np.where(removed[:count], 0, 1 + split)
    firsts = np.cumsum(counts) - counts
    splits, remaining = np.flatnonzero(split), np.flatnonzero(~loses_child)
    leaves = int(counts.sum())
    new_number = np.concatenate([firsts, np.zeros(len(rows), np.int64)])
    new_number[splits] = leaves + np.arange(len(splits))
    new_number[count + remaining] = leaves + len(splits) + np.arange(len(remaining))
    children = np.concatenate([firsts[splits, None] + np.arange(2), new_number[place[rows[remaining]]]])
    source = np.concatenate([np.repeat(np.arange(count), counts), splits, count + remaining])
    return Tree(children.astype(np.int32)), source


def _lost_children(tree: Tree, dead: np.ndarray) -> np.ndarray:
    """Return which child each inner node loses, (N - 1, 2) bool; at most one each."""
    lost = np.append(dead, np.zeros(len(tree.children), bool))[tree.children]
    lost[lost.all(axis=1), 0] = False
    return lost


class TreeDensityControl:
    """Records of a store after density control, computed during iteration over its pieces.

    It can be iterated once. Leaves are split along their longest axis (``optimize.density_control``); in
    3DGS-MCMC, which the paper follows, both children are copies that only noise separates. All scores are
    reset.

    Args:
        store: input, unchanged; its cache must be empty.
        threshold: minimum score of a leaf to split; the highest scores are split first.
        min_opacity: minimum opacity of a leaf; leaves below it are dead.
        unseen_since: leaves that were in no image since this step, counted from 1, are dead.
        step: number of completed steps.
        max_leaves: maximum number of leaves of the tree.
        region: only leaves inside it are split; None for all.

    Attributes:
        removed, added: numbers of leaves.
    """

    def __init__(
        self,
        store: NodeStore,
        *,
        threshold: float,
        min_opacity: float,
        unseen_since: int,
        step: int,
        max_leaves: int,
        region: Crop | None = None,
    ) -> None:
        self._store, self._step = store, step
        self._subtree_leaves = max_subtree_leaves(int(store.shape.counts.sum()))
        self._least_logit = float(logit(min_opacity))
        self._unseen_since = unseen_since
        self._upper: RecordPiece | None = None
        store.release_cache()
        scores, candidates, count, self.removed = [], [], 0, 0
        for records, tree in store.records():
            dead = self._find_dead(records[: tree.leaves])
            leaves = store.layout.split(records[: tree.leaves])
            score = leaves["score"].numpy()
            split = (score > threshold) & ~dead
            if region is not None:
                split &= region.contains(leaves["means"].numpy())
            rows = np.flatnonzero(split)
            scores.append(score[rows])
            candidates.append(count + rows)
            count += tree.leaves
            self.removed += int(_lost_children(tree, dead).sum())
        max_splits = max(max_leaves - (count - self.removed), 0)
        order = np.argsort(-np.concatenate(scores), kind="stable")
        self._split = np.sort(np.concatenate(candidates)[order[:max_splits]])
        self.added = len(self._split)

    def __iter__(self) -> Iterator[RecordPiece]:
        """Yield the new subtrees for ``NodeStore.fill_records``."""
        count, uppers, upper_records = 0, [], []
        for records, tree in self._store.records():
            begin, end = np.searchsorted(self._split, (count, count + tree.leaves))
            split = np.zeros(tree.leaves, bool)
            split[self._split[begin:end] - count] = True
            count += tree.leaves
            tree, source = edit_tree(tree, split, self._find_dead(records[: tree.leaves]))
            children_rows = np.flatnonzero(split[source[: tree.leaves]])
            records = self._create_children(records[torch.from_numpy(source)], children_rows)
            too_large = tree.leaves > MAX_GROWTH * self._subtree_leaves
            order, shape = forest_shape(tree, self._subtree_leaves if too_large else tree.leaves)
            records = records[torch.from_numpy(order).long()]
            for (first, last), part in zip(shape.ranges, extract_subtrees(tree, order, shape), strict=True):
                yield records[first:last], part
            uppers.append(shape.upper)
            upper_records.append(
                records[shape.ends[-1] :].clone()
            )  # a copy, so that the subtree's records can be freed
        records, upper = self._store.upper_records()
        self._upper = torch.cat([*upper_records, records]), merge_trees(uppers, upper)

    @property
    def upper(self) -> RecordPiece:
        """The upper tree, available after iteration."""
        assert self._upper is not None, "iterate over the subtrees first"
        return self._upper

    def _find_dead(self, leaves: torch.Tensor) -> np.ndarray:
        values = self._store.layout.split(leaves)
        return (
            (values["opacity_logits"] < self._least_logit) | (values["seen"] < self._unseen_since)
        ).numpy()

    def _create_children(self, records: torch.Tensor, children_rows: np.ndarray) -> torch.Tensor:
        """Turn rows (2P,), P pairs of copied leaves, into the children of these leaves."""
        self._store.layout.split(records)["score"].zero_()
        if len(children_rows):
            rows = torch.from_numpy(np.concatenate([children_rows[0::2], children_rows[1::2]]))
            values = {name: part.clone() for name, part in self._store.layout.split(records[rows]).items()}
            scales = values["log_scales"][: len(rows) // 2].exp()
            values, scales = split_longest_axis(values, scales)
            values["log_scales"] = scales.log()
            for name in ("first", "second", "steps"):
                values[name].zero_()
            values["seen"].fill_(self._step)
            records[rows] = self._store.layout.join(values)
        return records
