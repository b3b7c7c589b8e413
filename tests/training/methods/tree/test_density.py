"""Tests of density control of a tree, against a node-by-node reference."""

import numpy as np
import pytest
import torch

from tests.training.lod.tree.trees import random_tree
from training.lod.tree.forest import max_subtree_leaves, merge_forest
from training.lod.tree.shape import Tree
from training.methods.tree.build import ForestBuilder
from training.methods.tree.density import MAX_GROWTH, TreeDensityControl, edit_tree
from training.methods.tree.store import NodeStore

from .test_build import leaves_below, scene


def nested(tree, names):
    """Convert a tree to nested tuples (name, left, right) and (name,), from the root."""

    def subtree(node):
        if node < tree.leaves:
            return (names[node],)
        return (names[node], *(subtree(child) for child in tree.children[node - tree.leaves]))

    return subtree(len(tree) - 1)


def edit_nested(node, split, dead):
    """Apply Sec. 4.2 and A.6 node by node; ``split`` and ``dead`` hold names."""
    if len(node) == 1:
        return (node[0], node, node) if node[0] in split and node[0] not in dead else node
    name, left, right = node
    if len(right) == 1 and right[0] in dead:  # if both are dead, the right one is removed
        return edit_nested(left, split, dead)
    if len(left) == 1 and left[0] in dead:
        return edit_nested(right, split, dead)
    return (name, edit_nested(left, split, dead), edit_nested(right, split, dead))


@pytest.mark.parametrize("seed", range(60))
def test_edit_matches_reference(seed):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, int(rng.integers(1, 60)))
    split, dead = (rng.random(tree.leaves) < rng.choice([0, 0.1, 0.5, 1]) for _ in range(2))
    new, source = edit_tree(tree, split, dead)
    assert len(source) == len(new)
    expected = edit_nested(
        nested(tree, range(len(tree))), set(np.flatnonzero(split)), set(np.flatnonzero(dead))
    )
    assert nested(new, source.tolist()) == expected
    # numbers increase towards the root, and leaves keep their order
    assert (new.children < np.arange(new.leaves, len(new))[:, None]).all()
    assert (np.diff(source[: new.leaves]) >= 0).all()


def test_edge_cases_of_the_paper():
    #       6
    #    5     4     leaves 0 and 1 below 5, 2 and 3 below 4
    tree = Tree(np.array([[2, 3], [0, 1], [5, 4]], np.int32))

    def edited(split=(), dead=()):
        flags = (np.isin(np.arange(4), item) for item in (split, dead))
        new, source = edit_tree(tree, *flags)
        return nested(new, source.tolist())

    assert edited(dead=[1]) == (6, (0,), (4, (2,), (3,)))
    assert edited(dead=[0, 1]) == (6, (0,), (4, (2,), (3,)))  # the left one remains
    assert edited(dead=[0, 1, 2, 3]) == (6, (0,), (2,))
    assert edited(split=[1]) == (6, (5, (0,), (1, (1,), (1,))), (4, (2,), (3,)))
    assert edited(split=[0], dead=[1]) == (6, (0, (0,), (0,)), (4, (2,), (3,)))
    deep = Tree(np.array([[0, 1], [3, 2]], np.int32))  # 2 is the sibling of the node over 0 and 1
    new, source = edit_tree(deep, np.zeros(3, bool), np.array([False, False, True]))
    assert nested(new, source.tolist()) == (3, (0,), (1,))  # its subtree replaces the root


def test_single_leaf_remains():
    new, source = edit_tree(Tree(np.zeros((0, 2), np.int32)), np.array([False]), np.array([True]))
    assert new.leaves == 1 and source.tolist() == [0]
    new, source = edit_tree(Tree(np.zeros((0, 2), np.int32)), np.array([True]), np.array([False]))
    assert nested(new, source.tolist()) == (0, (0,), (0,))


# -- density control of a store ------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path):
    store = NodeStore(tmp_path, 1, 1 << 24)
    store.fill(ForestBuilder(scene(400), subtree_leaves=16))
    return store


def set_columns(store, **values):
    """Set columns of all records."""
    store.cache.evict_all()
    records = store.rows.read(np.arange(len(store)))
    for name, column in values.items():
        store.layout.split(records)[name][:] = torch.as_tensor(column, dtype=torch.float32)
    store.rows.write(np.arange(len(store)), records)


def is_leaf(store):
    counts = store.shape.counts
    inside = np.concatenate([np.arange(2 * count - 1) < count for count in counts.tolist()])
    return np.append(inside, np.zeros(len(counts) - 1, bool))


def control_density(store, **values):
    expected = {"threshold": np.inf, "min_opacity": 0.005, "unseen_since": 0, "step": 9, "max_leaves": 10**6}
    control = TreeDensityControl(store, **(expected | values))
    second = NodeStore(store.rows._folder, 1, store.budget)
    second.fill_records(control, lambda: control.upper)
    return control, second


def test_no_candidates_change_nothing(store):
    initial = merge_forest(store)
    control, final = control_density(store)
    assert control.added == control.removed == 0
    splats, tree = merge_forest(final)
    assert np.array_equal(tree.children, initial[1].children) and np.array_equal(
        splats.means, initial[0].means
    )


def test_highest_scores_are_split_up_to_limit(store):
    rng = np.random.default_rng(0)
    scores = rng.random(len(store)) * is_leaf(store)
    set_columns(store, score=scores, steps=3)
    control, final = control_density(store, threshold=0.5, max_leaves=450)
    splats, new = merge_forest(final)
    assert control.added == 50 and new.leaves == 450 and len(splats) == len(new) == 899
    # the leaves with the highest scores have become inner nodes, unchanged
    minimum = np.sort(scores)[-50]
    records = store.rows.read(np.arange(len(store)))
    chosen = {row.tobytes() for row in records[scores >= minimum][:, :3].numpy()}
    remaining = {row.tobytes() for row in splats.means[: new.leaves]}
    above = {row.tobytes() for row in splats.means[new.leaves :]}
    assert len(chosen) == 50 and chosen <= above and not chosen & remaining
    columns = final.layout.split(final.rows.read(np.arange(len(final))))
    assert not columns["score"].any()
    new_rows = columns["steps"] == 0
    assert (
        new_rows.sum() == 100
        and not columns["first"][new_rows].any()
        and (columns["seen"][new_rows] == 9).all()
    )
    # children are symmetric about their parent and fainter
    node_of_row = {row.tobytes(): node for node, row in enumerate(splats.means)}
    for row in chosen:
        node = node_of_row[row]
        first, second = new.children[node - new.leaves]
        center = (splats.means[first].astype(float) + splats.means[second]) / 2
        np.testing.assert_allclose(center, splats.means[node], atol=1e-5)
        assert splats.opacity_logits[first] == splats.opacity_logits[second] < splats.opacity_logits[node]


def test_faint_and_unseen_leaves_are_removed(store):
    leaves = is_leaf(store)
    visible = np.full(len(store), 7.0)
    unseen = np.flatnonzero(leaves)[[3, 50, 200]]
    visible[unseen] = 2
    set_columns(store, seen=visible)
    removed = store.rows.read(unseen)[:, :3].numpy()
    control, final = control_density(store, unseen_since=3)
    splats, tree = merge_forest(final)
    assert control.removed == 3 and tree.leaves == 397
    assert not (removed[:, None] == splats.means).all(2).any()
    faint = np.zeros(len(final))
    faint[np.flatnonzero(is_leaf(final))[:5]] = -9
    set_columns(final, opacity_logits=faint)
    control, last = control_density(final)
    assert 0 < control.removed <= 5 and merge_forest(last)[1].leaves == 397 - control.removed


def test_large_subtree_is_divided(store):
    for _ in range(4):
        set_columns(store, score=is_leaf(store))
        initial = merge_forest(store)[1].leaves
        _, store = control_density(store, threshold=0.5)
        splats, tree = merge_forest(store)
        assert tree.leaves == 2 * initial == int(store.shape.counts.sum())
        assert store.shape.counts.max() <= MAX_GROWTH * max_subtree_leaves(tree.leaves)
        assert sorted(leaves_below(tree, len(tree) - 1)) == list(range(tree.leaves))
        sizes = tree.sizes(splats.means, splats.log_scales)
        assert (sizes[tree.parents[:-1]] >= sizes[:-1]).all()


def test_faint_pairs_keep_one_leaf(store):
    control, final = control_density(store, min_opacity=1.0)
    assert control.removed == len(merge_forest(store)[1].children) - len(merge_forest(final)[1].children) > 0
