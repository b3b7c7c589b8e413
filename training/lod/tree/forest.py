"""A tree of splats in pieces that may together be larger than memory. numpy only."""

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
from .nodes import NODE_SIZE, PARENT, PARENT_SIZE, parent_index, streaming_order
from .shape import LEAVES, NODES, Tree, UniqueSizes

Piece = tuple[Splats, Tree]
"""Splats, and the tree whose nodes they are."""
_KEYS = (PARENT_SIZE, *PARENT)


class Forest(Protocol):
    """A tree of splats: subtrees, and an upper tree whose leaves are the subtrees' roots, in order.

    The column NODE_SIZE of the splats, if any, has the errors of ``shape.own_sizes``.
    """

    def __iter__(self) -> Iterator[Piece]:
        """Iterate over the subtrees, sorted by space: the 2N - 1 nodes and the tree of each.

        A subtree may be a single leaf.
        """
        ...

    @property
    def upper(self) -> Piece:
        """The G - 1 inner nodes above the roots of G subtrees, and a tree with these roots as leaves.

        It may be available only after iterating over all subtrees.
        """
        ...


@dataclass(frozen=True)
class MemoryForest:
    """A forest in memory, see :class:`Forest`."""

    subtrees: Sequence[Piece]
    upper: Piece

    def __iter__(self) -> Iterator[Piece]:
        return iter(self.subtrees)


def max_subtree_leaves(leaves: int) -> int:
    """Return the maximum leaves of a subtree of a tree of N leaves: half the square root of the node count.

    The upper tree and a subtree then have about the same size.
    """
    return max(math.isqrt(2 * leaves - 1) // 2, 1)


@dataclass(frozen=True)
class ForestShape:
    """Order of a forest's nodes: subtree after subtree, then the inner nodes of the upper tree.

    Attributes:
        counts: (G,) int64, leaves of each subtree.
        upper: upper tree, of G leaves.
    """

    counts: np.ndarray
    upper: Tree

    def __len__(self) -> int:
        return int(self.ends[-1]) + len(self.counts) - 1

    @cached_property
    def begins(self) -> np.ndarray:
        """First node of each subtree, (G,) int64."""
        return self.ends - (2 * self.counts - 1)

    @cached_property
    def ends(self) -> np.ndarray:
        """End of each subtree's nodes, (G,) int64; its last node is the root."""
        return np.cumsum(2 * self.counts - 1)

    @cached_property
    def list_begins(self) -> np.ndarray:
        """First inner node of each subtree, (G,) int64, counted over the inner nodes of all subtrees."""
        return self.list_ends - (self.counts - 1)

    @cached_property
    def list_ends(self) -> np.ndarray:
        """End of each subtree's inner nodes, (G,) int64."""
        return np.cumsum(self.counts - 1)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """First node and end of each subtree."""
        return list(zip(self.begins.tolist(), self.ends.tolist(), strict=True))


def forest_shape(tree: Tree, max_leaves: int) -> tuple[np.ndarray, ForestShape]:
    """Split a tree into the largest subtrees of at most ``max_leaves`` leaves, sorted by their first leaves.

    Returns:
        The nodes (2N - 1,) int32 of the tree in the order of the forest, and the forest's shape.
    """
    leaves, count = tree.leaves, len(tree)
    small = tree.leaves_below <= max_leaves
    parents = tree.parents
    roots = np.flatnonzero(small & ((parents < 0) | ~small[parents]))
    owner = np.full(count, len(roots), np.int32)  # subtree of each node; len(roots) for the upper tree
    owner[roots] = np.arange(len(roots))
    for layer in tree.layers:
        inside = layer[small[layer]]
        owner[tree.children[inside - leaves]] = owner[inside][:, None]
    _, first = np.unique(owner[:leaves], return_index=True)
    rank = np.empty(len(roots) + 1, np.int32)
    rank[np.append(np.argsort(first), len(roots))] = np.arange(len(roots) + 1)
    owner, roots = rank[owner], roots[np.argsort(first)]
    is_root = parents < 0
    is_root[roots] = True
    order = np.lexsort((is_root, np.arange(count) >= leaves, owner)).astype(np.int32)
    place = np.empty(count, np.int32)
    place[order[count - len(roots) + 1 :]] = len(roots) + np.arange(len(roots) - 1)
    place[roots] = np.arange(len(roots))
    upper = Tree(place[tree.children[order[count - len(roots) + 1 :] - leaves]])
    return order, ForestShape(tree.leaves_below[roots].astype(np.int64), upper)


def split_tree(splats: Splats, tree: Tree, max_leaves: int) -> MemoryForest:
    """Split a tree into the largest subtrees of at most ``max_leaves`` leaves, sorted by their first leaves.

    Args:
        splats: the 2N - 1 nodes.
    """
    order, shape = forest_shape(tree, max_leaves)
    splats, trees = splats.select(order), extract_subtrees(tree, order, shape)
    pieces = [splats.select(slice(*ends)) for ends in shape.ranges]
    upper = splats.select(slice(int(shape.ends[-1]), None)), shape.upper
    return MemoryForest(list(zip(pieces, trees, strict=True)), upper)


def extract_subtrees(tree: Tree, order: np.ndarray, shape: ForestShape) -> list[Tree]:
    """Return the subtrees of a tree, from the result of :func:`forest_shape`."""
    place = np.empty(len(tree), np.int32)
    place[order] = np.arange(len(tree), dtype=np.int32)
    trees = []
    for (begin, end), leaves in zip(shape.ranges, shape.counts.tolist(), strict=True):
        children = tree.children[order[begin + leaves : end] - tree.leaves]
        trees.append(Tree(place[children] - np.int32(begin)))
    return trees


def combine_trees(leaves: np.ndarray, children: np.ndarray) -> tuple[np.ndarray, Tree]:
    """Combine separate trees into one ``Tree`` of several.

    Args:
        leaves: (T,) of each tree.
        children: (., 2), of all inner nodes in order, as node numbers among all trees.

    Returns:
        The nodes (.,) int64 in the order of the combined tree, and that tree.
    """
    counts = 2 * leaves - 1
    begins = np.cumsum(counts) - counts
    is_leaf = np.arange(counts.sum()) - np.repeat(begins, counts) < np.repeat(leaves, counts)
    order = np.append(np.flatnonzero(is_leaf), np.flatnonzero(~is_leaf))
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return order, Tree(number[children], len(leaves))


def merge_forest(forest: Forest) -> Piece:
    """Return a forest as one tree in memory.

    Nodes are ordered: all leaves by subtree, then the subtrees' inner nodes, then those of the upper tree.
    """
    subtrees = list(forest)
    upper_splats, upper = forest.upper
    leaves = [splats.select(slice(0, tree.leaves)) for splats, tree in subtrees]
    inner = [splats.select(slice(tree.leaves, None)) for splats, tree in subtrees]
    return Splats.concatenated([*leaves, *inner, upper_splats]), merge_trees(
        [tree for _, tree in subtrees], upper
    )


def merge_trees(trees: Sequence[Tree], upper: Tree) -> Tree:
    """Return one tree of subtrees, whose roots are the leaves of an upper tree, in order."""
    counts = np.array([tree.leaves for tree in trees])
    first_leaf, first_inner = np.cumsum(counts) - counts, np.cumsum(counts - 1) - (counts - 1)
    leaves = int(counts.sum())
    children = []
    for tree, count, leaf, inner in zip(trees, counts, first_leaf, first_inner, strict=True):
        shift = np.where(tree.children < count, leaf, leaves + inner - count)
        children.append(tree.children + shift)
    roots = np.where(counts == 1, first_leaf, leaves + first_inner + counts - 2)
    shift = leaves + int((counts - 1).sum()) - len(trees)
    subtree_roots = np.append(roots, 0)[np.minimum(upper.children, len(trees))]
    children.append(np.where(upper.children < len(trees), subtree_roots, upper.children + shift))
    return Tree(np.concatenate(children).astype(np.int32).reshape(-1, 2))


def build_levels(forest: Forest, folder: Path) -> tuple[list[Level], Columns]:
    """Return the levels of a bundle, on disk, and its table of blocks.

    The result equals that of ``Tree.levels``, except that of equal nodes another one may be enlarged. Uses 20
    bytes of memory per node, and up to 45 for the nodes of one level.

    Args:
        folder: folder of unnamed scratch files, which exist as long as the levels.

    Raises:
        LodgsError: cannot write to the folder.
    """
    files = {number: _LevelFile(folder) for number in (NODES, LEAVES)}
    roots, locations, unique = [], [], UniqueSizes()
    for splats, tree in forest:
        errors = splats.extras.get(NODE_SIZE)
        sizes = unique.sizes(tree, splats.means, splats.log_scales, errors=errors)
        columns = tree.columns(splats.means, sizes)
        splats = replace(splats, extras=columns)
        roots.append(splats.select([-1]))  # a copy: a view would keep them all
        files[LEAVES].append(splats.select(slice(0, tree.leaves)))
        files[NODES].append(splats.select(slice(tree.leaves, None)))
        file = files[LEAVES if tree.leaves == 1 else NODES]
        locations.append((file, len(file.keys) - 1, len(file.splats) - 1))
    upper_splats, upper = forest.upper
    root_splats = Splats.concatenated(roots)
    means = np.concatenate([root_splats.means, upper_splats.means])
    log_scales = np.concatenate([root_splats.log_scales, upper_splats.log_scales])
    errors = upper_splats.extras.get(NODE_SIZE)
    if errors is not None:
        errors = np.append(np.zeros(len(roots), np.float32), errors)
    sizes = unique.sizes(upper, means, log_scales, root_splats.extras[NODE_SIZE], errors)
    columns = upper.columns(means, sizes)
    for i, (root, (file, part, row)) in enumerate(zip(roots, locations, strict=True)):  # add the parents
        root.extras = {name: column[i : i + 1] for name, column in columns.items()}
        file.splats.write(row, root)
        file.keys[part][-1] = _keys(root)
    upper_columns = {name: column[upper.leaves :] for name, column in columns.items()}
    files[NODES].append(replace(upper_splats, extras=upper_columns))
    levels, tables = zip(*(files.pop(number).finished(number) for number in (NODES, LEAVES)), strict=True)
    return list(levels), {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


class _LevelFile:
    """A level's splats in a scratch file, and their sort keys (N, 4) float32 in memory, in parts."""

    def __init__(self, folder: Path) -> None:
        self.splats, self.keys = ScratchFile(folder), []

    def append(self, splats: Splats) -> None:
        if len(splats):
            self.splats.append(splats)
            self.keys.append(_keys(splats))

    def finished(self, number: int) -> tuple[Level, Columns]:
        """Return the level, sorted, and its rows of the table of blocks."""
        keys, self.keys = np.concatenate(self.keys), []
        columns: Columns = dict(zip(_KEYS, keys.T, strict=True))
        order = streaming_order(columns).astype(np.int32)
        index = parent_index(number, {name: column[order] for name, column in columns.items()})
        return Level(number, NO_SPLATS, on_disk=_SortedRows(self.splats, order)), index.as_table()


@dataclass(frozen=True)
class _SortedRows:
    """Splats of a scratch file in another order, rows (N,)."""

    file: ScratchFile
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        return self.file.select(self.rows[index])


def _keys(splats: Splats) -> np.ndarray:
    return np.stack([splats.extras[name] for name in _KEYS], axis=1)
