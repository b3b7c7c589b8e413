"""A tree in pieces: the same tree, and the same file of it, as in one."""

from itertools import count

import numpy as np
import pytest

from training.lod.forest import divided, joined, levels_of, longest_of
from training.lod.paging import table_of_pages
from training.lod.selection import select_levels, settings
from training.lod.tree import Tree
from training.splats.bundle import Bundle, read_bundle, write_bundle

from .test_tree import nodes
from .trees import random_tree


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
    forest = divided(splats, tree, longest)
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
    whole, again = joined(forest)
    assert families(whole, again) == of_tree and again.parents[-1] == -1
    assert sorted(whole.sh[: again.leaves, 0, 0]) == list(range(leaves))
    assert divided(whole, again, longest).upper[1].children.tolist() == upper.children.tolist()


def test_upper_tree_and_lists_are_about_as_long():
    assert [longest_of(leaves) for leaves in (1, 2, 5000, 5_000_000)] == [1, 1, 49, 1581]


@pytest.mark.parametrize(("leaves", "longest"), [(2, 1), (2, 2), (900, 1), (3000, 40), (900, 1000)])
def test_a_file_of_pieces_is_to_the_byte_the_tree_s(tmp_path, leaves, longest):
    splats, tree = tagged(1, leaves)
    forest = divided(splats, tree, longest)
    levels, table = levels_of(forest, tmp_path)
    write_bundle(tmp_path / "pieces.ply", Bundle("tree", levels, "cut", tables={"blocks": table}))
    expected = Tree.levels(*reversed(joined(forest)))
    known = table_of_pages({level.number: level.splats.extras for level in expected})
    write_bundle(tmp_path / "whole.ply", Bundle("tree", expected, "cut", tables={"blocks": known}))
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pieces.ply", "whole.ply"]


def test_cuts_of_a_file_of_pieces_are_proper(tmp_path):
    """One node, traced back by its tag, on each path from a leaf to the root: sizes fit where pieces meet."""
    splats, tree = tagged(2, 400)
    levels, _ = levels_of(divided(splats, tree, 7), tmp_path)
    write_bundle(tmp_path / "a.ply", Bundle("tree", levels, "cut"))
    bundle, drawn = read_bundle(tmp_path / "a.ply"), []
    for eye in (np.zeros(3), np.array([40.0, 3, 1]), np.array([3e3, 0, 0]), splats.means[7]):
        for pixels in (0.5, 4, 15, 60):
            shown = select_levels(bundle, eye, 500.0, settings(bundle, {"pixels": pixels}))
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
