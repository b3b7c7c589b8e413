"""Sizes and columns of trees, compared with a walk node by node."""

import numpy as np
import pytest

from training.lod.rule import rules
from training.lod.selection import resolve_controls, select_levels
from training.lod.tree.nodes import ABOVE_ROOT, MIN_DETAIL
from training.lod.tree.shape import leaf_only_columns, splat_size
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats, splat_area
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level

from .trees import random_tree


def nodes(rng, count):
    return Splats(
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-3, 1.5, (count, 3)).astype(np.float32),
        rng.normal(0, 2, count).astype(np.float32),
        rng.normal(size=(count, 4, 3)).astype(np.float32),
    )


def test_size_of_a_disc_is_its_radius():
    assert splat_size(np.log([[2.0, 2.0, 1e-9]])) == pytest.approx(2)
    assert splat_area(np.log([[1.0, 2.0, 3.0]])) == pytest.approx(2 + 3 + 6)


@pytest.mark.parametrize("leaves", [2, 3, 50, 400])
def test_sizes_are_minimal_for_proper_cuts(leaves):
    rng = np.random.default_rng(leaves)
    tree = random_tree(rng, leaves)
    splats = nodes(rng, len(tree))
    sizes = tree.sizes(splats.means, splats.log_scales)
    assert tree.leaves == leaves and len(tree) == 2 * leaves - 1 and sizes.dtype == np.float32
    assert not sizes[:leaves].any()
    expected, means = np.zeros(len(tree)), splats.means.astype(float)
    for node in range(leaves, len(tree)):
        a, b, c = np.exp(splats.log_scales[node].astype(float))
        minimum = (a * b + a * c + b * c) ** 0.5
        for child in tree.children[node - leaves]:
            distance = float(np.sqrt(((means[child] - means[node]) ** 2).sum()))
            assert float(sizes[node]) >= (float(sizes[child]) + distance / MIN_DETAIL) * (1 + 2**-20)
            minimum = max(minimum, (expected[child] + distance / MIN_DETAIL) * (1 + 2**-20))
            assert tree.parents[child] == node
        expected[node] = minimum
    np.testing.assert_allclose(sizes, expected, rtol=1e-5)
    assert tree.parents[-1] == -1
    assert sorted(np.concatenate(tree.layers)) == list(range(leaves, len(tree)))


def test_columns_repeat_the_parents_values():
    rng = np.random.default_rng(0)
    tree = random_tree(rng, 60)
    splats = nodes(rng, len(tree))
    sizes = tree.sizes(splats.means, splats.log_scales)
    columns = tree.columns(splats.means, sizes)
    for node in range(len(tree) - 1):
        above = tree.parents[node]
        assert columns["node_size"][node] == sizes[node] and columns["parent_size"][node] == sizes[above]
        assert [columns[f"parent_{axis}"][node] for axis in "xyz"] == splats.means[above].tolist()
    assert columns["parent_size"][-1] == np.float32(ABOVE_ROOT)


def test_cuts_of_a_file_are_proper(tmp_path):
    """Identify drawn splats of both levels by colour: one on each path to a leaf."""
    rng = np.random.default_rng(1)
    tree = random_tree(rng, 300)
    splats = nodes(rng, len(tree))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    above, leaves = tree.levels(splats)
    assert (above.number, leaves.number) == (1, 2) and len(above.splats) == 299 and len(leaves.splats) == 300
    assert sorted(leaves.splats.sh[:, 0, 0]) == list(range(300))
    for level in (above, leaves):  # coarse to fine
        assert (np.diff(np.floor(np.log2(level.splats.extras["parent_size"]))) <= 0).all()
    write_bundle(tmp_path / "a.ply", Bundle("tree", [above, leaves], "cut"))
    bundle = read_bundle(tmp_path / "a.ply")
    drawn = []
    for position in (np.zeros(3), np.array([40.0, 3, 1]), np.array([3e3, 0, 0]), splats.means[7]):
        for pixels in (0.5, 8, 60):
            selected = select_levels(bundle, position, 500.0, resolve_controls(bundle, {"pixels": pixels}))
            result = np.concatenate([first.splats.sh[:, 0, 0] for first in selected]).astype(int)
            assert all(first.weights is None for first in selected)
            visible = np.zeros(len(tree), bool)
            visible[result] = True
            for leaf in range(300):
                path, node = [], leaf
                while node >= 0:
                    path.append(node)
                    node = tree.parents[node]
                assert visible[path].sum() == 1
            drawn.append(len(result))
    assert min(drawn) == 1 and max(drawn) == 300


def test_complete_levels_are_complete_scenes(tmp_path):
    rng = np.random.default_rng(4)
    tree = random_tree(rng, 9000)
    splats = nodes(rng, len(tree))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    splats.extras["own"] = np.arange(len(tree), dtype=np.float32)
    bundle = Bundle("tree", tree.levels(splats), "cut", controls={"pixels": 2.0}, meta={"seed": 3})
    result = rules()["cut"].complete_levels(bundle)
    counts = [len(level.splats) for level in result.levels]
    assert len(counts) == 3 and counts[2] == 9000 and counts[1] <= 2250 and 500 <= counts[0] <= counts[1] / 4
    assert counts[1] > 1000 and [level.number for level in result.levels] == [1, 2, 3]
    sizes = tree.sizes(splats.means, splats.log_scales)
    for level in result.levels:
        visible = np.zeros(len(tree), bool)
        visible[level.splats.sh[:, 0, 0].astype(int)] = True
        covered = visible.copy()  # drawn itself or covered by one ancestor
        for layer in tree.layers:
            below = tree.children[layer - tree.leaves]
            assert not (covered[layer][:, None] & visible[below]).any()
            covered[below] |= covered[layer][:, None]
        assert covered[: tree.leaves].all() and sizes[visible].max() <= level.facts["s_min"]
        assert list(level.splats.extras) == ["own"]
    write_folder(tmp_path, result)
    reread = read_folder(tmp_path)
    assert (reread.rule, reread.controls) == ("bands", {"gamma": 2.0, "first": 1}) and reread.meta == {
        "seed": 3
    }
    near, far = (
        select_levels(reread, np.full(3, distance), 100.0, resolve_controls(reread, {}))
        for distance in (0.0, 1e6)
    )
    assert [len(first.splats) for first in far] == [counts[0], 0, 0] and len(near[2].splats) > 0


def test_leaf_only_columns_draw_all_leaves():
    means, columns = np.zeros((5, 3), np.float32), leaf_only_columns(5)
    assert rules()["cut"].weights(means, np.ones(3), 100.0, columns, {}, {"pixels": 16.0}).all()
    rng = np.random.default_rng(0)
    splats = nodes(rng, 5)
    splats.extras |= columns
    bundle = Bundle("tree", [Level(2, splats)], "cut")
    assert len(select_levels(bundle, np.zeros(3), 10.0, resolve_controls(bundle, {}))[0].splats) == 5
