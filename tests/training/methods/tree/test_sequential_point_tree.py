"""Compare HSPT cuts with a traversal from the root and with the rule, and test culling."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.training.lod.tree.trees import random_tree, surfaces
from tests.training.methods.tree.sequential_tree import SequentialPointTree
from training.lod.rule import rules
from training.lod.tree.shape import Tree
from training.methods.tree.build import build
from training.rasterize import Gaussians, rasterize
from training.rasterize.cpu.compile import set_thread_count, thread_count
from training.scenes.cameras import Camera, look_at

CUT = rules()["cut"]


def random_nodes(rng, count):
    means = rng.normal(0, rng.choice([0.01, 1, 50]), (count, 3)).astype(np.float32)
    log_scales = rng.normal(-3, 1.5, (count, 3)).astype(np.float32)
    if rng.random() < 0.3:  # coinciding splats without size
        means, log_scales = means.round(), np.where(log_scales < -3, np.float32(-300), log_scales)
    return means, log_scales


def cut_by_traversal(tree, means, sizes, position, k):
    """Compute the cut node by node with Algorithm 1."""
    cut = []
    stack = [len(tree) - 1]
    position, k = np.float32(position), np.float32(k)
    while stack:
        node = stack.pop()
        x, y, z = means[node] - position
        if np.sqrt(x * x + y * y + z * z) >= k * sizes[node]:
            cut.append(node)
        else:
            stack += tree.children[node - tree.leaves].tolist()
    return sorted(cut)


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**32), st.integers(2, 80), st.sampled_from([0, 1, 2, 5, 1000]), st.floats(32, 3000),
    st.floats(0.01, 1000),
)  # fmt: skip
def test_cut_of_small_trees_matches_algorithm_1(seed, leaves, longest, k, reach):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves)
    means, log_scales = random_nodes(rng, len(tree))
    sizes = tree.sizes(means, log_scales)
    hspt = SequentialPointTree(tree, means, sizes, log_scales, longest)
    for position in (rng.normal(0, reach, 3), means[0], means[-1] + np.float32([k, 0, 0]) * sizes[-1]):
        cut = hspt.cut_at(position, k)
        assert cut.dtype == np.int32
        assert sorted(cut) == cut_by_traversal(tree, means, sizes, position, k)


@pytest.fixture(scope="module")
def large():
    """Nodes, tree and sizes of 30,000 splats on surfaces."""
    nodes, tree = build(surfaces(30_000))
    return nodes, tree, tree.sizes(nodes.means, nodes.log_scales)


def cameras(rng, count=8):
    for _ in range(count):
        position, target = rng.uniform(-15, 15, (2, 3))
        pose = look_at(position, target, np.array([0.0, 0, 1]))
        yield Camera("a", 96, 64, 80.0, rng.uniform(60, 100), 40.0, 30.0, pose)


def test_cut_of_large_tree_matches_rule_and_covers_leaves_once(large):
    nodes, tree, sizes = large
    columns = tree.columns(nodes.means, sizes)
    for longest in (0, 40, 4000):
        hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, longest)
        for camera in cameras(np.random.default_rng(longest)):
            for pixels in (0.2, 0.7, 1.8):  # k from 500 to 33
                cut = np.sort(hspt.cut_at(camera.center, camera.focal / pixels))
                by_rule = CUT.weights(
                    nodes.means, camera.center, camera.focal, columns, {}, {"pixels": pixels}
                )
                np.testing.assert_array_equal(cut, np.flatnonzero(by_rule))
    in_cut = np.zeros(len(tree), bool)
    in_cut[cut] = True
    times = in_cut.astype(int)
    for layer in tree.layers:  # count the ancestors of each node that are in the cut, from the root down
        times[tree.children[layer - tree.leaves]] += times[layer][:, None]
    assert (times[: tree.leaves] == 1).all()


def test_culled_nodes_are_outside_the_image(large):
    nodes, tree, sizes = large
    hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, 60)
    gaussians = Gaussians.of(nodes)
    culled_count = 0
    for camera in cameras(np.random.default_rng(7)):
        for pixels in (0.5, 1.8):
            complete = np.sort(hspt.cut_at(camera.center, camera.focal / pixels))
            culled = np.sort(hspt.cut(camera, pixels, near=0.3))
            assert np.isin(culled, complete).all()
            expected, actual = (
                rasterize(gaussians, camera, rows=torch.from_numpy(rows), near=0.3, backend="cpu")
                for rows in (complete, culled)
            )
            torch.testing.assert_close(actual.image, expected.image, rtol=0, atol=0)
            assert (actual.radii > 0).sum() == (expected.radii > 0).sum()
            culled_count += len(complete) - len(culled)
    assert culled_count > 50_000


def test_order_does_not_depend_on_thread_count(large):
    nodes, tree, sizes = large
    hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, 20)
    original = thread_count()
    try:
        for camera in cameras(np.random.default_rng(5), 3):
            cuts = []
            for count in (1, 2, 5):
                set_thread_count(count)
                cuts.append(hspt.cut(camera, 0.5))
            assert all(np.array_equal(cuts[0], cut) for cut in cuts[1:])
    finally:
        set_thread_count(original)


def test_larger_pixel_limit_draws_fewer_nodes(large):
    nodes, tree, sizes = large
    hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales)
    for camera in cameras(np.random.default_rng(9), 4):
        counts = [len(hspt.cut(camera, pixels)) for pixels in (0.1, 0.2, 0.4, 0.8, 1.6, 2.4)]
        assert all(count >= next_count for count, next_count in pairwise(counts)) and counts[0] > counts[-1]


def test_tree_of_two_leaves():
    tree = Tree(np.array([[0, 1]], np.int32))
    means = np.float32([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]])
    log_scales = np.full((3, 3), -1, np.float32)
    hspt = SequentialPointTree(tree, means, tree.sizes(means, log_scales), log_scales)
    assert sorted(hspt.cut_at(np.zeros(3), 100.0)) == [0, 1]
    assert hspt.cut_at(np.array([1e6, 0, 0]), 100.0).tolist() == [2]
