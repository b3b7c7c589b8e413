"""Tests of trees built cell by cell, against trees built in one piece."""

from itertools import pairwise

import numpy as np
import pytest

from training.lod.selection import resolve_controls, select_levels
from training.lod.tree.forest import build_levels, merge_forest
from training.methods.tree.build import ForestBuilder, _cell_bounds
from training.splats.bundle import read_bundle, write_bundle
from training.splats.file_rows import open_ply
from training.splats.levels import Bundle
from training.splats.ply import write_ply

from .test_build import covariances, leaves_below, scene


def test_cells_are_boxes_within_limit():
    """Every cell is the set of positions with a common bit prefix, and its parent exceeds the limit."""
    rng = np.random.default_rng(0)
    indices = np.sort(
        np.concatenate([rng.integers(0, 1 << 63, 3000), np.full(90, 12345), rng.integers(0, 4000, 500)])
    ).astype(np.uint64)
    borders = _cell_bounds(indices, 40)
    assert borders[0] == 0 and borders[-1] == len(indices) and (np.diff(borders) > 0).all()
    assert np.diff(borders).max() <= 40
    for begin, end in pairwise(borders):
        shared = 63 - int(indices[begin] ^ indices[end - 1]).bit_length()
        prefix = indices >> np.uint64(63 - shared) if shared else indices * 0
        inside = prefix == prefix[begin]
        assert inside.sum() == end - begin or (indices[inside] == 12345).sum() > 40
    assert _cell_bounds(indices, len(indices)) == [0, len(indices)]
    assert len(_cell_bounds(np.zeros(100, np.uint64), 30)) == 5


@pytest.mark.parametrize("cell", [1, 2, 50, 5000])
def test_nodes_represent_their_leaves(cell):
    leaves = scene(600)
    forest = ForestBuilder(leaves, subtree_leaves=8, cell=cell)
    nodes, tree = merge_forest(forest)
    assert len(nodes) == len(tree) == 1199 and tree.leaves == 600
    assert sorted(leaves_below(tree, len(tree) - 1)) == list(range(600))
    order = np.lexsort(nodes.means[:600].T)
    expected = leaves.select(np.lexsort(leaves.means.T))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):  # leaves are unchanged
        np.testing.assert_array_equal(getattr(nodes, name)[:600][order], getattr(expected, name))
    first, _ = merge_forest(ForestBuilder(leaves))
    np.testing.assert_allclose(nodes.means[-1], first.means[-1], atol=1e-4)  # the root
    np.testing.assert_allclose(covariances(nodes)[-1], covariances(first)[-1], rtol=1e-3)
    np.testing.assert_allclose(nodes.sh[-1], first.sh[-1], atol=1e-4)
    assert nodes.opacity_logits[-1] == pytest.approx(first.opacity_logits[-1], abs=1e-3)


def test_leaves_on_disk_give_the_same_tree(tmp_path, monkeypatch):
    from training.methods.tree import build

    monkeypatch.setattr(build, "_BATCH_ROWS", 700)
    leaves = scene(5000)
    write_ply(tmp_path / "a.ply", leaves)
    (tmp_path / "scratch").mkdir()
    from_file = ForestBuilder(open_ply(tmp_path / "a.ply"), tmp_path / "scratch", cell=300)
    for (first, tree), (second, second_tree) in zip(ForestBuilder(leaves, cell=300), from_file, strict=True):
        np.testing.assert_array_equal(tree.children, second_tree.children)
        np.testing.assert_array_equal(first.sh, second.sh)
        np.testing.assert_array_equal(first.quats, second.quats)
    assert not list((tmp_path / "scratch").iterdir())


def test_cells_have_no_seams():
    """Nearly all nodes equal those of a tree in one piece; the others are as large as cells."""
    leaves = scene(30_000)

    def nodes_of(cell):
        nodes, tree = merge_forest(ForestBuilder(leaves, cell=cell))
        rows = np.concatenate([nodes.means, nodes.log_scales], axis=1)[tree.leaves :]
        return {
            row.tobytes(): int(count)
            for row, count in zip(rows, tree.leaves_below[tree.leaves :], strict=True)
        }

    single, by_cells = nodes_of(1 << 20), nodes_of(2000)
    different = [count for row, count in by_cells.items() if row not in single]
    assert 0 < len(different) < 0.02 * len(single) and np.median(different) > 100


def test_levels_contain_all_nodes(tmp_path):
    leaves = scene(3000)
    levels, table = build_levels(ForestBuilder(leaves, cell=500), tmp_path)
    assert [len(level.rows) for level in levels] == [2999, 3000] and table["level"].tolist() == [1] * 6 + [
        2
    ] * 6
    sizes = levels[0].rows.select(slice(0, 2999)).extras
    assert (sizes["parent_size"] > sizes["node_size"]).all() and (sizes["node_size"] > 0).all()


@pytest.mark.parametrize(
    ("cell", "subtree_leaves"), [pytest.param(1, 1, marks=pytest.mark.nightly), (7, 3), (60, 200)]
)
def test_cuts_of_cells_are_proper(tmp_path, cell, subtree_leaves):
    """Every path from a leaf to the root has one node of the cut, for any camera."""
    leaves = scene(500)
    levels, _ = build_levels(ForestBuilder(leaves, subtree_leaves=subtree_leaves, cell=cell), tmp_path)
    write_bundle(tmp_path / "a.ply", Bundle("tree", levels, "cut"))
    bundle, drawn = read_bundle(tmp_path / "a.ply"), []
    nodes, tree = merge_forest(ForestBuilder(leaves, subtree_leaves=subtree_leaves, cell=cell))

    def keys(splats):
        return [row.tobytes() for row in np.concatenate([splats.means, splats.quats, splats.log_scales], 1)]

    number = {key: node for node, key in enumerate(keys(nodes))}
    assert len(number) == len(tree) == sum(len(level.splats) for level in bundle.levels)
    for position in (np.zeros(3), np.array([30.0, 3, 1]), np.array([900.0, 0, 0]), nodes.means[7]):
        for pixels in (0.5, 4, 15):
            visible = np.zeros(len(tree), bool)
            for level in select_levels(bundle, position, 500.0, resolve_controls(bundle, {"pixels": pixels})):
                visible[[number[key] for key in keys(level.splats)]] = True
            above = np.zeros(len(tree), int)  # number of drawn nodes on the path to the root
            above[-1] = visible[-1]
            for layer in tree.layers:
                children = tree.children[layer - tree.leaves]
                above[children] = above[layer][:, None] + visible[children]
            assert (above[: tree.leaves] == 1).all()
            drawn.append(visible.sum())
    assert min(drawn) < 20 and max(drawn) == 500
