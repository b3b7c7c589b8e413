"""Transformed bundles: every rule selects the same splats, in memory and in files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.training.lod.test_rule import RULES, any_values, bundle_of
from tests.training.lod.tree.trees import page_table, random_tree, surfaces
from training.__main__ import main
from training.editing.clutter import subject_of
from training.editing.placement import transform_bundle, upright_placement
from training.errors import LodgsError
from training.lod.blocks import BLOCKS
from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.lod.selection import BundleSelector, resolve_controls
from training.lod.tree.nodes import streaming_order
from training.lod.tree.paging import TreeFile
from training.lod.tree.shape import Tree
from training.splats.bundle import open_bundle, read_bundle, write_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply
from training.splats.similarity import Similarity

QUARTER = np.array([[0, -2.0, 0, 0], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
"""A rotation by 90 degrees with scale 2, which is exact in float32."""


def tree_bundle(seed: int, leaves: int = 400) -> tuple[Bundle, Tree]:
    """Return a tree with deep and shallow branches; the column ``node`` has node numbers."""
    rng = np.random.default_rng(seed)
    tree, splats = random_tree(rng, leaves), surfaces(2 * leaves - 1)
    splats.extras["node"] = np.arange(len(splats), dtype=np.int32)
    levels = tree.levels(splats)
    table = page_table({level.number: level.splats.extras for level in levels})
    return Bundle("tree", levels, "cut", tables={BLOCKS: table}), tree


def choosable(name: str, seed: int = 0) -> Bundle:
    """Return a bundle for a rule, with its tables."""
    if name == "cut":
        return tree_bundle(seed)[0]
    bundle, rng = bundle_of(name), np.random.default_rng(seed)
    if name == "decay":
        bundle.facts["tau"] = 0.05
    if name == "chunks":
        centres = {axis: rng.normal(0, 4, 5).astype(np.float32) for axis in "xyz"}
        bundle.tables = {"chunks": centres | {"radius": rng.uniform(1, 5, 5).astype(np.float32)}}
        for level in bundle.levels:
            level.splats.extras |= member_columns(rng.random((5, len(level.splats))) < 0.5)
    return bundle


def general(scale: float, distance: float) -> Similarity:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=3).as_matrix()
    matrix[:3, 3] = distance, -distance, 2 * distance
    return Similarity.from_matrix(matrix)


@pytest.mark.parametrize("name", RULES)
def test_exact_transform_preserves_selection(name):
    """Without rounding. Detects lengths and positions that a rule does not declare."""
    bundle, placement, rng = choosable(name), Similarity.from_matrix(QUARTER), np.random.default_rng(1)
    present, selected = transform_bundle(bundle, placement), 0
    original, updated = BundleSelector(bundle), BundleSelector(present)
    for _ in range(40):
        position, focal = np.float32(rng.normal(0, 4, 3)), rng.uniform(1, 90)
        values = resolve_controls(bundle, any_values(rules()[name], rng))
        weights = original.weights(position, focal, values)
        selected += np.count_nonzero(weights)
        np.testing.assert_array_equal(
            updated.weights(placement.transform_points(position), focal, values), weights
        )
    assert 0 < selected < 40 * len(original.splats)


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("scale", [0.013, 7.7])
def test_general_transform_preserves_selection(name, scale):
    """Except for splats at a boundary within float32 rounding."""
    bundle, placement, rng = choosable(name), general(scale, 3 * scale), np.random.default_rng(1)
    present = transform_bundle(bundle, placement)
    original, updated = BundleSelector(bundle), BundleSelector(present)
    for _ in range(20):
        position, focal = np.float32(rng.normal(0, 4, 3)), rng.uniform(1, 90)
        values = resolve_controls(bundle, any_values(rules()[name], rng))
        weights = original.weights(position, focal, values)
        same = np.isclose(
            updated.weights(placement.transform_points(position), focal, values), weights, atol=2e-4
        )
        assert np.count_nonzero(~same) <= 1 + len(same) // 200


@pytest.mark.parametrize("scale,distance", [(1.0, 0.0), (0.3, 5000.0), (7.7, 100.0)])
def test_cuts_of_a_transformed_tree_are_proper(scale, distance):
    """Exactly one node on each path to a leaf is drawn, despite rounding."""
    bundle, tree = tree_bundle(1)
    present, rng = transform_bundle(bundle, general(scale, distance)), np.random.default_rng(2)
    choice = BundleSelector(present)
    nodes, means = choice.splats.extras["node"], choice.splats.means
    for _ in range(200):
        position = means[rng.integers(len(means))] + scale * rng.normal(0, rng.choice([0.1, 3, 30]), 3)
        focal = 10 ** rng.uniform(0, 4)
        selected = np.zeros(len(tree))
        selected[nodes] = choice.weights(position, focal, resolve_controls(present, {}))
        above = selected.copy()
        for layer in tree.layers:
            above[tree.children[layer - tree.leaves]] += above[layer][:, None]
        np.testing.assert_array_equal(above[: tree.leaves], 1)


def test_nodes_of_a_transformed_tree_find_their_parents():
    """Including nodes whose sizes differ only in the last bits, and become equal by rounding."""
    leaves = surfaces(64)
    leaves = leaves.select(np.zeros(64, int))  # all the same
    tree = random_tree(np.random.default_rng(0), 64)
    splats = Splats.concatenated([leaves, leaves.select(slice(63))])
    bundle = Bundle("tree", tree.levels(splats), "cut")
    for scale in (0.61, 1.3, 2.9):
        nodes = transform_bundle(bundle, general(scale, 1.0)).levels[0].splats
        sizes = nodes.extras["node_size"]
        assert len(np.unique(sizes)) == len(sizes) == 63
        for level in transform_bundle(bundle, general(scale, 1.0)).levels:
            above = level.splats.extras["parent_size"]
            assert np.isin(above[above < 3e38], sizes).all()


def test_metadata_is_transformed():
    bundle = choosable("chunks")
    bundle.meta = {
        "camera_center": [1, 0, 0], "view": [[0, 0, 0], [0, 1, 0]], "up_rotation": np.eye(3),
        "median_depth": 4, "focal_px": 100.0, "costs": [{"level": 1, "distances": [1.5, 2]}], "seed": 3,
    }  # fmt: skip
    present = transform_bundle(bundle, Similarity.from_matrix(QUARTER))
    assert present.meta == {
        "camera_center": [0, 2, 0], "view": [[0, 0, 0], [-2, 0, 0]], "median_depth": 8.0,
        "up_rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "focal_px": 100.0,
        "costs": [{"level": 1, "distances": [3.0, 4.0]}], "seed": 3,
    }  # fmt: skip
    np.testing.assert_array_equal(present.tables["chunks"]["radius"], 2 * bundle.tables["chunks"]["radius"])
    np.testing.assert_array_equal(present.tables["chunks"]["y"], 2 * bundle.tables["chunks"]["x"])
    assert [level.facts["d_l"] for level in present.levels] == [2 * x.facts["d_l"] for x in bundle.levels]


@pytest.mark.parametrize("name", RULES)
def test_levels_on_disk_equal_levels_in_memory(name, tmp_path):
    bundle = choosable(name)
    write_bundle(tmp_path / "in.ply", bundle)
    head, rows = open_bundle(tmp_path / "in.ply")
    for level in head.levels:
        level.on_disk = rows[level.number]
    placement = general(1.7, 2.0)
    write_bundle(tmp_path / "out.ply", transform_bundle(head, placement))
    expected, result = transform_bundle(bundle, placement), read_bundle(tmp_path / "out.ply")
    assert (result.rule, result.facts) == (expected.rule, expected.facts)
    for first, second in zip(result.levels, expected.levels, strict=True):
        assert first.facts == second.facts and first.splats.extras.keys() == second.splats.extras.keys()
        for attribute in ("means", "quats", "log_scales", "sh"):
            np.testing.assert_array_equal(getattr(first.splats, attribute), getattr(second.splats, attribute))
        for column in first.splats.extras:
            np.testing.assert_array_equal(first.splats.extras[column], second.splats.extras[column])


def test_transformed_tree_can_be_paged(tmp_path):
    bundle, _ = tree_bundle(1, 3000)
    write_bundle(tmp_path / "t.ply", transform_bundle(bundle, general(2.3, 9.0)))
    file = TreeFile(tmp_path / "t.ply")
    table = file.bundle.tables[BLOCKS]
    del file.bundle.tables[BLOCKS]
    np.testing.assert_equal(file.index().as_table(), table)
    assert (streaming_order(bundle.levels[0].splats.extras)[:5] == np.arange(5)).all()


@pytest.mark.parametrize("options", [["--translate=1e30,0,0"], ["--scale", "1e13"], ["--scale", "1e39"]])
def test_positions_that_no_reader_accepts_are_not_written(tmp_path, capfd, options):
    write_ply(tmp_path / "a.ply", surfaces(20))
    assert main(["edit", str(tmp_path / "a.ply"), "--out", str(tmp_path / "b.ply"), *options]) == 2
    error = capfd.readouterr().err
    assert error.startswith("error: Cannot transform splats: positions would exceed 1e+12.")
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.filterwarnings("error")
def test_infinite_positions_of_columns_give_no_warning():
    bundle, _ = tree_bundle(0)
    columns = bundle.levels[0].splats.extras
    columns["parent_x"][:] = np.inf
    columns["nx"] = columns["ny"] = columns["nz"] = columns["parent_x"]
    moved = transform_bundle(bundle, Similarity.from_angles((10, 20, 30), 1.0, (1, 2, 3)))
    assert np.isfinite(moved.levels[0].splats.means).all()


def test_unknown_rule_is_rejected():
    bundle = Bundle("new", [Level(1, surfaces(5))], "of tomorrow")
    with pytest.raises(LodgsError, match="of tomorrow"):
        transform_bundle(bundle, Similarity.from_matrix(QUARTER))
    bundle.rule = ""
    assert len(transform_bundle(bundle, Similarity.from_matrix(QUARTER)).levels[0].splats) == 5


def test_command_keeps_the_format(tmp_path, capsys):
    """A bundle, a plain PLY with extra columns, and a folder."""
    bundle, folder = choosable("bands"), tmp_path / "levels"
    bundle.meta["up_rotation"] = Rotation.from_euler("x", -90, degrees=True).as_matrix().round(6)
    write_bundle(tmp_path / "b.ply", bundle)
    write_folder(folder, bundle)
    plain = bundle.levels[-1].splats
    plain.extras["mine"] = np.arange(len(plain), dtype=np.float32)
    write_ply(tmp_path / "p.ply", plain, ["SplatRenderMode: mip"])
    placement = Similarity.from_angles((10, 20, 30), 2.0, (-1, 0, 3))
    options = ["--rotate", "10,20,30", "--scale", "2", "--translate=-1,0,3"]
    for name in ("b.ply", "levels", "p.ply"):
        out = tmp_path / f"out_{name}"
        assert main(["edit", str(tmp_path / name), "--out", str(out), *options]) == 0
        assert f"{out}:" in capsys.readouterr().out
        read = read_folder if out.is_dir() else read_bundle
        result, expected = read(out), transform_bundle(read(tmp_path / name), placement)
        assert (result.rule, result.facts, result.meta.keys()) == (
            expected.rule,
            expected.facts,
            expected.meta.keys(),
        )
        for first, second in zip(result.levels, expected.levels, strict=True):
            np.testing.assert_array_equal(first.splats.means, second.splats.means)
            np.testing.assert_array_equal(first.splats.sh, second.splats.sh)
    text = (tmp_path / "out_p.ply").read_bytes()[:4000]
    assert b"lodsplat" not in text and b"property float mine" in text and b"SplatRenderMode: mip" in text
    assert main(["edit", str(tmp_path / "b.ply"), "--out", str(tmp_path / "u.ply"), "--upright"]) == 0
    up = read_bundle(tmp_path / "u.ply")
    np.testing.assert_allclose(up.up_rotation, np.eye(3), atol=1e-6)
    x, y, z = bundle.levels[0].splats.means.T
    np.testing.assert_allclose(up.levels[0].splats.means, np.stack([x, z, -y], axis=1), atol=1e-5)


@pytest.mark.parametrize(
    "options,words",
    [
        (["--scale", "0"], "by 0"),
        (["--matrix", "1,0,0,0,0,2,0,0,0,0,1,0,0,0,0,1"], "stretches"),
        (["--matrix", "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", "--scale", "2"], "Omit --matrix"),
    ],
)
def test_invalid_options_are_reported(tmp_path, capsys, options, words):
    write_bundle(tmp_path / "b.ply", choosable("bands"))
    assert main(["edit", str(tmp_path / "b.ply"), "--out", str(tmp_path / "o.ply"), *options]) == 2
    assert words in capsys.readouterr().err and not (tmp_path / "o.ply").exists()


def test_upright_plain_files_stay_upright(tmp_path):
    """A second time turns nothing, also in a compressed PLY."""
    write_ply(tmp_path / "a.ply", surfaces(40))
    files = [tmp_path / name for name in ("a.ply", "out.ply", "again.ply", "plain.compressed.ply")]
    source, out, again, compressed = map(str, files)
    assert main(["edit", source, "--out", out, "--plain", compressed, "--upright"]) == 0
    assert main(["edit", out, "--out", again, "--upright"]) == 0
    assert files[1].read_bytes() == files[2].read_bytes() and b"lodsplat" not in files[1].read_bytes()[:4000]
    with open_as_ply(files[3]) as ply:
        np.testing.assert_array_equal(read_bundle(ply).up_rotation, np.eye(3))
    assert main(["edit", out, "--out", again, "--rotate", "0,0,30"]) == 0
    np.testing.assert_array_equal(read_bundle(files[2]).up_rotation, np.eye(3))


def test_ground_and_subject_are_those_of_all_levels_that_add_up():
    """The coarse level has the ground, the fine one adds details above it."""
    rng = np.random.default_rng(0)
    ground, details = surfaces(2000), surfaces(200)
    ground.means = np.column_stack([rng.uniform(-5, 5, (2000, 2)), rng.normal(-2, 0.005, 2000)]).astype("f4")
    details.means = rng.normal(0, 0.5, (200, 3)).astype("f4")
    for splats in (ground, details):
        splats.opacity_logits[:] = 3
    bundle = Bundle("", [Level(1, ground), Level(2, details)], cumulative=True)
    bundle.meta["up_rotation"] = np.eye(3).tolist()
    placement = upright_placement(bundle, ground=True)
    np.testing.assert_allclose(placement.translation, (0, 0, 2), atol=0.02)
    assert subject_of(bundle).radius > 3
