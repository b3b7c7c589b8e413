"""Density control on a tree (A LoD of Gaussians, Sec. 4.2 and A.6): leaves that grow, and dead ones.

A leaf that is to be densified becomes a node, with its values, over two new leaves. A dead leaf goes with its
parent, whose place its sibling takes, with all that is below it; the two are free to be somebody's children
elsewhere, so that a tree whose number of leaves is bounded follows where detail is needed.
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
from .store import RecordPiece, Store

GROWN = 2
"""A subtree of more than so many times the leaves that one should have is divided."""


def edited(tree: Tree, split: np.ndarray, dead: np.ndarray) -> tuple[Tree, np.ndarray]:
    """A tree without its dead leaves, in which others have become nodes over two leaves.

    Of two dead siblings the right one goes; the left one is dead still, and goes the next time (A.6). A tree
    always keeps one leaf. Dead leaves are not split. As in ``build``'s trees every node must have a higher
    number than those below it, and has one then.

    Args:
        tree: of N leaves.
        split, dead: (N,) bool of leaves.

    Returns:
        The tree of M leaves, in the order of those that they come from, and (2M - 1,) int64 of its nodes the
        old ones. Where a leaf was split three have it: the new node, whose values they are, and two children,
        one after the other.
    """
    count, rows = tree.leaves, tree.children
    split = split & ~dead
    gone = _losses(tree, dead)
    # the node that stands where each one stood: itself, or, of one that lost a child, what is in the other's
    stands = np.arange(len(tree))
    loses = gone.any(axis=1)
    stands[count:][loses] = np.where(gone[loses, 0], rows[loses, 1], rows[loses, 0])
    while not np.array_equal(further := stands[stands], stands):
        stands = further
    dies = np.zeros(len(tree), bool)
    dies[rows[gone]] = True
    # new numbers: leaves, in place of one that is split its two children; it itself and the other nodes
    many = np.where(dies[:count], 0, 1 + split)
    firsts = np.cumsum(many) - many
    splits, kept = np.flatnonzero(split), np.flatnonzero(~loses)
    leaves = int(many.sum())
    place = np.concatenate([firsts, np.zeros(len(rows), np.int64)])
    place[splits] = leaves + np.arange(len(splits))
    place[count + kept] = leaves + len(splits) + np.arange(len(kept))
    children = np.concatenate([firsts[splits, None] + np.arange(2), place[stands[rows[kept]]]])
    source = np.concatenate([np.repeat(np.arange(count), many), splits, count + kept])
    return Tree(children.astype(np.int32)), source


def _losses(tree: Tree, dead: np.ndarray) -> np.ndarray:
    """(N - 1, 2) bool: which child goes of each node above leaves; at most one."""
    gone = np.append(dead, np.zeros(len(tree.children), bool))[tree.children]
    gone[gone.all(axis=1), 0] = False
    return gone


class Growing:
    """The records of a store after density control, made while its pieces are asked for, which is once.

    Leaves are split along their longest axis (``optimize.density_control``). In 3DGS-MCMC, which the paper
    follows, both children are copies that only noise separates. All scores are reset.

    Args:
        store: stays as it is, with nothing of it in memory.
        threshold: leaves of a higher score (of its records) are split, the highest first.
        min_opacity: leaves of a lower one are dead,
        unseen_since: and those that no step from this one on has had in its image, counted from 1.
        now: how many steps have been made.
        most: leaves that the tree may have.
        region: leaves outside of it are not split; None: all may be.

    Attributes:
        removed, added: leaves.
    """

    def __init__(
        self,
        store: Store,
        *,
        threshold: float,
        min_opacity: float,
        unseen_since: int,
        now: int,
        most: int,
        region: Crop | None = None,
    ) -> None:
        self._store, self._now = store, now
        self._longest = max_subtree_leaves(int(store.shape.counts.sum()))
        self._least_logit = float(logit(min_opacity))
        self._unseen_since = unseen_since
        self._upper: RecordPiece | None = None
        store.rest()
        scores, wanted, count, self.removed = [], [], 0, 0
        for records, tree in store.records():
            dead = self._dead(records[: tree.leaves])
            leaves = store.layout.split(records[: tree.leaves])
            score = leaves["score"].numpy()
            grows = (score > threshold) & ~dead
            if region is not None:
                grows &= region.contains(leaves["means"].numpy())
            chosen = np.flatnonzero(grows)
            scores.append(score[chosen])
            wanted.append(count + chosen)
            count += tree.leaves
            self.removed += int(_losses(tree, dead).sum())
        score, found = np.concatenate(scores), np.concatenate(wanted)
        room = max(most - (count - self.removed), 0)
        self._split = np.sort(found[np.argsort(-score, kind="stable")[:room]])
        self.added = len(self._split)

    def __iter__(self) -> Iterator[RecordPiece]:
        """The new subtrees, as ``Store.fill_records`` takes them."""
        count, uppers, above = 0, [], []
        for records, tree in self._store.records():
            begin, end = np.searchsorted(self._split, (count, count + tree.leaves))
            split = np.zeros(tree.leaves, bool)
            split[self._split[begin:end] - count] = True
            count += tree.leaves
            tree, source = edited(tree, split, self._dead(records[: tree.leaves]))
            born = np.flatnonzero(split[source[: tree.leaves]])
            records = self._with_children(records[torch.from_numpy(source)], born)
            grown = tree.leaves > GROWN * self._longest
            order, shape = forest_shape(tree, self._longest if grown else tree.leaves)
            records = records[torch.from_numpy(order).long()]
            for (first, last), part in zip(shape.ranges, extract_subtrees(tree, order, shape), strict=True):
                yield records[first:last], part
            uppers.append(shape.upper)
            above.append(records[shape.ends[-1] :].clone())  # the subtree's need not stay for it
        records, upper = self._store.upper_records()
        self._upper = torch.cat([*above, records]), merge_trees(uppers, upper)

    @property
    def upper(self) -> RecordPiece:
        """The upper tree, as soon as all subtrees have been asked for."""
        assert self._upper is not None, "the subtrees come first"
        return self._upper

    def _dead(self, leaves: torch.Tensor) -> np.ndarray:
        values = self._store.layout.split(leaves)
        return (
            (values["opacity_logits"] < self._least_logit) | (values["seen"] < self._unseen_since)
        ).numpy()

    def _with_children(self, records: torch.Tensor, born: np.ndarray) -> torch.Tensor:
        """Records of which some rows (2P,), pairs of copies of P leaves, become their children."""
        self._store.layout.split(records)["score"].zero_()
        if len(born):
            rows = torch.from_numpy(np.concatenate([born[0::2], born[1::2]]))
            values = {name: part.clone() for name, part in self._store.layout.split(records[rows]).items()}
            scales = values["log_scales"][: len(rows) // 2].exp()
            values, scales = split_longest_axis(values, scales)
            values["log_scales"] = scales.log()
            for name in ("first", "second", "steps"):
                values[name].zero_()
            values["seen"].fill_(self._now)
            records[rows] = self._store.layout.join(values)
        return records
