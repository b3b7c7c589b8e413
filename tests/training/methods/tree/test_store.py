"""Nodes outside memory: cuts against HSPT in memory, training against itself with more room, going on."""

import io

import numpy as np
import pytest
import torch

from tests.training.lod.tree.trees import surfaces
from tests.training.rasterize.test_sequential_point_tree import cameras
from training.errors import LodgsError
from training.lod.tree.forest import forest_shape, max_subtree_leaves, merge_forest, split_tree
from training.methods.tree import store as store_module
from training.methods.tree.build import build
from training.methods.tree.store import Store, layout_of
from training.optimize.out_of_core.cut_cache import INDEX_BYTES, SLOT_BYTES
from training.optimize.out_of_core.row_file import BLOCK, TABLE_BYTES
from training.rasterize.sequential_point_tree import SequentialPointTree

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")
RECORD = 4 * layout_of(1).width + SLOT_BYTES
TABLE = INDEX_BYTES * 16_000 + TABLE_BYTES * 16_000 // BLOCK


@pytest.fixture(scope="module")
def town():
    """A tree over 8,000 splats on some surfaces: nodes and tree."""
    return build(surfaces(8_000, degree=1))


def stored(folder, town, budget=1 << 30, longest=0):
    nodes, tree = town
    folder.mkdir(parents=True, exist_ok=True)
    made = Store(folder, 1, budget)
    made.fill(split_tree(nodes, tree, longest or max_subtree_leaves(tree.leaves)))
    return made


def names_of(rows, names):
    """Which of nodes, by their means (N, 3), each of as many rows is, by its mean."""
    found = np.empty(len(rows), np.int64)
    found[np.lexsort(rows.T)] = np.lexsort(names.T)
    np.testing.assert_array_equal(rows, names[found])
    return found


def means_of(made):
    return made.layout.split(made.rows.read(np.arange(len(made))))["means"].numpy()


@pytest.mark.parametrize("longest", [1, 7, 0, 10_000])
def test_a_cut_made_anew_is_that_of_hspt_in_memory(town, tmp_path, longest, monkeypatch):
    monkeypatch.setattr(store_module, "AT_ONCE", 300)  # many parts of everything
    nodes, tree = town
    made = stored(tmp_path, town, longest=longest)
    order = names_of(means_of(made), nodes.means)
    sizes = tree.sizes(nodes.means, nodes.log_scales)
    hspt = SequentialPointTree(
        tree, nodes.means, sizes, nodes.log_scales, longest or max_subtree_leaves(tree.leaves)
    )
    found = 0
    for camera in cameras(np.random.default_rng(longest)):
        for pixels in (0.2, 0.7, 1.8):
            made.cache.release_cuts()
            places = made.take(camera, pixels, 0.3)
            rows = made.cache.rows_at(places)
            assert (np.diff(rows) > 0).all(), "rows ascend, whatever was here before"
            np.testing.assert_array_equal(np.sort(order[rows]), np.sort(hspt.cut(camera, pixels, 0.3)))
            splats = made.gaussians_at(places)
            for name in NAMES:
                np.testing.assert_array_equal(getattr(splats, name), getattr(nodes, name)[order[rows]])
            found += len(rows)
    assert found > 1000


def moved(made, seed):
    """Moves all nodes by their rows."""
    rng = np.random.default_rng(seed)
    made.cache.write_back()
    records = made.rows.read(np.arange(len(made)))
    records[:, :3] += torch.from_numpy(rng.normal(0, 0.05, (len(made), 3)).astype(np.float32))
    records[:, 7:10] += torch.from_numpy(rng.normal(0, 0.3, (len(made), 3)).astype(np.float32))
    made.cache.evict_all()
    made.rows.write(np.arange(len(made)), records)
    return records


def test_sizes_follow_what_has_moved(town, tmp_path, monkeypatch):
    """Twice, as lists are sorted by the sizes before; against the same nodes as one tree in memory."""
    monkeypatch.setattr(store_module, "AT_ONCE", 500)
    made = stored(tmp_path, town)
    for seed in range(2):
        moved(made, seed)
        made.resize()
        nodes, tree = merge_forest(made)
        longest = max_subtree_leaves(tree.leaves)
        order, _ = forest_shape(tree, longest)
        sizes = tree.sizes(nodes.means, nodes.log_scales)
        hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, longest)
        for camera in cameras(np.random.default_rng(5), 4):
            made.cache.release_cuts()
            rows = made.cache.rows_at(made.take(camera, 0.7, 0.3))
            np.testing.assert_array_equal(np.sort(order[rows]), np.sort(hspt.cut(camera, 0.7, 0.3)))


def test_what_comes_out_is_what_came_in(town, tmp_path):
    """But for the order of a subtree's leaves, and of its nodes above leaves."""
    nodes, tree = town
    forest = split_tree(nodes, tree, max_subtree_leaves(tree.leaves))
    made = stored(tmp_path, town)
    for (ours, shape), (theirs, other) in zip([*made, made.upper], [*forest, forest.upper], strict=True):
        if not len(ours):
            continue
        names = names_of(ours.means, theirs.means)
        for name in NAMES:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name)[names])
        if len(ours) < len(shape):  # the upper tree, whose leaves are elsewhere
            np.testing.assert_array_equal(names, np.arange(len(names)))
            np.testing.assert_array_equal(shape.children, other.children)
            continue
        assert (names[: shape.leaves] < shape.leaves).all() and names[-1] == len(shape) - 1
        np.testing.assert_array_equal(
            names[shape.children], other.children[names[shape.leaves :] - shape.leaves]
        )


def test_what_has_parents_of_one_size_lies_together(town, tmp_path):
    made, many = stored(tmp_path, town), 0
    for splats, tree in made:
        sizes, parents = tree.sizes(splats.means, splats.log_scales), tree.parents
        for some in (slice(0, tree.leaves), slice(tree.leaves, -1)):
            assert (np.diff(sizes[parents[some]]) >= 0).all()
        many += len(tree) > 10
    assert many > 50


def steps(made, begin, end):
    """As training goes: cuts of views that move, whose records change by what they are."""
    views = list(cameras(np.random.default_rng(1), 40))
    for step in range(begin, end):
        if step % 15 == 14:
            made.resize()
        places = made.take(views[step], 1.0, 0.3)
        made.cache.put(places, made.cache.get(places) * 1.001)
        made.cache.end_step(step)
    made.cache.write_back()
    return made.rows.read(np.arange(len(made)))


def exactly(made):
    """Cuts serve for the same distance alone."""
    made.cache._min_ratio = made.cache._max_ratio = 1.0
    return made


def test_with_little_room_the_bits_are_the_same(town, tmp_path):
    most = stored(tmp_path / "all", town)
    views = cameras(np.random.default_rng(1), 40)
    needed = max(len(most.take(view, 1.0, 0.3)) for view in views) + len(most.shape.counts)
    little = exactly(stored(tmp_path / "some", town, budget=needed * RECORD + most.cache.tables))
    assert little.cache.capacity == needed < len(most) / 3
    truth, found = steps(exactly(stored(tmp_path / "more", town)), 0, 40), steps(little, 0, 40)
    torch.testing.assert_close(found, truth, rtol=0, atol=0)
    assert little.cache.loaded > 2 * needed


@pytest.mark.parametrize("stop", [3, 14, 29])
def test_a_store_goes_on_to_the_bit(town, tmp_path, stop):
    """With cuts that serve from near by and little room, so that which are there matters."""
    budget = 3500 * RECORD + TABLE
    truth = steps(stored(tmp_path / "whole", town, budget), 0, 40)
    first = stored(tmp_path / "parts", town, budget)
    steps(first, 0, stop)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    steps(first, stop, min(stop + 9, 40))  # which is lost
    first.close()
    file.seek(0)
    second = Store(tmp_path / "parts", 1, budget)
    second.load_state_dict(torch.load(file, weights_only=True))
    torch.testing.assert_close(steps(second, stop, 40), truth, rtol=0, atol=0)


def test_a_view_without_room_is_coarsened_until_it_has(town, tmp_path):
    """And what it is shown then is the cut for that granularity; a budget as told has room."""
    made, whole = stored(tmp_path / "some", town, budget=700 * RECORD + TABLE), stored(tmp_path, town)
    coarser = 0
    for camera in cameras(np.random.default_rng(0)):
        made.cache.release_cuts()
        made.coarsened, made.wanted = 1.0, 0
        rows = made.cache.rows_at(made.take(camera, 0.2, 0.3))
        whole.cache.release_cuts()
        truth = whole.cache.rows_at(whole.take(camera, 0.2 * made.coarsened, 0.3))
        np.testing.assert_array_equal(rows, truth)
        assert len(rows) <= made.cache.capacity == 700
        if made.coarsened == 1:
            assert made.wanted == 0
            continue
        assert len(rows) > 200, "no coarser than it need be"
        coarser += 1
        enough = stored(tmp_path / f"{coarser}", town, budget=made.wanted)
        enough.take(camera, 0.2, 0.3)
        assert enough.coarsened == 1 and whole.coarsened == 1
        enough.close()
    assert coarser > 3


def test_too_little_room_for_the_coarsest_is_told(town, tmp_path):
    made = stored(tmp_path, town, budget=3 * RECORD + TABLE)
    camera = next(cameras(np.random.default_rng(0)))
    with pytest.raises(LodgsError, match=r"needs .* holds .* splat_memory"):
        made.take(camera, 0.1, 0.3)
