"""A tree of splats in pieces, which together may be larger than memory. numpy only."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from ...splats.gaussians import Splats
from ...splats.levels import NO_SPLATS, Level
from ...splats.ply import Columns
from ...splats.scratch import ScratchFile
from ..rules.cut import NODE_SIZE, PARENT, PARENT_SIZE
from .paging import page_table, streaming_order
from .shape import LEAVES, NODES, Tree, UniqueSizes

Piece = tuple[Splats, Tree]
"""Splats, and the tree that they are the nodes of."""
_KEYS = (PARENT_SIZE, *PARENT)


class Forest(Protocol):
    """A tree of splats: subtrees, and the upper tree, whose leaves are the subtrees' roots in their order."""

    def __iter__(self) -> Iterator[Piece]:
        """The subtrees one after the other, as neighbours in space: the 2N - 1 nodes, and the tree, of each.

        A subtree of one leaf is a leaf that stands alone under the upper tree.
        """
        ...

    @property
    def upper(self) -> Piece:
        """The G - 1 nodes above G subtrees, without the roots of these, and the tree, which has these as its
        leaves. It may be known only when all subtrees have been asked for."""
        ...


@dataclass(frozen=True)
class MemoryForest:
    """A forest in memory; see :class:`Forest`."""

    subtrees: Sequence[Piece]
    upper: Piece

    def __iter__(self) -> Iterator[Piece]:
        return iter(self.subtrees)


def max_subtree_leaves(leaves: int) -> int:
    """Most leaves of a subtree of a tree of N leaves: half the square root of the number of nodes, so that
    the upper tree and a subtree have about as many."""
    return max(math.isqrt(2 * leaves - 1) // 2, 1)


@dataclass(frozen=True)
class ForestShape:
    """Where the pieces of a tree are among its nodes, subtree after subtree, those of the upper tree last.

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

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """The first node of each subtree, and one after its last."""
        return list(zip(self.begins.tolist(), self.ends.tolist(), strict=True))

    @property
    def in_upper(self) -> np.ndarray:
        """(2G - 1,) int64: the nodes of the upper tree, with its leaves, in its own numbering."""
        return np.append(self.ends - 1, np.arange(self.ends[-1], len(self)))


def forest_shape(tree: Tree, longest: int) -> tuple[np.ndarray, ForestShape]:
    """The largest subtrees of at most ``longest`` leaves, by their first leaves.

    Returns:
        Which nodes (2N - 1,) int32 of the tree are those of the forest, one after the other, and its shape.
    """
    leaves, count = tree.leaves, len(tree)
    within, parents = tree.leaves_below <= longest, tree.parents
    roots = np.flatnonzero(within & ((parents < 0) | ~within[parents]))
    owner = np.full(count, len(roots), np.int32)  # the number of a node's subtree; of those above, one more
    owner[roots] = np.arange(len(roots))
    for layer in tree.layers:
        inside = layer[within[layer]]
        owner[tree.children[inside - leaves]] = owner[inside][:, None]
    _, first = np.unique(owner[:leaves], return_index=True)
    rank = np.empty(len(roots) + 1, np.int32)
    rank[np.append(np.argsort(first), len(roots))] = np.arange(len(roots) + 1)
    owner, roots = rank[owner], roots[np.argsort(first)]
    last = parents < 0
    last[roots] = True
    order = np.lexsort((last, np.arange(count) >= leaves, owner)).astype(np.int32)
    place = np.empty(count, np.int32)
    place[order[count - len(roots) + 1 :]] = len(roots) + np.arange(len(roots) - 1)
    place[roots] = np.arange(len(roots))
    upper = Tree(place[tree.children[order[count - len(roots) + 1 :] - leaves]])
    return order, ForestShape(tree.leaves_below[roots].astype(np.int64), upper)


def split_tree(splats: Splats, tree: Tree, longest: int) -> MemoryForest:
    """A tree as a forest: the largest subtrees of at most ``longest`` leaves, by their first leaves.

    Args:
        splats: its 2N - 1 nodes.
    """
    order, shape = forest_shape(tree, longest)
    splats, trees = splats.select(order), extract_subtrees(tree, order, shape)
    pieces = [splats.select(slice(*ends)) for ends in shape.ranges]
    upper = splats.select(slice(int(shape.ends[-1]), None)), shape.upper
    return MemoryForest(list(zip(pieces, trees, strict=True)), upper)


def extract_subtrees(tree: Tree, order: np.ndarray, shape: ForestShape) -> list[Tree]:
    """The subtrees of a tree that :func:`forest_shape` has found."""
    place = np.empty(len(tree), np.int32)
    place[order] = np.arange(len(tree), dtype=np.int32)
    trees = []
    for (begin, end), own in zip(shape.ranges, shape.counts.tolist(), strict=True):
        trees.append(Tree(place[tree.children[order[begin + own : end] - tree.leaves]] - np.int32(begin)))
    return trees


def combine_trees(leaves: np.ndarray, children: np.ndarray) -> tuple[np.ndarray, Tree]:
    """Trees one after the other as one ``Tree`` of several.

    Args:
        leaves: (T,) of each tree.
        children: (., 2), of those above leaves in the order of their numbers, by number among all.

    Returns:
        Which of the nodes (.,) int64 each of that tree is, and the tree.
    """
    counts = 2 * leaves - 1
    begins = np.cumsum(counts) - counts
    is_leaf = np.arange(counts.sum()) - np.repeat(begins, counts) < np.repeat(leaves, counts)
    order = np.append(np.flatnonzero(is_leaf), np.flatnonzero(~is_leaf))
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return order, Tree(number[children], len(leaves))


def merge_forest(forest: Forest) -> Piece:
    """A forest as one tree in memory: all leaves in the order of subtrees, the nodes above them, the upper
    tree's."""
    subtrees = list(forest)
    above, upper = forest.upper
    leaves = [splats.select(slice(0, tree.leaves)) for splats, tree in subtrees]
    inner = [splats.select(slice(tree.leaves, None)) for splats, tree in subtrees]
    return Splats.concatenated([*leaves, *inner, above]), merge_trees([tree for _, tree in subtrees], upper)


def merge_trees(trees: Sequence[Tree], upper: Tree) -> Tree:
    """One tree of others: of the trees whose roots are the leaves of an upper one, in their order."""
    counts = np.array([tree.leaves for tree in trees])
    first_leaf, first_inner = np.cumsum(counts) - counts, np.cumsum(counts - 1) - (counts - 1)
    leaves = int(counts.sum())
    children = []
    for tree, own, leaf, inner in zip(trees, counts, first_leaf, first_inner, strict=True):
        shift = np.where(tree.children < own, leaf, leaves + inner - own)
        children.append(tree.children + shift)
    roots = np.where(counts == 1, first_leaf, leaves + first_inner + counts - 2)
    beyond = leaves + int((counts - 1).sum()) - len(trees)
    in_upper = upper.children
    known = np.append(roots, 0)[np.minimum(in_upper, len(trees))]
    children.append(np.where(in_upper < len(trees), known, in_upper + beyond))
    return Tree(np.concatenate(children).astype(np.int32).reshape(-1, 2))


def build_levels(forest: Forest, folder: Path) -> tuple[list[Level], Columns]:
    """The levels of a bundle, in the order of their rows, and its table of blocks; the splats stay in files.

    What they are is what ``Tree.levels`` makes of the same tree, but that of nodes alike another one may be
    the larger. In memory are 20 bytes of each node, and up to 45 of those of one level.

    Args:
        folder: where the files are, which have no names and go with the levels.

    Raises:
        LodgsError: the folder takes no files.
    """
    files = {number: _LevelFile(folder) for number in (NODES, LEAVES)}
    roots, places, apart = [], [], UniqueSizes()
    for splats, tree in forest:
        columns = tree.columns(splats.means, apart.sizes(tree, splats.means, splats.log_scales))
        splats = replace(splats, extras=columns)
        roots.append(splats.select([-1]))  # a copy: a view would keep them all
        files[LEAVES].append(splats.select(slice(0, tree.leaves)))
        files[NODES].append(splats.select(slice(tree.leaves, None)))
        file = files[LEAVES if tree.leaves == 1 else NODES]
        places.append((file, len(file.keys) - 1, len(file.splats) - 1))
    above, upper = forest.upper
    ends = Splats.concatenated(roots)
    means, log_scales = np.concatenate([ends.means, above.means]), [ends.log_scales, above.log_scales]
    sizes = apart.sizes(upper, means, np.concatenate(log_scales), ends.extras[NODE_SIZE])
    columns = upper.columns(means, sizes)
    for i, (root, (file, part, row)) in enumerate(zip(roots, places, strict=True)):  # parents are known now
        root.extras = {name: column[i : i + 1] for name, column in columns.items()}
        file.splats.write(row, root)
        file.keys[part][-1] = _keys(root)
    above = replace(above, extras={name: column[upper.leaves :] for name, column in columns.items()})
    files[NODES].append(above)
    levels, tables = zip(*(files.pop(number).finished(number) for number in (NODES, LEAVES)), strict=True)
    return list(levels), {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


class _LevelFile:
    """A level's splats in a file, and in memory by what they are put in order, (N, 4) float32 in parts."""

    def __init__(self, folder: Path) -> None:
        self.splats, self.keys = ScratchFile(folder), []

    def append(self, splats: Splats) -> None:
        if len(splats):
            self.splats.append(splats)
            self.keys.append(_keys(splats))

    def finished(self, number: int) -> tuple[Level, Columns]:
        """The level, and what the table of blocks says of it."""
        keys, self.keys = np.concatenate(self.keys), []
        columns: Columns = dict(zip(_KEYS, keys.T, strict=True))
        order = streaming_order(columns).astype(np.int32)
        table = page_table({number: {name: column[order] for name, column in columns.items()}})
        return Level(number, NO_SPLATS, on_disk=_Ordered(self.splats, order)), table


@dataclass(frozen=True)
class _Ordered:
    """The splats of a file at rows (N,)."""

    file: ScratchFile
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, some: slice | np.ndarray, /) -> Splats:
        return self.file.select(self.rows[some])


def _keys(splats: Splats) -> np.ndarray:
    return np.stack([splats.extras[name] for name in _KEYS], axis=1)
