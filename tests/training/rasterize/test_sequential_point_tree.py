"""HSPT against a walk from the root and against the rule, and what it leaves out against the image."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.training.lod.tree.trees import random_tree, surfaces
from training.lod.rule import rules
from training.lod.tree.shape import Tree
from training.methods.tree.build import build
from training.rasterize import Gaussians, rasterize
from training.rasterize.cpu.compile import set_thread_count, thread_count
from training.rasterize.sequential_point_tree import SequentialPointTree
from training.scenes.cameras import Camera, look_at

CUT = rules()["cut"]


def places(rng, count):
    means = rng.normal(0, rng.choice([0.01, 1, 50]), (count, 3)).astype(np.float32)
    log_scales = rng.normal(-3, 1.5, (count, 3)).astype(np.float32)
    if rng.random() < 0.3:  # many in one place, and without a size
        means, log_scales = means.round(), np.where(log_scales < -3, np.float32(-300), log_scales)
    return means, log_scales


def walked(tree, means, sizes, eye, k):
    """The cut by Algorithm 1, node by node."""
    found, ahead, eye, k = [], [len(tree) - 1], np.float32(eye), np.float32(k)
    while ahead:
        node = ahead.pop()
        x, y, z = means[node] - eye
        if np.sqrt(x * x + y * y + z * z) >= k * sizes[node]:
            found.append(node)
        else:
            ahead += tree.children[node - tree.leaves].tolist()
    return sorted(found)


@settings(deadline=None)
@given(
    st.integers(0, 2**32), st.integers(2, 80), st.sampled_from([0, 1, 2, 5, 1000]), st.floats(32, 3000),
    st.floats(0.01, 1000),
)  # fmt: skip
def test_on_small_trees_it_is_the_walk_from_the_root(seed, leaves, longest, k, reach):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves)
    means, log_scales = places(rng, len(tree))
    sizes = tree.sizes(means, log_scales)
    hspt = SequentialPointTree(tree, means, sizes, log_scales, longest)
    for eye in (rng.normal(0, reach, 3), means[0], means[-1] + np.float32([k, 0, 0]) * sizes[-1]):
        found = hspt.cut_at(eye, k)
        assert found.dtype == np.int32
        assert sorted(found) == walked(tree, means, sizes, eye, k)


@pytest.fixture(scope="module")
def large():
    """A tree over 30,000 splats on some surfaces: nodes, tree, sizes."""
    nodes, tree = build(surfaces(30_000))
    return nodes, tree, tree.sizes(nodes.means, nodes.log_scales)


def cameras(rng, count=8):
    for _ in range(count):
        eye, target = rng.uniform(-15, 15, (2, 3))
        pose = look_at(eye, target, np.array([0.0, 0, 1]))
        yield Camera("a", 96, 64, 80.0, rng.uniform(60, 100), 40.0, 30.0, pose)


def test_on_a_large_tree_it_is_the_rule_and_no_node_is_above_another(large):
    nodes, tree, sizes = large
    columns = tree.columns(nodes.means, sizes)
    for longest in (0, 40, 4000):
        hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, longest)
        for camera in cameras(np.random.default_rng(longest)):
            for pixels in (0.2, 0.7, 1.8):  # k from 500 to 33
                found = np.sort(hspt.cut_at(camera.center, camera.focal / pixels))
                by_rule = CUT.weights(
                    nodes.means, camera.center, camera.focal, columns, {}, {"pixels": pixels}
                )
                np.testing.assert_array_equal(found, np.flatnonzero(by_rule))
    above = np.zeros(len(tree), bool)
    above[found] = True
    times = above.astype(int)
    for layer in tree.layers:  # from the root down: how many nodes of the cut are at or above each
        times[tree.children[layer - tree.leaves]] += times[layer][:, None]
    assert (times[: tree.leaves] == 1).all()


def test_what_is_left_out_is_not_in_the_image(large):
    nodes, tree, sizes = large
    hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, 60)
    gaussians, left_out = Gaussians.of(nodes), 0
    for camera in cameras(np.random.default_rng(7)):
        for pixels in (0.5, 1.8):
            everything = np.sort(hspt.cut_at(camera.center, camera.focal / pixels))
            some = np.sort(hspt.cut(camera, pixels, near=0.3))
            assert np.isin(some, everything).all()
            one, other = (
                rasterize(gaussians, camera, rows=torch.from_numpy(rows), near=0.3, backend="cpu")
                for rows in (everything, some)
            )
            torch.testing.assert_close(one.image, other.image, rtol=0, atol=0)
            assert (one.radii > 0).sum() == (other.radii > 0).sum()
            left_out += len(everything) - len(some)
    assert left_out > 50_000


def test_the_order_is_the_same_on_any_number_of_threads(large):
    nodes, tree, sizes = large
    hspt, used = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales, 20), thread_count()
    try:
        for camera in cameras(np.random.default_rng(5), 3):
            found = []
            for count in (1, 2, 5):
                set_thread_count(count)
                found.append(hspt.cut(camera, 0.5))
            assert all(np.array_equal(found[0], other) for other in found[1:])
    finally:
        set_thread_count(used)


def test_more_pixels_draw_less(large):
    nodes, tree, sizes = large
    hspt = SequentialPointTree(tree, nodes.means, sizes, nodes.log_scales)
    for camera in cameras(np.random.default_rng(9), 4):
        counts = [len(hspt.cut(camera, pixels)) for pixels in (0.1, 0.2, 0.4, 0.8, 1.6, 2.4)]
        assert all(more >= less for more, less in pairwise(counts)) and counts[0] > counts[-1]


def test_both_children_of_a_pair_of_leaves_are_found():
    tree = Tree(np.array([[0, 1]], np.int32))
    means = np.float32([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]])
    log_scales = np.full((3, 3), -1, np.float32)
    hspt = SequentialPointTree(tree, means, tree.sizes(means, log_scales), log_scales)
    assert sorted(hspt.cut_at(np.zeros(3), 100.0)) == [0, 1]
    assert hspt.cut_at(np.array([1e6, 0, 0]), 100.0).tolist() == [2]
