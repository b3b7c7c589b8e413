"""Leaves that grow and dead ones, against the same told node by node."""

import numpy as np
import pytest

from training.lod.tree import Tree
from training.methods.tree.density import edited


def random_tree(rng, leaves):
    """Pairs merged at random: deep and shallow ones."""
    free, children = list(range(leaves)), []
    while len(free) > 1:
        pair = [free.pop(rng.integers(len(free))) for _ in range(2)]
        free.append(leaves + len(children))
        children.append(pair)
    return Tree(np.array(children, np.int32).reshape(-1, 2))


def nested(tree, names):
    """A tree as (name, left, right) and (name,), from the root."""

    def at(node):
        if node < tree.leaves:
            return (names[node],)
        return (names[node], *(at(child) for child in tree.children[node - tree.leaves]))

    return at(len(tree) - 1)


def told(node, split, dead):
    """Sec. 4.2 and A.6, node by node; ``split`` and ``dead`` by names."""
    if len(node) == 1:
        return (node[0], node, node) if node[0] in split and node[0] not in dead else node
    name, left, right = node
    if len(right) == 1 and right[0] in dead:  # of two dead ones the right one
        return told(left, split, dead)
    if len(left) == 1 and left[0] in dead:
        return told(right, split, dead)
    return (name, told(left, split, dead), told(right, split, dead))


@pytest.mark.parametrize("seed", range(60))
def test_leaves_grow_and_dead_ones_go(seed):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, int(rng.integers(1, 60)))
    split, dead = (rng.random(tree.leaves) < rng.choice([0, 0.1, 0.5, 1]) for _ in range(2))
    new, source = edited(tree, split, dead)
    assert len(source) == len(new)
    expected = told(nested(tree, range(len(tree))), set(np.flatnonzero(split)), set(np.flatnonzero(dead)))
    assert nested(new, source.tolist()) == expected
    # numbers rise towards the root, and leaves stay in their order
    assert (new.children < np.arange(new.leaves, len(new))[:, None]).all()
    assert (np.diff(source[: new.leaves]) >= 0).all()


def test_edge_cases_of_the_appendix():
    #       6
    #    5     4     leaves 0 and 1 below 5, 2 and 3 below 4
    tree = Tree(np.array([[2, 3], [0, 1], [5, 4]], np.int32))

    def after(split=(), dead=()):
        flags = (np.isin(np.arange(4), each) for each in (split, dead))
        new, source = edited(tree, *flags)
        return nested(new, source.tolist())

    assert after(dead=[1]) == (6, (0,), (4, (2,), (3,)))
    assert after(dead=[0, 1]) == (6, (0,), (4, (2,), (3,)))  # the left one is dead still
    assert after(dead=[0, 1, 2, 3]) == (6, (0,), (2,))
    assert after(split=[1]) == (6, (5, (0,), (1, (1,), (1,))), (4, (2,), (3,)))
    assert after(split=[0], dead=[1]) == (6, (0, (0,), (0,)), (4, (2,), (3,)))
    deep = Tree(np.array([[0, 1], [3, 2]], np.int32))  # 2 is the sibling of the node over 0 and 1
    new, source = edited(deep, np.zeros(3, bool), np.array([False, False, True]))
    assert nested(new, source.tolist()) == (3, (0,), (1,))  # its whole subtree takes the root's place


def test_a_lone_leaf_stays():
    new, source = edited(Tree(np.zeros((0, 2), np.int32)), np.array([False]), np.array([True]))
    assert new.leaves == 1 and source.tolist() == [0]
    new, source = edited(Tree(np.zeros((0, 2), np.int32)), np.array([True]), np.array([False]))
    assert nested(new, source.tolist()) == (0, (0,), (0,))
