"""Splat files of other programs, exchanged with splat-transform if it is installed."""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.checkout import copy_checkout, recipe_code
from training.__main__ import main
from training.editing.export import export_finest_level, export_levels
from training.errors import LodgsError
from training.splats.bundle import read_bundle, write_bundle
from training.splats.compressed_ply import read_compressed_ply, write_compressed_ply
from training.splats.formats import (
    FORMATS,
    STREAMED_FILE,
    find_format,
    open_as_ply,
    write_splats,
)
from training.splats.formats.splat import SplatFile, write_splat
from training.splats.gaussians import SH_C0, Splats
from training.splats.level_folder import read_folder
from training.splats.levels import NO_SPLATS, Bundle, Level
from training.splats.ply import read_ply
from training.splats.splat_format import NeedsTrainer
from training.splats.streamed_levels import write_streamed_levels


def random_splats(count, degree=0, seed=0):
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.standard_normal(shape, dtype=np.float32)

    sh = 0.3 * normal(count, (degree + 1) ** 2, 3)
    return Splats(normal(count, 3), normal(count, 4), normal(count, 3) - 3, 2 * normal(count), sh)


def assert_similar(actual, splats, shifts=1e-2, scales=0.1, opacities=0.02, colours=0.05):
    """Compare splats in any order, up to losses of compression."""
    order = np.lexsort(np.round(splats.means, 1).T)
    nearest = [np.linalg.norm(actual.means - mean, axis=1).argmin() for mean in splats.means[order]]
    assert len(set(nearest)) == len(splats)
    actual, splats = actual.select(np.array(nearest)), splats.select(order)
    assert np.abs(actual.means - splats.means).max() < shifts
    assert np.abs(actual.log_scales - splats.log_scales).max() < scales
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    actual_unit = actual.quats / np.linalg.norm(actual.quats, axis=1, keepdims=True)
    assert np.abs((unit * actual_unit).sum(1)).min() > 0.999
    actual_opacity, opacity = (1 / (1 + np.exp(-x.opacity_logits)) for x in (actual, splats))
    assert np.abs(actual_opacity - opacity).max() < opacities
    # SOG has 256 colours for all splats, so a few are far off
    assert np.quantile(np.abs(actual.sh[:, 0] - splats.sh[:, 0]), 0.95) < colours


def test_splat_row_matches_its_specification(tmp_path):
    splats = Splats(
        np.float32([[1, 2, 3]]), np.float32([[1, -1, 1, 1]]), np.log(np.float32([[0.1, 0.2, 0.3]])),
        np.float32([0]), np.float32([[[0.1 / SH_C0, -0.5 / SH_C0, 1 / SH_C0]]]),
    )  # fmt: skip
    write_splat(tmp_path / "a.splat", splats, {})
    row = struct.unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert np.allclose(row[:6], [1, 2, 3, 0.1, 0.2, 0.3])
    assert row[6:] == (153, 0, 255, 128, 192, 64, 192, 192)


def test_splat_round_trips(tmp_path):
    splats = random_splats(70_000)
    write_splat(tmp_path / "a.splat", splats, {})
    actual = SplatFile(tmp_path / "a.splat").select(slice(None))
    assert np.array_equal(actual.means, splats.means)
    assert np.allclose(actual.log_scales, splats.log_scales, atol=1e-5)
    actual_opacity, opacity = (1 / (1 + np.exp(-x.opacity_logits)) for x in (actual, splats))
    assert np.abs(actual_opacity - opacity).max() <= 0.51 / 255
    inside = np.abs(SH_C0 * splats.sh) < 0.5
    assert np.abs((actual.sh - splats.sh) * SH_C0)[inside].max() <= 0.51 / 255


def test_truncated_splat_file_raises_one_sentence(tmp_path):
    (tmp_path / "a.splat").write_bytes(bytes(33))
    with pytest.raises(LodgsError, match="not a multiple of 32"):
        SplatFile(tmp_path / "a.splat").select(slice(None))


def test_splat_transform_reads_our_splat(tmp_path, splat_transform):
    splats = random_splats(300)
    write_splat(tmp_path / "a.splat", splats, {})
    splat_transform(tmp_path / "a.splat", tmp_path / "b.ply")
    assert_similar(read_ply(tmp_path / "b.ply"), splats, colours=6)  # colours beyond 0 and 1 are clipped


def test_splat_transform_reads_our_compressed_ply(tmp_path, splat_transform):
    splats = random_splats(300, 3)
    write_compressed_ply(tmp_path / "a.compressed.ply", splats, {"antialias": True})
    splat_transform(tmp_path / "a.compressed.ply", tmp_path / "b.ply")
    theirs, (rows, _) = read_ply(tmp_path / "b.ply"), read_compressed_ply(tmp_path / "a.compressed.ply")
    ours = rows.select(slice(None))
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6)


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".sog"])
def test_converted_files_round_trip(tmp_path, ending):
    splats = random_splats(300, degree=0 if ending == ".sog" else 2)
    write_splats(tmp_path / f"a{ending}", splats, {"antialias": True})
    if ending != ".sog":  # takes some kB even if empty
        assert (tmp_path / f"a{ending}").stat().st_size < 0.4 * len(splats) * 4 * (
            14 + 3 * splats.sh.shape[1]
        )
    with open_as_ply(tmp_path / f"a{ending}") as ply:
        assert ply.name == "a.ply"
        bundle = read_bundle(ply)
    assert_similar(bundle.levels[0].splats, splats)
    if ending == ".spz":
        assert bundle.antialias
    assert not ply.exists() and {path.name for path in tmp_path.iterdir()} == {f"a{ending}"}


def test_compressed_ply_is_detected_by_its_contents(tmp_path):
    write_splats(tmp_path / "a.compressed.ply", random_splats(50), {})
    (tmp_path / "a.compressed.ply").rename(tmp_path / "b.ply")
    with open_as_ply(tmp_path / "b.ply") as ply:
        assert len(read_ply(ply)) == 50


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz", "a.sog", "a.glb", "a.zip"])
def test_wrong_names_are_reported_with_the_right_one(tmp_path, name):
    level = Level(1, random_splats(50))
    for kind in (".ply", ".spz", ".sog"):
        write_splats(tmp_path / f"b{kind}", level.splats, {})
    export_levels(tmp_path / "b.glb", Bundle("", [level]))
    for kind in (".ply", ".spz", ".sog", ".glb"):
        shutil.copy(tmp_path / f"b{kind}", tmp_path / name)
        if name.endswith(kind) or (kind, name) == (".ply", "a.zip"):  # PLY is read under any unknown name
            with open_as_ply(tmp_path / name) as ply:
                assert len(read_bundle(ply).levels[0].splats) == 50
            continue
        remedy = rf"{name}: its format is \w+\. Rename it to {kind}\."
        with pytest.raises(LodgsError, match=remedy), open_as_ply(tmp_path / name) as ply:
            read_bundle(ply)


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("a.ply", b"NGSP\4\0\0\0", r"SPZ\. Rename it to \.spz\."),
        ("a.usda", b"PXR-USDC", r"USD\. Rename it to \.usdc\."),
        ("a.ply", b"#usda 1.0", r"USD\. Rename it to \.usda\."),
        ("tileset.json", b'{"asset": {}, "geometricError": 9}', r"3D Tiles.* Choose one of its \.glb files"),
    ],
)
def test_contents_are_recognised(tmp_path, name, content, remedy):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LodgsError, match=remedy), open_as_ply(tmp_path / name) as ply:
        read_bundle(ply)


def test_streamed_levels_round_trip(tmp_path):
    levels = [Level(number, random_splats(100 * number, seed=number)) for number in (1, 2, 3)]
    folder = tmp_path / "web"
    write_streamed_levels(folder, Bundle("flod", levels))
    with open_as_ply(folder) as plain:
        bundle = read_folder(plain)
    assert [level.number for level in bundle.levels] == [1, 2, 3]
    for level, original in zip(bundle.levels, levels, strict=True):
        assert_similar(level.splats, original.splats)
    write_streamed_levels(folder, Bundle("flod", levels[:2]))  # replaces them
    with open_as_ply(folder / STREAMED_FILE) as plain:
        assert len(read_folder(plain).levels) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"web"}


def test_empty_levels_are_not_streamed(tmp_path):
    levels = [
        Level(1, random_splats(0)),
        Level(2, random_splats(200, seed=2)),
        Level(3, random_splats(300, seed=3)),
    ]
    write_streamed_levels(tmp_path / "web", Bundle("flod", levels))
    with open_as_ply(tmp_path / "web") as plain:
        bundle = read_folder(plain)
    for level, original in zip(bundle.levels, levels[1:], strict=True):
        assert_similar(level.splats, original.splats)
    with pytest.raises(LodgsError, match="contain no splats"):
        write_streamed_levels(tmp_path / "none", Bundle("flod", levels[:1]))


HIGH_DEGREE = [("--plain", "a.spz"), ("--plain", "a.compressed.ply"), ("--plain", "a.sog"),
               ("--levels", "a.glb"), ("--tiles", "tiles"), ("--streamed", "web")]  # fmt: skip


@pytest.mark.parametrize(("option", "name"), HIGH_DEGREE)
def test_error_of_a_high_degree_names_the_command_that_reduces_it(tmp_path, capsys, option, name):
    high, low = str(tmp_path / "a.ply"), str(tmp_path / "b.ply")
    write_bundle(high, Bundle("", [Level(1, random_splats(40, 4))]))
    export = [option, str(tmp_path / name)]
    assert main(["edit", high, *export]) == 2
    assert "lodgs compress --sh-degree 3" in capsys.readouterr().err
    assert main(["compress", high, "--sh-degree", "3", "--out", low]) == 0
    assert main(["edit", low, *export]) == 0


def test_streamed_levels_replace_no_foreign_files(tmp_path):
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "thesis.txt").touch()
    with pytest.raises(LodgsError, match="contains other files"):
        write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, random_splats(9))]))
    assert (tmp_path / "web" / "thesis.txt").exists()
    for _ in range(2):
        write_streamed_levels(tmp_path / "new", Bundle("", [Level(1, random_splats(9))]))
    (tmp_path / "new" / "index.html").touch()
    with pytest.raises(LodgsError, match="contains other files"):
        write_streamed_levels(tmp_path / "new", Bundle("", [Level(1, random_splats(9))]))


@pytest.mark.parametrize("name", ["a.sog", "web"])
def test_missing_package_leaves_the_conversion_to_the_trainer(tmp_path, monkeypatch, name):
    level = Level(1, random_splats(30))
    write_splats(tmp_path / "a.sog", level.splats, {})
    write_streamed_levels(tmp_path / "web", Bundle("flod", [level]))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(NeedsTrainer, match=r"Install the trainer\."), open_as_ply(tmp_path / name):
        pass

    def convert(source, target):
        assert source.name in ("a.sog", STREAMED_FILE)
        write_bundle(target, Bundle("", [level]))

    with open_as_ply(tmp_path / name, convert) as path:
        assert len(read_bundle(path).levels[0].splats) == 30


def test_formats_are_found_by_name():
    assert [find_format(Path(f"a.b{kind.suffix}".upper())) for kind in FORMATS] == list(FORMATS)
    with pytest.raises(LodgsError, match=r"\.obj"):
        find_format(Path("a.obj"))


def test_only_the_smallest_format_of_large_scenes_claims_to_be_it():
    sizes = {kind.suffix: kind.size(10_000_000, 3) for kind in FORMATS if kind.max_degree}
    claims = [kind for kind in FORMATS if "smallest" in kind.about]
    assert [(kind.suffix, "large scenes" in kind.about) for kind in claims] == [
        (min(sizes, key=sizes.get), True)
    ]


def test_sizes_of_uncompressed_formats_are_exact(tmp_path):
    for degree in range(5):
        splats = random_splats(256, degree)
        for kind in FORMATS:
            if kind.suffix == ".ply" or (kind.suffix == ".splat" and degree == 0):
                path = tmp_path / f"a{kind.suffix}"
                write_splats(path, splats, {})
                header = path.read_bytes().find(b"end_header\n") + 11 if kind.suffix == ".ply" else 0
                assert path.stat().st_size - header == kind.size(256, degree)


@pytest.mark.parametrize("cumulative", [False, True])
def test_edit_command_writes_all_formats_alike(tmp_path, monkeypatch, capsys, cumulative):
    levels = [Level(number, random_splats(200 * number, 1, seed=number)) for number in (1, 2)]
    facts = {"d_max": 5.0, "d_max_focal": 300.0} if cumulative else {}
    for level in levels:
        level.splats.extras["lod_bias"] = np.zeros(len(level.splats), np.float32)
    write_bundle(
        tmp_path / "in.ply", Bundle("octree", levels, "octree" if cumulative else "", facts, {}, cumulative)
    )
    command = "edit in.ply --crop-sphere 0 0 0 1 --upright --scale 2 --translate=0,0,1 --out out.ply"
    command += " --plain one.ply --plain one.splat --folder all"
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 0, capsys.readouterr().err
    out, plain, folder = read_bundle("out.ply"), read_ply("one.ply"), read_folder("all")
    cropped = [level.splats.select(np.linalg.norm(level.splats.means, axis=1) <= 1) for level in levels]
    rotation = np.float32([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    expected = [2 * splats.means @ rotation.T + (0, 0, 1) for splats in cropped]
    for level, folder_level, means in zip(out.levels, folder.levels, expected, strict=True):
        assert np.allclose(level.splats.means, means, atol=1e-5)
        assert np.array_equal(level.splats.means, folder_level.splats.means)
    finest = np.concatenate(expected) if cumulative else expected[-1]
    assert np.allclose(plain.means, finest, atol=1e-5)
    assert np.array_equal(SplatFile(tmp_path / "one.splat").select(slice(None)).means, plain.means)
    assert np.array_equal(out.up_rotation, np.eye(3))
    assert main(["edit", "in.ply"]) == 2  # nothing to write


@pytest.mark.parametrize("kind", FORMATS, ids=lambda kind: kind.suffix)
def test_finest_level_without_splats_is_refused(tmp_path, kind):
    bundle = Bundle("", [Level(1, random_splats(9)), Level(2, NO_SPLATS)])
    with pytest.raises(LodgsError, match="the finest level has no splats"):
        export_finest_level(tmp_path / f"a{kind.suffix}", bundle)
    assert not list(tmp_path.iterdir())


def test_recipe_adds_a_format_to_the_command_line(tmp_path):
    copy_checkout(tmp_path, "training")
    (tmp_path / "training/splats/formats/xyz.py").write_text(recipe_code("Add an export format"))
    splats = random_splats(20)
    write_bundle(tmp_path / "in.ply", Bundle("", [Level(1, splats)]))

    def run(*arguments):
        command = [sys.executable, "-m", "training", "edit", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)

    process = run("in.ply", "--plain", "out.xyz")
    assert process.returncode == 0, process.stderr
    np.testing.assert_allclose(np.loadtxt(tmp_path / "out.xyz"), splats.means, rtol=1e-6)
    assert ".xyz" in run("--help").stdout
    assert ".xyz" in run("in.ply", "--plain", "out.abc").stderr


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
def test_splat_file_that_another_program_truncates_is_reported(tmp_path):
    write_splat(tmp_path / "a.splat", random_splats(3000), {})
    rows = SplatFile(tmp_path / "a.splat")
    os.truncate(tmp_path / "a.splat", 3200)
    with pytest.raises(LodgsError, match="another program has truncated it"):
        rows.select(slice(2990, 3000))
