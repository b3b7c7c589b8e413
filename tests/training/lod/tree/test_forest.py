"""Forests: the same tree, and the same file, as the tree in one piece."""

from itertools import count

import numpy as np
import pytest

from training.lod.rule import rules
from training.lod.selection import BundleSelector, resolve_controls, select_levels
from training.lod.tree import paging
from training.lod.tree.forest import build_levels, max_subtree_leaves, merge_forest, split_tree
from training.lod.tree.paging import TreeFile
from training.lod.tree.shape import Tree
from training.methods.tree.build import build
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle

from .test_shape import nodes
from .trees import page_table, random_leaves, random_tree

CUT = rules()["cut"]
FOCAL = 1000.0


def tagged(seed, leaves):
    """Return a tree with node numbers in a column."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves)
    splats = nodes(rng, len(tree))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    return splats, tree


def families(splats, tree):
    """Return the tags of each inner node's children, by its own tag."""
    tags = splats.sh[:, 0, 0].astype(int)
    return {tags[tree.leaves + i]: set(tags[pair].tolist()) for i, pair in enumerate(tree.children)}


@pytest.mark.parametrize("leaves", [2, 3, 50, 700])
@pytest.mark.parametrize("longest", [1, 2, 9, 1000])
def test_pieces_form_the_tree(leaves, longest):
    splats, tree = tagged(leaves, leaves)
    forest = split_tree(splats, tree, longest)
    above, upper = forest.upper
    assert upper.leaves == len(forest.subtrees) and len(above) == upper.leaves - 1
    of_tree = families(splats, tree)
    result, roots = {}, []
    for piece, subtree in forest:
        assert len(piece) == len(subtree) and subtree.leaves <= longest
        result |= families(piece, subtree)
        roots.append(int(piece.sh[-1, 0, 0]))
    tags = [*roots, *above.sh[:, 0, 0].astype(int).tolist()]
    for i, pair in enumerate(upper.children):
        result[tags[upper.leaves + i]] = {tags[child] for child in pair}
    assert result == of_tree
    assert tags[-1] == len(tree) - 1  # the root is the last one
    parents = {child: parent for parent, pair in of_tree.items() for child in pair}
    for root in roots:  # pieces are as large as possible
        assert root == len(tree) - 1 or tree.leaves_below[parents[root]] > longest
    full, reread = merge_forest(forest)
    assert families(full, reread) == of_tree and reread.parents[-1] == -1
    assert sorted(full.sh[: reread.leaves, 0, 0]) == list(range(leaves))
    assert split_tree(full, reread, longest).upper[1].children.tolist() == upper.children.tolist()


def test_upper_tree_and_subtrees_have_similar_sizes():
    assert [max_subtree_leaves(leaves) for leaves in (1, 2, 5000, 5_000_000)] == [1, 1, 49, 1581]


@pytest.mark.parametrize(("leaves", "longest"), [(2, 1), (2, 2), (900, 1), (3000, 40), (900, 1000)])
def test_file_of_a_forest_equals_that_of_the_tree(tmp_path, leaves, longest):
    splats, tree = tagged(1, leaves)
    forest = split_tree(splats, tree, longest)
    levels, table = build_levels(forest, tmp_path)
    write_bundle(tmp_path / "pieces.ply", Bundle("tree", levels, "cut", tables={"blocks": table}))
    expected = Tree.levels(*reversed(merge_forest(forest)))
    matched = page_table({level.number: level.splats.extras for level in expected})
    write_bundle(tmp_path / "whole.ply", Bundle("tree", expected, "cut", tables={"blocks": matched}))
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pieces.ply", "whole.ply"]


def test_cuts_of_a_forest_file_are_proper(tmp_path):
    """One node, identified by tag, on each path to a leaf: sizes are consistent between pieces."""
    splats, tree = tagged(2, 400)
    levels, _ = build_levels(split_tree(splats, tree, 7), tmp_path)
    write_bundle(tmp_path / "a.ply", Bundle("tree", levels, "cut"))
    bundle, drawn = read_bundle(tmp_path / "a.ply"), []
    for position in (np.zeros(3), np.array([40.0, 3, 1]), np.array([3e3, 0, 0]), splats.means[7]):
        for pixels in (0.5, 4, 15, 60):
            selected = select_levels(bundle, position, 500.0, resolve_controls(bundle, {"pixels": pixels}))
            visible = np.zeros(len(tree), bool)
            visible[np.concatenate([first.splats.sh[:, 0, 0] for first in selected]).astype(int)] = True
            for node in range(400):
                path = [node]
                for _ in count():
                    if tree.parents[path[-1]] < 0:
                        break
                    path.append(tree.parents[path[-1]])
                assert visible[path].sum() == 1
            drawn.append(visible.sum())
    assert min(drawn) == 1 and max(drawn) == 400


def with_twins():
    """A tree over splats with duplicates: some six times, one 2,000 times; with node numbers."""
    rng = np.random.default_rng(3)
    leaves = random_leaves(700, rng)
    splats, tree = build(leaves.select(np.append(np.repeat(np.arange(700), 6), np.zeros(2000, int))))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    return splats, tree


def read_back(folder, forest):
    """Write a forest's levels to a.ply and read them."""
    levels, table = build_levels(forest, folder)
    write_bundle(folder / "a.ply", Bundle("tree", levels, "cut", tables={"blocks": table}))
    return read_bundle(folder / "a.ply").levels


@pytest.mark.parametrize(
    ("longest", "budget"), [(40, 2000), (10**6, 2000), pytest.param(40, 10**6, marks=pytest.mark.nightly)]
)
def test_equal_splats_are_paged_correctly(tmp_path, longest, budget, monkeypatch):
    """One node on each path to a leaf is drawn while pages arrive; finally the full cut."""
    monkeypatch.setattr(paging, "PAGES_PER_UPDATE", 2)
    splats, tree = with_twins()
    full = BundleSelector(Bundle("tree", read_back(tmp_path, split_tree(splats, tree, longest)), "cut"))
    pager = TreeFile(tmp_path / "a.ply").pager(budget)
    tags, means = np.zeros(pager.rows, int), np.zeros((pager.rows, 3), np.float32)
    columns = {name: np.zeros(pager.rows, np.float32) for name in CUT.columns}

    def drawn(position, pixels):
        result = tags[CUT.weights(means, position, FOCAL, columns, {}, {"pixels": pixels}) > 0]
        times = np.bincount(result, minlength=len(tree))
        for layer in tree.layers:
            times[tree.children[layer - tree.leaves]] += times[layer][:, None]
        assert (times[: tree.leaves] == 1).all()
        return np.sort(result)

    for position in (np.float32([0, 0, 3]), np.float32([-8, 8, 1]), splats.means[0], np.float32([60, 0, 20])):
        for pixels in (30.0, 1.0):
            while (update := pager.step(position, FOCAL / pixels)) is not None:
                for begin, page in update.pages:
                    rows = slice(begin, begin + len(page))
                    tags[rows], means[rows] = page.sh[:, 0, 0], page.means
                    for name in CUT.columns[2:]:
                        columns[name][rows] = page.extras[name]
                columns |= update.columns
                drawn(position, pixels)
            if budget > len(tree):
                selected = full.weights(position, FOCAL, {"pixels": pixels}) > 0
                np.testing.assert_array_equal(
                    drawn(position, pixels), np.sort(full.splats.sh[selected, 0, 0])
                )


def test_equal_splats_are_unchanged_and_sizes_are_unique(tmp_path):
    splats, tree = with_twins()
    inner, leaves = (level.splats for level in read_back(tmp_path, split_tree(splats, tree, 40)))
    of_leaves = np.argsort(leaves.sh[:, 0, 0])
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(leaves, name)[of_leaves], getattr(splats, name)[: tree.leaves])
    assert not leaves.extras["node_size"].any()
    sizes = np.zeros(len(tree))
    sizes[inner.sh[:, 0, 0].astype(int)] = inner.extras["node_size"]
    means = splats.means.astype(float)
    distance = np.linalg.norm(means[tree.children] - means[tree.leaves :, None], axis=2)
    assert (sizes[tree.leaves :, None] >= (sizes[tree.children] + distance / 8) * (1 + 2**-20)).all()
    minimum = tree.sizes(splats.means, splats.log_scales)[tree.leaves :]
    assert (sizes[tree.leaves :] >= minimum).all() and (sizes[tree.leaves :] <= minimum * 1.01).all()
    matched = np.column_stack([inner.extras["node_size"], inner.means])
    assert len(np.unique(matched, axis=0)) == len(matched)
