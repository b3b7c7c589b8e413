"""Leaves that grow and dead ones, against the same told node by node."""

import numpy as np
import pytest
import torch

from tests.training.lod.tree.trees import random_tree
from training.lod.tree.forest import max_subtree_leaves, merge_forest
from training.lod.tree.shape import Tree
from training.methods.tree.build import GrowingForest
from training.methods.tree.density import GROWN, Growing, edited
from training.methods.tree.store import Store

from .test_build import below, scene


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


# -- of a store ----------------------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path, 1, 1 << 24)
    store.fill(GrowingForest(scene(400), longest=16))
    return store


def with_stats(store, **values):
    """Sets columns of all records."""
    store.cache.evict_all()
    records = store.rows.read(np.arange(len(store)))
    for name, column in values.items():
        store.layout.split(records)[name][:] = torch.as_tensor(column, dtype=torch.float32)
    store.rows.write(np.arange(len(store)), records)


def is_leaf(store):
    counts = store.shape.counts
    inside = np.concatenate([np.arange(2 * count - 1) < count for count in counts.tolist()])
    return np.append(inside, np.zeros(len(counts) - 1, bool))


def grown(store, **values):
    wanted = {"threshold": np.inf, "min_opacity": 0.005, "unseen_since": 0, "now": 9, "most": 10**6}
    growing = Growing(store, **(wanted | values))
    other = Store(store.rows._folder, 1, store.budget)
    other.fill_records(growing, lambda: growing.upper)
    return growing, other


def test_without_cause_nothing_changes(store):
    before = merge_forest(store)
    growing, after = grown(store)
    assert growing.added == growing.removed == 0
    splats, tree = merge_forest(after)
    assert np.array_equal(tree.children, before[1].children) and np.array_equal(splats.means, before[0].means)


def test_the_highest_scores_are_split_as_far_as_there_is_room(store):
    rng = np.random.default_rng(0)
    scores = rng.random(len(store)) * is_leaf(store)
    with_stats(store, score=scores, steps=3)
    growing, after = grown(store, threshold=0.5, most=450)
    splats, new = merge_forest(after)
    assert growing.added == 50 and new.leaves == 450 and len(splats) == len(new) == 899
    # those that are nodes now are the leaves of the highest scores, as they were
    least = np.sort(scores)[-50]
    records = store.rows.read(np.arange(len(store)))
    chosen = {row.tobytes() for row in records[scores >= least][:, :3].numpy()}
    kept = {row.tobytes() for row in splats.means[: new.leaves]}
    above = {row.tobytes() for row in splats.means[new.leaves :]}
    assert len(chosen) == 50 and chosen <= above and not chosen & kept
    columns = after.layout.split(after.rows.read(np.arange(len(after))))
    assert not columns["score"].any()
    fresh = columns["steps"] == 0
    assert fresh.sum() == 100 and not columns["first"][fresh].any() and (columns["seen"][fresh] == 9).all()
    # two children look much like the one they come from: as far from it, on one line
    place = {row.tobytes(): node for node, row in enumerate(splats.means)}
    for row in chosen:
        node = place[row]
        one, other = new.children[node - new.leaves]
        middle = (splats.means[one].astype(float) + splats.means[other]) / 2
        np.testing.assert_allclose(middle, splats.means[node], atol=1e-5)
        assert splats.opacity_logits[one] == splats.opacity_logits[other] < splats.opacity_logits[node]


def test_faint_and_unseen_leaves_go(store):
    leaves = is_leaf(store)
    seen = np.full(len(store), 7.0)
    gone = np.flatnonzero(leaves)[[3, 50, 200]]
    seen[gone] = 2
    with_stats(store, seen=seen)
    removed = store.rows.read(gone)[:, :3].numpy()
    growing, after = grown(store, unseen_since=3)
    splats, tree = merge_forest(after)
    assert growing.removed == 3 and tree.leaves == 397
    assert not (removed[:, None] == splats.means).all(2).any()
    faint = np.zeros(len(after))
    faint[np.flatnonzero(is_leaf(after))[:5]] = -9
    with_stats(after, opacity_logits=faint)
    growing, last = grown(after)
    assert 0 < growing.removed <= 5 and merge_forest(last)[1].leaves == 397 - growing.removed


def test_a_subtree_that_grew_is_divided_and_the_tree_stays_one(store):
    for _ in range(4):
        with_stats(store, score=is_leaf(store))
        before = merge_forest(store)[1].leaves
        _, store = grown(store, threshold=0.5)
        splats, tree = merge_forest(store)
        assert tree.leaves == 2 * before == int(store.shape.counts.sum())
        assert store.shape.counts.max() <= GROWN * max_subtree_leaves(tree.leaves)
        assert sorted(below(tree, len(tree) - 1)) == list(range(tree.leaves))
        sizes = tree.sizes(splats.means, splats.log_scales)
        assert (sizes[tree.parents[:-1]] >= sizes[:-1]).all()


def test_of_leaves_that_are_all_too_faint_each_pair_keeps_one(store):
    growing, after = grown(store, min_opacity=1.0)
    assert growing.removed == len(merge_forest(store)[1].children) - len(merge_forest(after)[1].children) > 0
