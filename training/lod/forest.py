"""A tree in pieces: subtrees, handled a few at a time, and an upper tree whose leaves are their roots.

numpy only. The nodes of a forest are numbered subtree after subtree, each as its own ``Tree`` numbers them
(leaves first, root last), and those of the upper tree come after all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..splats.gaussians import Splats
from .tree import Tree

Piece = tuple[Splats, Tree]
"""A subtree's 2n - 1 nodes, and which is above which; or the G - 1 upper ones, and the tree over G roots."""


@dataclass(frozen=True)
class Forest:
    """Where the pieces of a tree are among its nodes in a forest's order.

    Attributes:
        counts: (G,) int64, leaves of each subtree.
        upper: of G leaves.
    """

    counts: np.ndarray
    upper: Tree

    def __len__(self) -> int:
        return int(self.ends[-1]) + len(self.counts) - 1

    @cached_property
    def begins(self) -> np.ndarray:
        """(G,) int64, the first node of each subtree."""
        return self.ends - (2 * self.counts - 1)

    @cached_property
    def ends(self) -> np.ndarray:
        """(G,) int64, one after the last node of each subtree, which is its root."""
        return np.cumsum(2 * self.counts - 1)

    @cached_property
    def list_begins(self) -> np.ndarray:
        """(G,) int64, the first of the nodes above leaves of each subtree, counted through all subtrees."""
        return self.list_ends - (self.counts - 1)

    @cached_property
    def list_ends(self) -> np.ndarray:
        """(G,) int64, one after the last of them."""
        return np.cumsum(self.counts - 1)

    @cached_property
    def walked(self) -> np.ndarray:
        """(2G - 1,) int64: the nodes of the upper tree, its leaves too, in its own numbering."""
        return np.append(self.ends - 1, np.arange(self.ends[-1], len(self)))


def longest_of(nodes: int) -> int:
    """Most leaves of a subtree: half the square root of the number of nodes, so that the upper tree and a
    subtree are about as large."""
    return max(math.isqrt(nodes) // 2, 1)


def split(tree: Tree, longest: int = 0) -> tuple[np.ndarray, Forest]:
    """Takes a tree apart.

    Args:
        longest: most leaves of a subtree; 0: :func:`longest_of`.

    Returns:
        Which node (2N - 1,) int32 of the tree each of the forest is, and where its pieces are; subtrees in
        the order of their first leaves.
    """
    leaves, count = tree.leaves, len(tree)
    below, first = np.ones(count, np.int32), np.arange(count, dtype=np.int32)
    for layer in reversed(tree.layers):
        one, other = tree.children[layer - leaves].T
        below[layer] = below[one] + below[other]
        first[layer] = np.minimum(first[one], first[other])
    within = below <= (longest or longest_of(count))
    roots = np.flatnonzero(within & ((tree.parents < 0) | ~within[tree.parents])).astype(np.int32)
    roots = roots[np.argsort(first[roots])]
    owner = np.full(count, len(roots), np.int32)
    owner[roots] = np.arange(len(roots), dtype=np.int32)
    for layer in tree.layers:
        inside = layer[within[layer]]
        owner[tree.children[inside - leaves]] = owner[inside][:, None]
    last = np.zeros(count, bool)
    last[roots] = True
    order = np.lexsort((np.arange(count), last, owner)).astype(np.int32)
    place = np.full(count, -1, np.int32)
    place[roots] = np.arange(len(roots), dtype=np.int32)
    upper = np.flatnonzero(~within)
    place[upper] = len(roots) + np.arange(len(upper), dtype=np.int32)
    return order, Forest(below[roots].astype(np.int64), Tree(place[tree.children[upper - leaves]]))


def pieces(splats: Splats, tree: Tree, longest: int = 0) -> tuple[Iterator[Piece], Piece]:
    """A tree's subtrees, one after the other, and its upper tree; as :func:`split`."""
    order, forest = split(tree, longest)
    place = np.empty(len(tree), np.int32)
    place[order] = np.arange(len(tree), dtype=np.int32)

    def subtrees() -> Iterator[Piece]:
        for begin, end in zip(forest.begins.tolist(), forest.ends.tolist(), strict=True):
            nodes = order[begin:end]
            above = nodes[nodes >= tree.leaves]
            yield splats.select(nodes), Tree(place[tree.children[above - tree.leaves]] - np.int32(begin))

    return subtrees(), (splats.select(order[forest.ends[-1] :]), forest.upper)


def side_by_side(trees: Sequence[Tree]) -> tuple[np.ndarray, Tree]:
    """Several trees as one: which node of them, one tree after the other, each is, (.,); and that tree."""
    ends = np.cumsum([len(tree) for tree in trees])
    begins = ends - [len(tree) for tree in trees]
    leaves = np.array([tree.leaves for tree in trees])
    children = [tree.children + np.int32(begin) for tree, begin in zip(trees, begins, strict=True)]
    return leaves_first(leaves, ends, np.concatenate(children))


def leaves_first(leaves: np.ndarray, ends: np.ndarray, children: np.ndarray) -> tuple[np.ndarray, Tree]:
    """Trees one after the other as one.

    Args:
        leaves: (T,) of each tree.
        ends: (T,), one after each one's last node.
        children: (., 2), of those above leaves in the order of their numbers, by number among all.

    Returns:
        Which node (.,) each of the one tree is, and that tree.
    """
    begins = np.append(0, ends[:-1])
    is_leaf = np.arange(ends[-1]) - np.repeat(begins, ends - begins) < np.repeat(leaves, ends - begins)
    order = np.concatenate([np.flatnonzero(is_leaf), np.flatnonzero(~is_leaf)])
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return order, Tree(number[children], len(leaves))


def whole(subtrees: Iterable[Piece], upper: Piece) -> Piece:
    """The nodes and the tree of all pieces, leaves first."""
    splats, trees = zip(*subtrees, strict=True)
    order, tree = side_by_side(trees)
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    roots = number[np.cumsum([len(each) for each in trees]) - 1]
    place = np.append(roots, len(order) + np.arange(len(upper[0]), dtype=np.int32))
    children = np.concatenate([tree.children, place[upper[1].children]])
    return Splats.concatenated([Splats.concatenated(list(splats)).select(order), upper[0]]), Tree(children)
