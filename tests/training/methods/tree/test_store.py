"""Tests of nodes on disk: cuts against HSPT in memory, training with small budgets, resuming."""

import io

import numpy as np
import pytest
import torch

from tests.training.lod.tree.trees import surfaces
from tests.training.methods.tree.sequential_tree import SequentialPointTree
from tests.training.methods.tree.test_sequential_point_tree import cameras
from training.errors import LodgsError
from training.lod.tree.forest import forest_shape, max_subtree_leaves, merge_forest, split_tree
from training.methods.tree import store as store_module
from training.methods.tree.build import build
from training.methods.tree.store import NodeStore, record_layout
from training.optimize.out_of_core.cut_cache import INDEX_BYTES, SLOT_BYTES
from training.optimize.out_of_core.row_file import BLOCK, TABLE_BYTES

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
RECORD = 4 * record_layout(1).width + SLOT_BYTES
TABLE = INDEX_BYTES * 16_000 + TABLE_BYTES * 16_000 // BLOCK


@pytest.fixture(scope="module")
def town():
    """Return nodes and tree over 8,000 splats on surfaces."""
    return build(surfaces(8_000, degree=1))


def create_store(folder, town, budget=1 << 30, subtree_leaves=0):
    nodes, tree = town
    folder.mkdir(parents=True, exist_ok=True)
    store = NodeStore(folder, 1, budget)
    store.fill(split_tree(nodes, tree, subtree_leaves or max_subtree_leaves(tree.leaves)))
    return store


def match_rows(rows, names):
    """Return the row of ``names`` (N, 3) that equals each row of ``rows``."""
    matches = np.empty(len(rows), np.int64)
    matches[np.lexsort(rows.T)] = np.lexsort(names.T)
    np.testing.assert_array_equal(rows, names[matches])
    return matches


def read_means(store):
    return store.layout.split(store.rows.read(np.arange(len(store))))["means"].numpy()


@pytest.mark.parametrize(
    "subtree_leaves",
    [pytest.param(1, marks=pytest.mark.nightly), 7, pytest.param(0, marks=pytest.mark.nightly), 10_000],
)
def test_new_cut_equals_hspt_in_memory(town, tmp_path, subtree_leaves, monkeypatch):
    monkeypatch.setattr(store_module, "BATCH_NODES", 300)  # many batches
    nodes, tree = town
    store = create_store(tmp_path, town, subtree_leaves=subtree_leaves)
    order = match_rows(read_means(store), nodes.means)
    sizes = tree.sizes(nodes.means, nodes.log_scales)
    hspt = SequentialPointTree(
        tree, nodes.means, sizes, nodes.log_scales, subtree_leaves or max_subtree_leaves(tree.leaves)
    )
    row_count = 0
    for camera in cameras(np.random.default_rng(subtree_leaves)):
        for pixels in (0.2, 0.7, 1.8):
            store.cache.release_cuts()
            indices = store.load_cut(camera, pixels, 0.3)
            rows = store.cache.rows_at(indices)
            assert (np.diff(rows) > 0).all(), "rows are sorted"
            np.testing.assert_array_equal(np.sort(order[rows]), np.sort(hspt.cut(camera, pixels, 0.3)))
            splats = store.gaussians_at(indices)
            for name in NAMES:
                np.testing.assert_array_equal(getattr(splats, name), getattr(nodes, name)[order[rows]])
            row_count += len(rows)
    assert row_count > 1000


def move_nodes(store, seed):
    """Move all nodes by amounts that depend on their rows."""
    rng = np.random.default_rng(seed)
    store.cache.write_back()
    records = store.rows.read(np.arange(len(store)))
    records[:, :3] += torch.from_numpy(rng.normal(0, 0.05, (len(store), 3)).astype(np.float32))
    records[:, 7:10] += torch.from_numpy(rng.normal(0, 0.3, (len(store), 3)).astype(np.float32))
    store.cache.evict_all()
    store.rows.write(np.arange(len(store)), records)
    return records


def test_sizes_follow_moved_nodes(town, tmp_path, monkeypatch):
    """Test twice, because lists are sorted by previous sizes. The reference is a tree in memory."""
    monkeypatch.setattr(store_module, "BATCH_NODES", 500)
    store = create_store(tmp_path, town)
    for seed in range(2):
        move_nodes(store, seed)
        store.update_sizes()
        nodes, tree = merge_forest(store)
        subtree_leaves = max_subtree_leaves(tree.leaves)
        order, _ = forest_shape(tree, subtree_leaves)
        sizes = tree.sizes(nodes.means, nodes.log_scales)
        hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, subtree_leaves)
        for camera in cameras(np.random.default_rng(5), 4):
            store.cache.release_cuts()
            rows = store.cache.rows_at(store.load_cut(camera, 0.7, 0.3))
            np.testing.assert_array_equal(np.sort(order[rows]), np.sort(hspt.cut(camera, 0.7, 0.3)))


def test_store_returns_its_input(town, tmp_path):
    """The order of leaves and of inner nodes in a subtree may differ."""
    nodes, tree = town
    forest = split_tree(nodes, tree, max_subtree_leaves(tree.leaves))
    store = create_store(tmp_path, town)
    for (stored, shape), (original, original_shape) in zip(
        [*store, store.upper], [*forest, forest.upper], strict=True
    ):
        if not len(stored):
            continue
        names = match_rows(stored.means, original.means)
        for name in NAMES:
            np.testing.assert_array_equal(getattr(stored, name), getattr(original, name)[names])
        if len(stored) < len(shape):  # the upper tree, whose leaves are roots of subtrees
            np.testing.assert_array_equal(names, np.arange(len(names)))
            np.testing.assert_array_equal(shape.children, original_shape.children)
            continue
        assert (names[: shape.leaves] < shape.leaves).all() and names[-1] == len(shape) - 1
        np.testing.assert_array_equal(
            names[shape.children], original_shape.children[names[shape.leaves :] - shape.leaves]
        )


def test_nodes_are_sorted_by_parent_size(town, tmp_path):
    store, count = create_store(tmp_path, town), 0
    for splats, tree in store:
        sizes, parents = tree.sizes(splats.means, splats.log_scales), tree.parents
        for rows in (slice(0, tree.leaves), slice(tree.leaves, -1)):
            assert (np.diff(sizes[parents[rows]]) >= 0).all()
        count += len(tree) > 10
    assert count > 50


def make_steps(store, begin, end):
    """Imitate training: load cuts of moving views, and change their records by their values."""
    views = list(cameras(np.random.default_rng(1), 40))
    for step in range(begin, end):
        if step % 15 == 14:
            store.update_sizes()
        indices = store.load_cut(views[step], 1.0, 0.3)
        store.cache.put(indices, store.cache.get(indices) * 1.001)
        store.cache.end_step(step)
    store.cache.write_back()
    return store.rows.read(np.arange(len(store)))


def without_reuse(store):
    """Allow reuse of cuts at equal distance only."""
    store.cache._min_ratio = store.cache._max_ratio = 1.0
    return store


def test_small_budget_gives_identical_bits(town, tmp_path):
    large_store = create_store(tmp_path / "all", town)
    views = cameras(np.random.default_rng(1), 40)
    needed = max(len(large_store.load_cut(view, 1.0, 0.3)) for view in views) + len(large_store.shape.counts)
    small_store = without_reuse(
        create_store(tmp_path / "some", town, budget=needed * RECORD + large_store.cache.table_bytes)
    )
    assert small_store.cache.capacity == needed < len(large_store) / 3
    truth, actual = (
        make_steps(without_reuse(create_store(tmp_path / "more", town)), 0, 40),
        make_steps(small_store, 0, 40),
    )
    torch.testing.assert_close(actual, truth, rtol=0, atol=0)
    assert small_store.cache.loaded > 2 * needed


@pytest.mark.parametrize("stop", [14, *(pytest.param(step, marks=pytest.mark.nightly) for step in (3, 29))])
def test_resume_is_bit_identical(town, tmp_path, stop):
    """Reused cuts and a small budget make the result depend on the cache."""
    budget = 3500 * RECORD + TABLE
    truth = make_steps(create_store(tmp_path / "whole", town, budget), 0, 40)
    first = create_store(tmp_path / "parts", town, budget)
    make_steps(first, 0, stop)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    make_steps(first, stop, min(stop + 9, 40))  # these steps are lost
    first.close()
    file.seek(0)
    second = NodeStore(tmp_path / "parts", 1, budget)
    second.load_state_dict(torch.load(file, weights_only=True))
    torch.testing.assert_close(make_steps(second, stop, 40), truth, rtol=0, atol=0)


def test_cut_is_coarsened_to_fit_budget(town, tmp_path):
    """The cut equals that of the coarser granularity, and the suggested budget suffices."""
    store, full_store = (
        create_store(tmp_path / "some", town, budget=700 * RECORD + TABLE),
        create_store(tmp_path, town),
    )
    coarser = 0
    for camera in cameras(np.random.default_rng(0)):
        store.cache.release_cuts()
        store.max_coarsening, store.needed_budget = 1.0, 0
        rows = store.cache.rows_at(store.load_cut(camera, 0.2, 0.3))
        full_store.cache.release_cuts()
        truth = full_store.cache.rows_at(full_store.load_cut(camera, 0.2 * store.max_coarsening, 0.3))
        np.testing.assert_array_equal(rows, truth)
        assert len(rows) <= store.cache.capacity == 700
        if store.max_coarsening == 1:
            assert store.needed_budget == 0
            continue
        assert len(rows) > 200, "no coarser than necessary"
        coarser += 1
        sufficient_store = create_store(tmp_path / f"{coarser}", town, budget=store.needed_budget)
        sufficient_store.load_cut(camera, 0.2, 0.3)
        assert sufficient_store.max_coarsening == 1 and full_store.max_coarsening == 1
        sufficient_store.close()
    assert coarser > 3


def test_budget_below_coarsest_cut_raises(town, tmp_path):
    store = create_store(tmp_path, town, budget=3 * RECORD + TABLE)
    camera = next(cameras(np.random.default_rng(0)))
    with pytest.raises(LodgsError, match=r"needs .* holds .* splat_memory"):
        store.load_cut(camera, 0.1, 0.3)
