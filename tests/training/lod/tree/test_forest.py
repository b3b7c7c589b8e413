"""A tree in pieces: the same tree, and the same file of it, as in one."""

from itertools import count

import numpy as np
import pytest

from training.lod.rule import rules
from training.lod.selection import BundleSelector, resolve_controls, select_levels
from training.lod.tree import paging
from training.lod.tree.forest import build_levels, max_subtree_leaves, merge_forest, split_tree
from training.lod.tree.pages import page_table
from training.lod.tree.paging import Pager
from training.lod.tree.shape import Tree
from training.methods.tree.build import build
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle

from .test_shape import nodes
from .trees import random_leaves, random_tree

CUT = rules()["cut"]
FOCAL = 1000.0


def tagged(seed, leaves):
    """A tree whose nodes bear their numbers."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, leaves)
    splats = nodes(rng, len(tree))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    return splats, tree


def families(splats, tree):
    """By the tag of each node above leaves, the tags of its children."""
    tags = splats.sh[:, 0, 0].astype(int)
    return {tags[tree.leaves + i]: set(tags[pair].tolist()) for i, pair in enumerate(tree.children)}


@pytest.mark.parametrize("leaves", [2, 3, 50, 700])
@pytest.mark.parametrize("longest", [1, 2, 9, 1000])
def test_pieces_are_the_tree(leaves, longest):
    splats, tree = tagged(leaves, leaves)
    forest = split_tree(splats, tree, longest)
    above, upper = forest.upper
    assert upper.leaves == len(forest.subtrees) and len(above) == upper.leaves - 1
    of_tree = families(splats, tree)
    found, roots = {}, []
    for part, own in forest:
        assert len(part) == len(own) and own.leaves <= longest
        found |= families(part, own)
        roots.append(int(part.sh[-1, 0, 0]))
    tags = [*roots, *above.sh[:, 0, 0].astype(int).tolist()]
    for i, pair in enumerate(upper.children):
        found[tags[upper.leaves + i]] = {tags[child] for child in pair}
    assert found == of_tree
    assert tags[-1] == len(tree) - 1  # the root is the last one
    parents = {child: parent for parent, pair in of_tree.items() for child in pair}
    for root in roots:  # none could be larger
        assert root == len(tree) - 1 or tree.leaves_below[parents[root]] > longest
    whole, again = merge_forest(forest)
    assert families(whole, again) == of_tree and again.parents[-1] == -1
    assert sorted(whole.sh[: again.leaves, 0, 0]) == list(range(leaves))
    assert split_tree(whole, again, longest).upper[1].children.tolist() == upper.children.tolist()


def test_upper_tree_and_lists_are_about_as_long():
    assert [max_subtree_leaves(leaves) for leaves in (1, 2, 5000, 5_000_000)] == [1, 1, 49, 1581]


@pytest.mark.parametrize(("leaves", "longest"), [(2, 1), (2, 2), (900, 1), (3000, 40), (900, 1000)])
def test_a_file_of_pieces_is_to_the_byte_the_tree_s(tmp_path, leaves, longest):
    splats, tree = tagged(1, leaves)
    forest = split_tree(splats, tree, longest)
    levels, table = build_levels(forest, tmp_path)
    write_bundle(tmp_path / "pieces.ply", Bundle("tree", levels, "cut", tables={"blocks": table}))
    expected = Tree.levels(*reversed(merge_forest(forest)))
    known = page_table({level.number: level.splats.extras for level in expected})
    write_bundle(tmp_path / "whole.ply", Bundle("tree", expected, "cut", tables={"blocks": known}))
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pieces.ply", "whole.ply"]


def test_cuts_of_a_file_of_pieces_are_proper(tmp_path):
    """One node, traced back by its tag, on each path from a leaf to the root: sizes fit where pieces meet."""
    splats, tree = tagged(2, 400)
    levels, _ = build_levels(split_tree(splats, tree, 7), tmp_path)
    write_bundle(tmp_path / "a.ply", Bundle("tree", levels, "cut"))
    bundle, drawn = read_bundle(tmp_path / "a.ply"), []
    for eye in (np.zeros(3), np.array([40.0, 3, 1]), np.array([3e3, 0, 0]), splats.means[7]):
        for pixels in (0.5, 4, 15, 60):
            shown = select_levels(bundle, eye, 500.0, resolve_controls(bundle, {"pixels": pixels}))
            seen = np.zeros(len(tree), bool)
            seen[np.concatenate([one.splats.sh[:, 0, 0] for one in shown]).astype(int)] = True
            for node in range(400):
                path = [node]
                for _ in count():
                    if tree.parents[path[-1]] < 0:
                        break
                    path.append(tree.parents[path[-1]])
                assert seen[path].sum() == 1
            drawn.append(seen.sum())
    assert min(drawn) == 1 and max(drawn) == 400


def with_twins():
    """A tree over splats some of which are there six times, and one 2,000 times; nodes bear their numbers."""
    rng = np.random.default_rng(3)
    leaves = random_leaves(700, rng)
    splats, tree = build(leaves.select(np.append(np.repeat(np.arange(700), 6), np.zeros(2000, int))))
    splats.sh[:, 0, 0] = np.arange(len(tree))
    return splats, tree


def read_back(folder, forest):
    """A forest's levels, of the file a.ply."""
    levels, table = build_levels(forest, folder)
    write_bundle(folder / "a.ply", Bundle("tree", levels, "cut", tables={"blocks": table}))
    return read_bundle(folder / "a.ply").levels


@pytest.mark.parametrize("budget", [2000, 10**6])
@pytest.mark.parametrize("longest", [40, 10**6])
def test_equal_splats_stream_as_others_do(tmp_path, longest, budget, monkeypatch):
    """One of each leaf and the nodes above it is drawn while pages come in, in the end the whole's cut."""
    monkeypatch.setattr(paging, "PAGES_PER_UPDATE", 2)
    splats, tree = with_twins()
    whole = BundleSelector(Bundle("tree", read_back(tmp_path, split_tree(splats, tree, longest)), "cut"))
    pager = Pager(tmp_path / "a.ply", budget)
    tags, means = np.zeros(pager.rows, int), np.zeros((pager.rows, 3), np.float32)
    columns = {name: np.zeros(pager.rows, np.float32) for name in CUT.columns}

    def drawn(eye, pixels):
        found = tags[CUT.weights(means, eye, FOCAL, columns, {}, {"pixels": pixels}) > 0]
        times = np.bincount(found, minlength=len(tree))
        for layer in tree.layers:
            times[tree.children[layer - tree.leaves]] += times[layer][:, None]
        assert (times[: tree.leaves] == 1).all()
        return np.sort(found)

    for eye in (np.float32([0, 0, 3]), np.float32([-8, 8, 1]), splats.means[0], np.float32([60, 0, 20])):
        for pixels in (30.0, 1.0):
            while (update := pager.step(eye, FOCAL / pixels)) is not None:
                for begin, page in update.pages:
                    rows = slice(begin, begin + len(page))
                    tags[rows], means[rows] = page.sh[:, 0, 0], page.means
                    for name in CUT.columns[2:]:
                        columns[name][rows] = page.extras[name]
                columns["node_size"], columns["parent_size"] = update.sizes
                drawn(eye, pixels)
            if budget > len(tree):
                shown = whole.weights(eye, FOCAL, {"pixels": pixels}) > 0
                np.testing.assert_array_equal(drawn(eye, pixels), np.sort(whole.splats.sh[shown, 0, 0]))


def test_equal_splats_stay_as_they_are_and_sizes_fit(tmp_path):
    splats, tree = with_twins()
    inner, leaves = (level.splats for level in read_back(tmp_path, split_tree(splats, tree, 40)))
    of_leaves = np.argsort(leaves.sh[:, 0, 0])
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(leaves, name)[of_leaves], getattr(splats, name)[: tree.leaves])
    assert not leaves.extras["node_size"].any()
    sizes = np.zeros(len(tree))
    sizes[inner.sh[:, 0, 0].astype(int)] = inner.extras["node_size"]
    means = splats.means.astype(float)
    away = np.linalg.norm(means[tree.children] - means[tree.leaves :, None], axis=2)
    assert (sizes[tree.leaves :, None] >= (sizes[tree.children] + away / 8) * (1 + 2**-20)).all()
    least = tree.sizes(splats.means, splats.log_scales)[tree.leaves :]
    assert (sizes[tree.leaves :] >= least).all() and (sizes[tree.leaves :] <= least * 1.01).all()
    known = np.column_stack([inner.extras["node_size"], inner.means])
    assert len(np.unique(known, axis=0)) == len(known)
