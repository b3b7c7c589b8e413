"""Density control on a tree (A LoD of Gaussians, Sec. 4.2 and A.6): leaves that grow, and dead ones.

A leaf that is to be densified becomes a node, with its values, over two new leaves. A dead leaf goes with its
parent, whose place its sibling takes, with all that is below it; the two are free to be somebody's children
elsewhere, so that a tree whose number of nodes is bounded follows where detail is needed.
"""

from __future__ import annotations

import numpy as np

from ...lod.tree import Tree


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
        old ones. Where a leaf was split three have it: the new node, whose values they are, and two children.
    """
    count, rows = tree.leaves, tree.children
    split = split & ~dead
    of_leaf = np.append(dead, np.zeros(len(rows), bool))  # of every node
    gone = of_leaf[rows]
    gone[gone.all(axis=1), 0] = False
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
