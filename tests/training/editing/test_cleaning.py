"""Clean-up, compared with planted clutter, Python loops, and earlier selections of rules."""

from collections import deque

import numpy as np
import pytest

from tests.training.lod.tree.trees import random_leaves, surfaces, tree_of, write_in_pages
from training.__main__ import main
from training.editing.cleaning import (
    Cleaning,
    clean_bundle,
    find_far,
    find_floaters,
    find_unseen,
    keep_splats,
    read_relations,
    same_rows,
)
from training.errors import LodgsError
from training.lod.blocks import BLOCKS, block_table
from training.lod.crop import Crop, crop_mask
from training.lod.on_disk import open_paged, read_part
from training.lod.query import LodQuery, SplatSelector
from training.lod.rule import OPACITY, collect_facts, rules
from training.lod.selection import resolve_controls, select_levels
from training.lod.tree.nodes import COLUMNS, ResidentTree
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
    """Return levels for a rule, with its facts and tables."""
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
        tables[BLOCKS] = block_table(rule.block_bounds, ((x.number, x.splats.extras) for x in levels))
    facts = dict.fromkeys(rule.scene_facts, 5.0)
    if "tau" in facts:
        facts["tau"] = 0.004
    return Bundle("any", levels, name, facts, cumulative=rule.cumulative, tables=tables)


def random_rotation(rng):
    """Return a random rotation (3, 3)."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("shape", ["BOX", "SPHERE"])
def test_rotated_crop_contains_its_points(shape):
    rng = np.random.default_rng(0)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = random_rotation(rng) * (2.0, 0.5, 3.0), (4, -3, 7)
    local = rng.uniform(-2, 2, (5000, 3))
    distance = np.abs(local).max(axis=1) if shape == "BOX" else np.linalg.norm(local, axis=1)
    clear = np.abs(distance - 1) > 1e-4
    means = (local @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    np.testing.assert_array_equal(
        Crop.from_matrix(shape, matrix).contains(means)[clear], (distance <= 1)[clear]
    )


def test_flat_crops_are_empty_and_outside_crops_subtract():
    means = np.float32([[0, 0, 0], [2, 0, 0], [9, 0, 0], [2, 0.5, 0]])
    flat = Crop.from_matrix("BOX", np.diag([1.0, 1, 0, 1]))
    assert not flat.contains(means).any()
    first, second = Crop.sphere((0, 0, 0), 1), Crop.box((1, -1, -1), (3, 1, 1))
    np.testing.assert_array_equal(crop_mask([first, second], means), [True, True, False, True])
    np.testing.assert_array_equal(
        crop_mask([first, second, Crop.sphere((2, 0, 0), 0.2, True)], means), [True, False, False, True]
    )
    np.testing.assert_array_equal(
        crop_mask([Crop.sphere((0, 0, 0), 1, True)], means), [False, True, True, True]
    )
    assert crop_mask([], means).all()


def naive_floaters(means, gap, limit):
    """Find floaters with a queue over cells."""
    low = np.median(means, axis=0)
    cells = {}
    for number, mean in enumerate(means):
        cells.setdefault(tuple(np.floor((mean - low) / np.float32(gap)).astype(int)), []).append(number)
    result, remaining = np.zeros(len(means), bool), set(cells)
    while remaining:
        queue, members = deque([remaining.pop()]), []
        while queue:
            x, y, z = cell = queue.popleft()
            members += cells[cell]
            around = {(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
            queue.extend(around & remaining)
            remaining -= around
        result[members] = len(members) <= limit
    return result


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_infinite_crops_are_rejected(value):
    """They would remove all splats."""
    for shape, *parts in ((Crop.box, (0, 0, -1), (1, value, 1)), (Crop.sphere, (value, 0, 0), 1),
                         (Crop.sphere, (0, 0, 0), value)):  # fmt: skip
        with pytest.raises(LodgsError, match="infinite"):
            shape(*parts)


def test_finds_planted_floaters():
    rng = np.random.default_rng(1)
    ground = rng.uniform(-5, 5, (20_000, 3)) * (1, 1, 0.01)
    planted = np.concatenate(
        [rng.normal((0, 0, 3), 0.02, (12, 3)), rng.normal((-4, 2, 6), 0.02, (5, 3)), [[1, 1, -9]]]
    )
    means = np.concatenate([ground, planted]).astype(np.float32)
    order = rng.permutation(len(means))
    result = find_floaters(means[order])
    np.testing.assert_array_equal(result, order >= len(ground))
    np.testing.assert_array_equal(result, find_floaters(means[order]))


@pytest.mark.parametrize("seed", range(5))
def test_floaters_are_small_clusters_of_touching_cells(seed):
    rng = np.random.default_rng(seed)
    means = (rng.normal(0, 1, (600, 3)) * rng.uniform(0.2, 3, (600, 1))).astype(np.float32)
    means[0] = 1e9  # beyond all cells
    np.testing.assert_array_equal(find_floaters(means, 0.5, 0.02), naive_floaters(means, 0.5, 12))


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize(("size", "opacity"), [(-2.0, 1.0), (7.0, 1.0), (7.0, -4.0)])
def test_splats_at_one_place_are_no_clutter(count, size, opacity):
    splats = some_splats(np.random.default_rng(0), count)
    splats.means[:], splats.log_scales[:], splats.opacity_logits[:] = 3.0, size, opacity
    bundle = clean_bundle(Bundle("", [Level(1, splats)]), Cleaning(clutter=True))
    assert len(bundle.levels[0].splats) == count


def test_far_and_unseen_use_every_camera():
    rng = np.random.default_rng(2)
    means = rng.normal(0, 5, (400, 3)).astype(np.float32)
    positions = rng.normal(0, 4, (6, 3))
    cameras = [
        Camera("", 80, 60, 70, 75, 41, 29, look_at(position, position + rng.normal(size=3), (0, 0, 1)))
        for position in positions
    ]
    distance = np.array([[np.linalg.norm(mean - position) for position in positions] for mean in means]).min(
        axis=1
    )
    np.testing.assert_array_equal(find_far(means, positions, 4.0), distance > 4)
    visible = sum(camera.sees(means.astype(np.float64)).astype(int) for camera in cameras)
    for minimum in (1, 2, 3):
        np.testing.assert_array_equal(find_unseen(means, cameras, minimum), visible < minimum)


@pytest.mark.parametrize("name", [name for name in NOT_TREES if name != "prefix"])
def test_selection_of_remaining_splats_is_unchanged(name):
    """The rule "prefix" numbers remaining splats again, so that its limits stay exact."""
    rng = np.random.default_rng(3)
    bundle = bundle_of(name, rng)
    crop = Crop.sphere((1, 0, -1), 4.0)
    result = clean_bundle(bundle, Cleaning((crop,), max_size=0.4, min_opacity=0.05))
    values = resolve_controls(bundle, {})
    for _ in range(5):
        position = rng.normal(0, 4, 3)
        original, updated = (select_levels(first, position, 3.0, values) for first in (bundle, result))
        for first, second in zip(original, updated, strict=True):
            splats = first.splats
            remaining = np.linalg.norm(splats.means.astype(np.float64) - (1, 0, -1), axis=1) <= 4
            remaining &= np.exp(splats.log_scales).max(axis=1) <= 0.4
            remaining &= 1 / (1 + np.exp(-splats.opacity_logits)) >= 0.05
            np.testing.assert_array_equal(second.splats.extras["row"], splats.extras["row"][remaining])
            weights = [np.ones(len(x.splats)) if x.weights is None else x.weights for x in (first, second)]
            np.testing.assert_array_equal(weights[1], weights[0][remaining])


@pytest.mark.parametrize("name", NOT_TREES)
def test_query_with_crops_equals_rule_on_cropped_splats(name):
    rng = np.random.default_rng(4)
    bundle, rule = bundle_of(name, rng), rules()[name]
    numbered = [(level.number, level.facts) for level in bundle.levels]
    crops = (Crop.sphere((0, 0, 0), 5.0), Crop.box((-1, -1, -1), (2, 2, 2), True))
    for level in bundle.levels:
        splats = level.splats
        columns = {**splats.extras, OPACITY: 1 / (1 + np.exp(-splats.opacity_logits))}
        columns["hidden"] = (splats.extras["row"] % 3 == 0).astype(np.float32)
        remaining = crop_mask(crops, splats.means) & (splats.extras["row"] % 3 > 0)
        query = LodQuery(
            name, (1.0, 2.0, 3.0), 3.0,
            tuple(collect_facts(rule, bundle.facts, numbered, level.number).items()),
            tuple(resolve_controls(bundle, {}).items()), crops=crops,
        )  # fmt: skip
        remaining_columns = {key: column[remaining] for key, column in columns.items()}
        expected = rule.weights(
            splats.means[remaining],
            np.float32([1, 2, 3]),
            3.0,
            remaining_columns,
            dict(query.facts),
            dict(query.values),
        )
        rows, weights = SplatSelector(splats.means, columns, splats.log_scales).select(query)
        np.testing.assert_array_equal(rows, np.flatnonzero(remaining)[expected > 0])
        np.testing.assert_array_equal(weights, expected[expected > 0])
    single, _ = SplatSelector(splats.means, columns).select(LodQuery.from_crops(crops))
    np.testing.assert_array_equal(single, np.flatnonzero(remaining))


def drawn_for_each_leaf(tree, position, focal):
    """Return the number of drawn nodes on the path to each leaf. Size and position identify parents."""
    splats = Splats.concatenated([level.splats for level in tree.levels])
    columns = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    standing = ResidentTree(columns)
    inner, reached = standing.update(np.arange(len(splats)))
    assert reached.all()  # every other node has two children
    weights = rules()["cut"].weights(
        splats.means,
        np.float32(position),
        focal,
        {name: columns[name] for name in COLUMNS},
        {},
        {"pixels": 1.0},
    )
    leaves = np.flatnonzero(~inner)
    count, node = np.zeros(len(leaves)), leaves
    while (node >= 0).any():
        count += np.where(node >= 0, weights[node], 0)
        node = np.where(node >= 0, standing.parents[node], -1)
    return splats.means[leaves], count


def test_cropped_tree_is_a_valid_tree():
    rng = np.random.default_rng(5)
    tree = tree_of(surfaces(3000))
    crop = Crop.box((-4, -6, -2), (6, 3, 4))
    result = clean_bundle(tree, Cleaning((crop,)))
    leaves = tree.levels[1].splats.means
    remaining = ((leaves >= (-4, -6, -2)) & (leaves <= (6, 3, 4))).all(axis=1)
    np.testing.assert_array_equal(result.levels[1].splats.means, leaves[remaining])
    assert len(result.levels[0].splats) == remaining.sum() - 1
    for focal in (1e6, 300.0, 30.0, 8.0):
        means, count = drawn_for_each_leaf(result, rng.normal(0, 8, 3), focal)
        assert len(means) == remaining.sum() and (count == 1).all()


def test_nodes_are_removed_with_their_last_leaf():
    tree = tree_of(random_leaves(200, np.random.default_rng(6)))
    masks = {1: np.ones(199, bool), 2: np.arange(200) < 130}
    relations = read_relations(tree)
    remaining = relations.completed(masks)
    leaves = relations.testable({1: masks[1], 2: np.ones(200, bool)})
    splats = Splats.concatenated([level.splats for level in tree.levels])
    node_of_key = {(size, *mean): i for i, (size, mean) in enumerate(
        zip(splats.extras["node_size"].tolist(), splats.means.tolist(), strict=True))}  # fmt: skip
    alive = set()
    for leaf in range(199, 199 + 130):
        node = leaf
        while node is not None:
            alive.add(node)
            names = ("parent_size", "parent_x", "parent_y", "parent_z")
            key = [splats.extras[name][node].item() for name in names]
            node = node_of_key.get(tuple(key)) if splats.extras["parent_size"][node] < 1e38 else None
    np.testing.assert_array_equal(np.flatnonzero(np.concatenate([remaining[1], remaining[2]])), sorted(alive))
    assert leaves[2].all() and not leaves[1].any()


def test_cropped_tree_on_disk_can_be_paged(tmp_path):
    tree = tree_of(random_leaves(4000, np.random.default_rng(7)))
    write_in_pages(tmp_path / "tree.ply", tree)
    out = tmp_path / "cropped.ply"
    arguments = ["--crop-sphere", "2", "-1", "0", "5", "--min-opacity", "0.5"]
    assert main(["edit", str(tmp_path / "tree.ply"), "--out", str(out), *arguments]) == 0
    full = read_bundle(tmp_path / "tree.ply")
    in_memory = clean_bundle(full, Cleaning((Crop.sphere((2, -1, 0), 5),), min_opacity=0.5))
    present = read_bundle(out)
    for first, second in zip(in_memory.levels, present.levels, strict=True):
        np.testing.assert_array_equal(first.splats.means, second.splats.means)
        for name in COLUMNS:
            np.testing.assert_array_equal(first.splats.extras[name], second.splats.extras[name])
    np.testing.assert_equal(present.tables[BLOCKS], in_memory.tables[BLOCKS])

    file = open_paged(out)
    query = LodQuery("cut", (1.0, 2.0, 3.0), 400.0, (), (("pixels", 2.0),))
    expected = select_levels(present, np.float32(query.position), 400.0, {"pixels": 2.0})
    for first in expected:
        cut = file.visible(query)[first.number]
        assert sorted(map(tuple, cut.means)) == sorted(map(tuple, first.splats.means))
    top = file.top(1024)
    assert file.total == sum(len(level.splats) for level in present.levels)
    _, count = drawn_for_each_leaf(top, (0, 0, 0), 1e5)
    assert (count == 1).all()


def test_block_table_is_updated(tmp_path):
    bundle = bundle_of("chunks", np.random.default_rng(8))
    write_bundle(tmp_path / "all.ply", bundle)
    crop = ["--crop-box", "-3", "-3", "-3", "4", "4", "4"]
    assert main(["edit", str(tmp_path / "all.ply"), "--out", str(tmp_path / "some.ply"), *crop]) == 0
    result = read_bundle(tmp_path / "some.ply")
    levels = ((level.number, level.splats.extras) for level in result.levels)
    np.testing.assert_equal(result.tables[BLOCKS], block_table(rules()["chunks"].block_bounds, levels))
    partial, _ = read_part(tmp_path / "some.ply", [3], (1,))
    member = result.levels[2].splats.extras["chunks_0"].astype(int) & 2 != 0
    np.testing.assert_array_equal(partial.levels[2].splats.means, result.levels[2].splats.means[member])


def test_folder_stays_a_folder_and_counts_are_printed(tmp_path, capsys):
    bundle = bundle_of("octree", np.random.default_rng(9))
    write_folder(tmp_path / "all", bundle)
    arguments = ["--crop-sphere", "0", "0", "0", "4", "--keep", "outside", "--drop-floaters", "--gap", "2"]
    assert main(["edit", str(tmp_path / "all"), "--out", str(tmp_path / "some"), *arguments]) == 0
    result, masks = read_folder(tmp_path / "some"), []
    for level in bundle.levels:
        masks.append(np.linalg.norm(level.splats.means, axis=1) > 4)
    means = np.concatenate([x.splats.means[mask] for x, mask in zip(bundle.levels, masks, strict=True)])
    floating = naive_floaters(means, 2.0, 0.001 * len(means))
    np.testing.assert_array_equal(
        np.concatenate([level.splats.means for level in result.levels]), means[~floating]
    )
    printed = capsys.readouterr().out
    for level, original in zip(result.levels, bundle.levels, strict=True):
        assert f"level {level.number}: {len(level.splats):,} of {len(original.splats):,} splats" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--crop-box", *"000001"], "flat"),
        (["--crop-sphere", *"0000"], "radius"),
        (["--crop-sphere", *"000", "1e300"], "it is infinite"),
        (["--crop-box", *"00011", "1e300"], "it is infinite"),
        (["--rotate", "inf,0,0"], "an angle or a translation is not a finite number"),
        (["--translate", "nan,0,0"], "an angle or a translation is not a finite number"),
        (["--max-size", "0"], "Cannot edit the splats: none remain"),
        (["--min-opacity", "-1"], "min_opacity = -1.0 is invalid"),
        (["--min-views", "1"], "--scene"),
        (["--keep", "outside"], "--keep outside: it has no effect"),
        (["--antialiased"], "--antialiased: it has no effect"),
        (["--clutter", "--halo-opacity", "0"], "--halo-opacity 0: it has no effect"),
        (["--gap", "1"], "--gap: it has no effect"),
        (["--share", "0.1", "--max-size", "1"], "--share: it has no effect"),
        (["--scene", "."], "--scene: it has no effect"),
        (["--original-place", "--streamed", "web"], "--original-place: it has no effect"),
        (["--lod-errors", "--plain", "a.spz"], "--lod-errors: it has no effect"),
        (["--out", "all.ply"], "all.ply: it is the source"),
        (["--out", "all.sog"], "all.sog: it would be a PLY"),
        (["--plain", "./out.ply"], "out.ply: two outputs have this name"),
        (["--streamed", "web", "--tiles", "web"], "web: two outputs have this name"),
    ],
)
def test_invalid_options_are_reported(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    write_bundle("all.ply", bundle_of("bands", np.random.default_rng(10)))
    assert main(["edit", "all.ply", "--out", "out.ply", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    ("source", "option"), [("a.splat", "--plain"), ("web", "--streamed"), ("web/lod-meta.json", "--streamed")]
)
def test_converted_sources_are_not_overwritten(tmp_path, monkeypatch, capsys, source, option):
    monkeypatch.chdir(tmp_path)
    write_bundle("all.ply", bundle_of("bands", np.random.default_rng(10)))
    assert main(["edit", "all.ply", "--plain", "a.splat", "--streamed", "web"]) == 0
    assert main(["edit", source, option, source.split("/")[0], "--exposure", "1"]) == 2
    assert "it is the source" in capsys.readouterr().err


def test_tables_of_unknown_rules_are_rejected():
    bundle = Bundle("new", [Level(1, some_splats(np.random.default_rng(0), 9))], "newer", tables={"x": {}})
    with pytest.raises(LodgsError, match="newer"):
        keep_splats(bundle, {1: np.arange(9) < 5})


def test_same_rows_are_versions_of_the_same_splats():
    means = np.random.default_rng(0).uniform(0, 1, (1000, 3))  # the box's diagonal is 0.9 * 3**0.5 = 1.56
    moved = means + np.float64([0.015, 0, 0])
    moved[:499] += 100  # fewer than half
    assert same_rows(means, moved)
    assert not same_rows(means, means + np.float64([0.0165, 0, 0]))
    assert not same_rows(means, means[::-1]) and not same_rows(means, means[1:])
    assert not same_rows(means[:0], means[:0])
