"""Clutter found and left out, against places made for it, loops in Python, and what rules chose before."""

from collections import deque

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, surfaces, tree_of, write_in_pages
from training.__main__ import main
from training.editing.cleaning import (
    Cleaning,
    TreeRelations,
    clean_bundle,
    find_far,
    find_floaters,
    find_unseen,
    keep_splats,
)
from training.errors import LodgsError
from training.lod.crop import Crop, crop_mask
from training.lod.partial_read import BLOCKS, block_table, read_part
from training.lod.query import LodQuery, SplatSelector
from training.lod.rule import OPACITY, collect_facts, rules
from training.lod.selection import resolve_controls, select_levels
from training.lod.tree.paging import TreeFile, read_budgeted
from training.lod.tree.resident import COLUMNS, ResidentTree
from training.scenes.cameras import Camera, look_at
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level

NOT_TREES = sorted(rules().keys() - {"cut"})


def some_splats(rng, count, columns=()):
    return Splats(
        means=rng.normal(0, 4, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-2, 0.7, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0, 2, count).astype(np.float32),
        sh=rng.normal(size=(count, 4, 3)).astype(np.float32),
        extras={"row": np.arange(count, dtype=np.int32)}
        | {name: np.floor(rng.uniform(0, 8, count)).astype(np.float32) for name in columns},
    )


def bundle_of(name, rng):
    """Levels for a rule, with facts and a table of its own."""
    rule, count = rules()[name], 3
    columns = [column for column in rule.columns if column != OPACITY]
    levels = [
        Level(
            number, some_splats(rng, 700 * number, columns),
            {fact: 2.0 * (count - number) for fact in rule.level_facts},
        )
        for number in range(1, count + 1)
    ]  # fmt: skip
    tables = {}
    for table in rule.tables:
        column = {axis: rng.normal(0, 4, 3).astype(np.float32) for axis in "xyz"}
        tables[table] = column | {"radius": np.float32([5, 6, 7])}
    if name == "chunks":
        tables[BLOCKS] = block_table(rule, {level.number: level.splats for level in levels})
    facts = dict.fromkeys(rule.scene_facts, 5.0)
    if "tau" in facts:
        facts["tau"] = 0.004
    return Bundle("any", levels, name, facts, cumulative=rule.cumulative, tables=tables)


def turned(rng):
    """A rotation (3, 3)."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("shape", ["BOX", "SPHERE"])
def test_a_turned_crop_holds_what_was_put_in_it(shape):
    rng = np.random.default_rng(0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned(rng) * (2.0, 0.5, 3.0), (4, -3, 7)
    own = rng.uniform(-2, 2, (5000, 3))
    away = np.abs(own).max(axis=1) if shape == "BOX" else np.linalg.norm(own, axis=1)
    clear = np.abs(away - 1) > 1e-4
    means = (own @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    np.testing.assert_array_equal(Crop.from_matrix(shape, matrix).contains(means)[clear], (away <= 1)[clear])


def test_a_flat_crop_holds_nothing_and_what_is_cut_out_goes_from_what_is_kept():
    means = np.float32([[0, 0, 0], [2, 0, 0], [9, 0, 0], [2, 0.5, 0]])
    flat = Crop.from_matrix("BOX", np.diag([1.0, 1, 0, 1]))
    assert not flat.contains(means).any()
    one, other = Crop.sphere((0, 0, 0), 1), Crop.box((1, -1, -1), (3, 1, 1))
    np.testing.assert_array_equal(crop_mask([one, other], means), [True, True, False, True])
    np.testing.assert_array_equal(
        crop_mask([one, other, Crop.sphere((2, 0, 0), 0.2, True)], means), [True, False, False, True]
    )
    np.testing.assert_array_equal(
        crop_mask([Crop.sphere((0, 0, 0), 1, True)], means), [False, True, True, True]
    )
    assert crop_mask([], means).all()


def naive_floaters(means, gap, most):
    """The same by a queue over cells."""
    low = np.median(means, axis=0)
    cells = {}
    for number, mean in enumerate(means):
        cells.setdefault(tuple(np.floor((mean - low) / np.float32(gap)).astype(int)), []).append(number)
    found, left = np.zeros(len(means), bool), set(cells)
    while left:
        queue, members = deque([left.pop()]), []
        while queue:
            x, y, z = cell = queue.popleft()
            members += cells[cell]
            around = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
            queue.extend(around & left)
            left -= around
        found[members] = len(members) <= most
    return found


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_has_no_end_is_no_crop(value):
    """It would hold nothing, and leave nothing."""
    for shape, *told in ((Crop.box, (0, 0, -1), (1, value, 1)), (Crop.sphere, (value, 0, 0), 1),
                         (Crop.sphere, (0, 0, 0), value)):  # fmt: skip
        with pytest.raises(LodgsError, match="no end"):
            shape(*told)


def test_floaters_are_those_that_were_planted():
    rng = np.random.default_rng(1)
    ground = rng.uniform(-5, 5, (20_000, 3)) * (1, 1, 0.01)
    planted = np.concatenate(
        [rng.normal((0, 0, 3), 0.02, (12, 3)), rng.normal((-4, 2, 6), 0.02, (5, 3)), [[1, 1, -9]]]
    )
    means = np.concatenate([ground, planted]).astype(np.float32)
    order = rng.permutation(len(means))
    found = find_floaters(means[order])
    np.testing.assert_array_equal(found, order >= len(ground))
    np.testing.assert_array_equal(found, find_floaters(means[order]))


@pytest.mark.parametrize("seed", range(5))
def test_floaters_are_small_clusters_of_touching_cells(seed):
    rng = np.random.default_rng(seed)
    means = (rng.normal(0, 1, (600, 3)) * rng.uniform(0.2, 3, (600, 1))).astype(np.float32)
    means[0] = 1e9  # beyond all cells that are told apart
    np.testing.assert_array_equal(find_floaters(means, 0.5, 0.02), naive_floaters(means, 0.5, 12))


def test_far_and_unseen_ask_every_camera():
    rng = np.random.default_rng(2)
    means = rng.normal(0, 5, (400, 3)).astype(np.float32)
    eyes = rng.normal(0, 4, (6, 3))
    cameras = [
        Camera("", 80, 60, 70, 75, 41, 29, look_at(eye, eye + rng.normal(size=3), (0, 0, 1))) for eye in eyes
    ]
    away = np.array([[np.linalg.norm(mean - eye) for eye in eyes] for mean in means]).min(axis=1)
    np.testing.assert_array_equal(find_far(means, eyes, 4.0), away > 4)
    seen = sum(camera.sees(means.astype(np.float64)).astype(int) for camera in cameras)
    for least in (1, 2, 3):
        np.testing.assert_array_equal(find_unseen(means, cameras, least), seen < least)


@pytest.mark.parametrize("name", NOT_TREES)
def test_what_is_left_is_chosen_as_before(name):
    rng = np.random.default_rng(3)
    bundle = bundle_of(name, rng)
    crop = Crop.sphere((1, 0, -1), 4.0)
    found = clean_bundle(bundle, Cleaning((crop,), max_size=0.4, min_opacity=0.05))
    values = resolve_controls(bundle, {})
    for _ in range(5):
        eye = rng.normal(0, 4, 3)
        before, after = (select_levels(one, eye, 3.0, values) for one in (bundle, found))
        for one, other in zip(before, after, strict=True):
            splats = one.splats
            stays = np.linalg.norm(splats.means.astype(np.float64) - (1, 0, -1), axis=1) <= 4
            stays &= np.exp(splats.log_scales).max(axis=1) <= 0.4
            stays &= 1 / (1 + np.exp(-splats.opacity_logits)) >= 0.05
            np.testing.assert_array_equal(other.splats.extras["row"], splats.extras["row"][stays])
            weights = [np.ones(len(x.splats)) if x.weights is None else x.weights for x in (one, other)]
            np.testing.assert_array_equal(weights[1], weights[0][stays])


@pytest.mark.parametrize("name", NOT_TREES)
def test_a_choice_with_crops_is_the_rule_of_what_they_leave(name):
    rng = np.random.default_rng(4)
    bundle, rule = bundle_of(name, rng), rules()[name]
    numbered = [(level.number, level.facts) for level in bundle.levels]
    crops = (Crop.sphere((0, 0, 0), 5.0), Crop.box((-1, -1, -1), (2, 2, 2), True))
    for level in bundle.levels:
        splats = level.splats
        columns = {**splats.extras, OPACITY: 1 / (1 + np.exp(-splats.opacity_logits))}
        columns["hidden"] = (splats.extras["row"] % 3 == 0).astype(np.float32)
        stays = crop_mask(crops, splats.means) & (splats.extras["row"] % 3 > 0)
        choice = LodQuery(
            name, (1.0, 2.0, 3.0), 3.0,
            tuple(collect_facts(rule, bundle.facts, numbered, level.number).items()),
            tuple(resolve_controls(bundle, {}).items()), crops=crops,
        )  # fmt: skip
        rest = {key: column[stays] for key, column in columns.items()}
        wanted = rule.weights(
            splats.means[stays], np.float32([1, 2, 3]), 3.0, rest, dict(choice.facts), dict(choice.values)
        )
        rows, weights = SplatSelector(splats.means, columns, splats.log_scales).chosen(choice)
        np.testing.assert_array_equal(rows, np.flatnonzero(stays)[wanted > 0])
        np.testing.assert_array_equal(weights, wanted[wanted > 0])
    alone, _ = SplatSelector(splats.means, columns).chosen(LodQuery.from_crops(crops))
    np.testing.assert_array_equal(alone, np.flatnonzero(stays))


def drawn_for_each_leaf(tree, eye, focal):
    """How many of a leaf and the nodes above it an eye is shown, by parents known by size and place."""
    splats = Splats.concatenated([level.splats for level in tree.levels])
    columns = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    standing = ResidentTree(columns)
    inner, reached = standing.update(np.arange(len(splats)))
    assert reached.all()  # every other node has two children
    weights = rules()["cut"].weights(
        splats.means, np.float32(eye), focal, {name: columns[name] for name in COLUMNS}, {}, {"pixels": 1.0}
    )
    leaves = np.flatnonzero(~inner)
    count, node = np.zeros(len(leaves)), leaves
    while (node >= 0).any():
        count += np.where(node >= 0, weights[node], 0)
        node = np.where(node >= 0, standing.parents[node], -1)
    return splats.means[leaves], count


def test_a_tree_that_was_cropped_is_one_still():
    rng = np.random.default_rng(5)
    tree = tree_of(surfaces(3000))
    crop = Crop.box((-4, -6, -2), (6, 3, 4))
    found = clean_bundle(tree, Cleaning((crop,)))
    leaves = tree.levels[1].splats.means
    stays = ((leaves >= (-4, -6, -2)) & (leaves <= (6, 3, 4))).all(axis=1)
    np.testing.assert_array_equal(found.levels[1].splats.means, leaves[stays])
    assert len(found.levels[0].splats) == stays.sum() - 1
    for focal in (1e6, 300.0, 30.0, 8.0):
        means, count = drawn_for_each_leaf(found, rng.normal(0, 8, 3), focal)
        assert len(means) == stays.sum() and (count == 1).all()


def test_nodes_of_a_tree_go_when_all_their_leaves_do():
    tree = tree_of(random_leaves(200, np.random.default_rng(6)))
    masks = {1: np.ones(199, bool), 2: np.arange(200) < 130}
    stays, family = TreeRelations.of(tree).with_ancestors(masks), TreeRelations.of(tree)
    splats = Splats.concatenated([level.splats for level in tree.levels])
    place = {(size, *mean): i for i, (size, mean) in enumerate(
        zip(splats.extras["node_size"].tolist(), splats.means.tolist(), strict=True))}  # fmt: skip
    alive = set()
    for leaf in range(199, 199 + 130):
        node = leaf
        while node is not None:
            alive.add(node)
            names = ("parent_size", "parent_x", "parent_y", "parent_z")
            key = [splats.extras[name][node].item() for name in names]
            node = place.get(tuple(key)) if splats.extras["parent_size"][node] < 1e38 else None
    np.testing.assert_array_equal(np.flatnonzero(np.concatenate([stays[1], stays[2]])), sorted(alive))
    assert (family.leaves[2]).all() and not family.leaves[1].any()


def test_a_cropped_tree_in_a_file_is_read_in_pages(tmp_path):
    tree = tree_of(random_leaves(4000, np.random.default_rng(7)))
    write_in_pages(tmp_path / "tree.ply", tree)
    out = tmp_path / "cropped.ply"
    arguments = ["--crop-sphere", "2", "-1", "0", "5", "--min-opacity", "0.5"]
    assert main(["edit", str(tmp_path / "tree.ply"), "--out", str(out), *arguments]) == 0
    whole = read_bundle(tmp_path / "tree.ply")
    in_memory = clean_bundle(whole, Cleaning((Crop.sphere((2, -1, 0), 5),), min_opacity=0.5))
    there = read_bundle(out)
    for one, other in zip(in_memory.levels, there.levels, strict=True):
        np.testing.assert_array_equal(one.splats.means, other.splats.means)
        for name in COLUMNS:
            np.testing.assert_array_equal(one.splats.extras[name], other.splats.extras[name])
    np.testing.assert_equal(there.tables[BLOCKS], in_memory.tables[BLOCKS])

    file = TreeFile(out)
    choice = LodQuery("cut", (1.0, 2.0, 3.0), 400.0, (), (("pixels", 2.0),))
    wanted = select_levels(there, np.float32(choice.eye), 400.0, {"pixels": 2.0})
    for one in wanted:
        cut = file.cut(choice)[one.number]
        assert sorted(map(tuple, cut.means)) == sorted(map(tuple, one.splats.means))
    top, total = read_budgeted(out, 1024)
    assert total == sum(len(level.splats) for level in there.levels)
    _, count = drawn_for_each_leaf(top, (0, 0, 0), 1e5)
    assert (count == 1).all()


def test_blocks_of_chunks_follow(tmp_path):
    bundle = bundle_of("chunks", np.random.default_rng(8))
    write_bundle(tmp_path / "all.ply", bundle)
    crop = ["--crop-box", "-3", "-3", "-3", "4", "4", "4"]
    assert main(["edit", str(tmp_path / "all.ply"), "--out", str(tmp_path / "some.ply"), *crop]) == 0
    found = read_bundle(tmp_path / "some.ply")
    levels = {level.number: level.splats for level in found.levels}
    np.testing.assert_equal(found.tables[BLOCKS], block_table(rules()["chunks"], levels))
    part, _ = read_part(tmp_path / "some.ply", [3], (1,))
    member = found.levels[2].splats.extras["chunks_0"].astype(int) & 2 != 0
    np.testing.assert_array_equal(part.levels[2].splats.means, found.levels[2].splats.means[member])


def test_a_folder_of_levels_stays_one_and_counts_are_printed(tmp_path, capsys):
    bundle = bundle_of("octree", np.random.default_rng(9))
    write_folder(tmp_path / "all", bundle)
    arguments = ["--crop-sphere", "0", "0", "0", "4", "--keep", "outside", "--drop-floaters", "--gap", "2"]
    assert main(["edit", str(tmp_path / "all"), "--out", str(tmp_path / "some"), *arguments]) == 0
    found, stays = read_folder(tmp_path / "some"), []
    for level in bundle.levels:
        stays.append(np.linalg.norm(level.splats.means, axis=1) > 4)
    means = np.concatenate([x.splats.means[stay] for x, stay in zip(bundle.levels, stays, strict=True)])
    floating = naive_floaters(means, 2.0, 0.001 * len(means))
    np.testing.assert_array_equal(
        np.concatenate([level.splats.means for level in found.levels]), means[~floating]
    )
    printed = capsys.readouterr().out
    for level, before in zip(found.levels, bundle.levels, strict=True):
        assert f"level {level.number}: {len(level.splats):,} of {len(before.splats):,} splats" in printed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--crop-box", *"000001"], "flat"),
        (["--crop-sphere", *"0000"], "radius"),
        (["--max-size", "0"], "Nothing is left"),
        (["--min-opacity", "-1"], "--min-opacity cannot be -1"),
        (["--min-views", "1"], "--scene"),
        (["--out", "all.ply"], "another name"),
    ],
)
def test_what_cannot_be_is_said(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    write_bundle("all.ply", bundle_of("bands", np.random.default_rng(10)))
    assert main(["edit", "all.ply", "--out", "out.ply", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out.ply").exists()


def test_tables_of_an_unknown_rule_are_left_alone():
    bundle = Bundle("new", [Level(1, some_splats(np.random.default_rng(0), 9))], "newer", tables={"x": {}})
    with pytest.raises(LodgsError, match="newer"):
        keep_splats(bundle, {1: np.arange(9) < 5})
