"""Other kinds of files. What splat-transform makes of ours, and we of its, where it is installed."""

import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import (
    FORMATS,
    PROGRAM,
    STREAMED,
    as_ply,
    format_of,
    read_splat,
    run,
    write_splat,
    write_splats,
    write_streamed,
)
from training.splats.gaussians import SH_C0, Splats
from training.splats.level_folder import read_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import read_ply

HERE = Path(__file__).parents[3] / "build" / "interop" / "node_modules" / ".bin"
"""Where ``make interop`` has npm put it."""


@pytest.fixture
def theirs(monkeypatch):
    monkeypatch.setenv("PATH", f"{HERE}{os.pathsep}{os.environ['PATH']}")
    if not shutil.which(PROGRAM):
        pytest.skip("splat-transform is not installed; make interop installs it, where Node.js is")


def splats_of(count, degree=0, seed=0):
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.standard_normal(shape, dtype=np.float32)

    sh = 0.3 * normal(count, (degree + 1) ** 2, 3)
    return Splats(normal(count, 3), normal(count, 4), normal(count, 3) - 3, 2 * normal(count), sh)


def finish(work):
    for _ in work:
        pass


def alike(found, splats, shifts=1e-2, scales=0.1, opacities=0.02, colours=0.05):
    """Whether splats in any order are the same but for what compression loses."""
    order = np.lexsort(np.round(splats.means, 1).T)
    nearest = [np.linalg.norm(found.means - mean, axis=1).argmin() for mean in splats.means[order]]
    assert len(set(nearest)) == len(splats)
    found, splats = found.select(np.array(nearest)), splats.select(order)
    assert np.abs(found.means - splats.means).max() < shifts
    assert np.abs(found.log_scales - splats.log_scales).max() < scales
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    other = found.quats / np.linalg.norm(found.quats, axis=1, keepdims=True)
    assert np.abs((unit * other).sum(1)).min() > 0.999
    seen, was = (1 / (1 + np.exp(-each.opacity_logits)) for each in (found, splats))
    assert np.abs(seen - was).max() < opacities
    # SOG has 256 colours for all splats: of few, some are far off
    assert np.quantile(np.abs(found.sh[:, 0] - splats.sh[:, 0]), 0.95) < colours


def test_a_row_of_splat_is_what_its_page_says(tmp_path):
    one = Splats(
        np.float32([[1, 2, 3]]), np.float32([[1, -1, 1, 1]]), np.log(np.float32([[0.1, 0.2, 0.3]])),
        np.float32([0]), np.float32([[[0.1 / SH_C0, -0.5 / SH_C0, 1 / SH_C0]]]),
    )  # fmt: skip
    write_splat(tmp_path / "a.splat", one)
    row = struct.unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert np.allclose(row[:6], [1, 2, 3, 0.1, 0.2, 0.3])
    assert row[6:] == (153, 0, 255, 128, 192, 64, 192, 192)


def test_splat_comes_back(tmp_path):
    splats = splats_of(70_000)
    write_splat(tmp_path / "a.splat", splats)
    found = read_splat(tmp_path / "a.splat")
    assert np.array_equal(found.means, splats.means)
    assert np.allclose(found.log_scales, splats.log_scales, atol=1e-5)
    alpha, was = (1 / (1 + np.exp(-each.opacity_logits)) for each in (found, splats))
    assert np.abs(alpha - was).max() <= 0.51 / 255
    inside = np.abs(SH_C0 * splats.sh) < 0.5
    assert np.abs((found.sh - splats.sh) * SH_C0)[inside].max() <= 0.51 / 255


def test_a_splat_file_cut_short_is_one_sentence(tmp_path):
    (tmp_path / "a.splat").write_bytes(bytes(33))
    with pytest.raises(LodgsError, match="no rows of 32"):
        read_splat(tmp_path / "a.splat")


def test_they_read_our_splat(tmp_path, theirs):
    from training.splats.formats import run

    splats = splats_of(300)
    write_splat(tmp_path / "a.splat", splats)
    run([str(tmp_path / "a.splat"), str(tmp_path / "b.ply")])
    alike(read_ply(tmp_path / "b.ply"), splats, colours=6)  # colours beyond 0 and 1 are clipped


@pytest.mark.parametrize("ending", [".spz", ".compressed.ply", ".sog"])
def test_what_they_write_comes_back_alike(tmp_path, theirs, ending):
    splats = splats_of(300, degree=0 if ending == ".sog" else 2)
    finish(write_splats(tmp_path / f"a{ending}", splats, {"antialias": True}))
    if ending != ".sog":  # which takes some kB whatever is in it
        assert (tmp_path / f"a{ending}").stat().st_size < 0.4 * len(splats) * 4 * (
            14 + 3 * splats.sh.shape[1]
        )
    with as_ply(tmp_path / f"a{ending}") as there:
        assert there.name == "a.ply"
        bundle = read_bundle(there)
    alike(bundle.levels[0].splats, splats)
    if ending == ".spz":
        assert bundle.antialias
    assert not there.exists() and {path.name for path in tmp_path.iterdir()} == {f"a{ending}"}


def test_a_compressed_ply_is_known_by_what_is_in_it(tmp_path, theirs):
    finish(write_splats(tmp_path / "a.compressed.ply", splats_of(50), {}))
    (tmp_path / "a.compressed.ply").rename(tmp_path / "b.ply")
    with as_ply(tmp_path / "b.ply") as there:
        assert len(read_ply(there)) == 50


def test_streamed_levels_come_back_with_all_splats(tmp_path, theirs):
    levels = [Level(number, splats_of(100 * number, seed=number)) for number in (1, 2, 3)]
    folder = tmp_path / "web"
    finish(write_streamed(folder, Bundle("flod", levels)))
    with as_ply(folder) as there:
        found = read_folder(there)
    assert [level.number for level in found.levels] == [1, 2, 3]
    for level, before in zip(found.levels, levels, strict=True):
        alike(level.splats, before.splats)
    finish(write_streamed(folder, Bundle("flod", levels[:2])))  # in place of those
    with as_ply(folder / STREAMED) as there:
        assert len(read_folder(there).levels) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"web"}


def test_a_level_that_a_crop_has_emptied_is_not_streamed(tmp_path, theirs):
    levels = [Level(1, splats_of(0)), Level(2, splats_of(200, seed=2)), Level(3, splats_of(300, seed=3))]
    finish(write_streamed(tmp_path / "web", Bundle("flod", levels)))
    with as_ply(tmp_path / "web") as there:
        found = read_folder(there)
    for level, before in zip(found.levels, levels[1:], strict=True):
        alike(level.splats, before.splats)
    with pytest.raises(LodgsError, match="no splats"):
        finish(write_streamed(tmp_path / "none", Bundle("flod", levels[:1])))


def test_streamed_levels_replace_nothing_else(tmp_path, theirs):
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "thesis.txt").touch()
    with pytest.raises(LodgsError, match="holds other files"):
        finish(write_streamed(tmp_path / "web", Bundle("", [Level(1, splats_of(9))])))
    assert (tmp_path / "web" / "thesis.txt").exists()


def test_a_conversion_that_is_stopped_leaves_nothing(tmp_path, theirs):
    work = write_splats(tmp_path / "a.spz", splats_of(300), {})
    next(work)
    work.close()
    assert not list(tmp_path.iterdir())


def test_what_they_cannot_read_is_one_sentence(tmp_path, theirs):
    (tmp_path / "a.spz").write_bytes(b"no splats")
    with pytest.raises(LodgsError, match="splat-transform ended with"), as_ply(tmp_path / "a.spz"):
        pass


def test_without_the_program_it_is_said_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("training.splats.formats._FOLDERS", ())
    with pytest.raises(LodgsError, match="npm install --global @playcanvas/splat-transform"):
        finish(write_splats(tmp_path / "a.spz", splats_of(3), {}))
    finish(write_splats(tmp_path / "a.splat", splats_of(3), {}))
    finish(write_splats(tmp_path / "a.ply", splats_of(3), {}))
    assert {path.name for path in tmp_path.iterdir()} == {"a.splat", "a.ply"}


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """``stand_in(lines)``: a shell script in the program's place, in the current folder; its path."""
    if os.name == "nt":
        pytest.skip("the program that stands in is a shell script")

    def made(lines):
        program = tmp_path / PROGRAM
        program.write_text(f"#!/bin/sh\n{lines}\n")
        program.chmod(0o755)
        return program

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    return made


def test_a_processor_clusters_colours_in_fewer_rounds(stand_in):
    program = stand_in('echo "$*" >> "$0.said"\ncase "$*" in *"-g cpu"*) touch a.sog;; *) exit 1;; esac')
    run(["a.ply", "a.sog"])
    first, second = Path(f"{program}.said").read_text().splitlines()
    assert " -i " not in first and "-g cpu -i 3 a.ply a.sog" in second


def test_a_program_that_writes_nothing_has_failed_whatever_it_returns(stand_in):
    """Older versions of it take some options to mean something else."""
    stand_in("echo No adapters found")
    with pytest.raises(LodgsError, match=r"wrote no file\. Look whether its version is 3"):
        run(["-L", "0", "lod-meta.json", "lod0.ply"])


def test_kinds_are_known_by_name():
    assert [format_of(Path(f"a.b{kind.suffix}".upper())) for kind in FORMATS] == list(FORMATS)
    with pytest.raises(LodgsError, match=r"\.obj"):
        format_of(Path("a.obj"))


def test_sizes_of_kinds_without_compression_are_exact(tmp_path):
    for degree in range(5):
        splats = splats_of(256, degree)
        for kind in FORMATS:
            if kind.suffix == ".ply" or (kind.suffix == ".splat" and degree == 0):
                path = tmp_path / f"a{kind.suffix}"
                finish(write_splats(path, splats, {}))
                header = path.read_bytes().find(b"end_header\n") + 11 if kind.suffix == ".ply" else 0
                assert path.stat().st_size - header == kind.size(256, degree)


@pytest.mark.parametrize("cumulative", [False, True])
def test_one_command_writes_all_forms_alike(tmp_path, monkeypatch, capsys, cumulative):
    levels = [Level(number, splats_of(200 * number, 1, seed=number)) for number in (1, 2)]
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
    out, one, folder = read_bundle("out.ply"), read_ply("one.ply"), read_folder("all")
    kept = [level.splats.select(np.linalg.norm(level.splats.means, axis=1) <= 1) for level in levels]
    want = [2 * each.means @ np.float32([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T + (0, 0, 1) for each in kept]
    for level, other, means in zip(out.levels, folder.levels, want, strict=True):
        assert np.allclose(level.splats.means, means, atol=1e-5)
        assert np.array_equal(level.splats.means, other.splats.means)
    finest = np.concatenate(want) if cumulative else want[-1]
    assert np.allclose(one.means, finest, atol=1e-5)
    assert np.array_equal(read_splat(tmp_path / "one.splat").means, one.means)
    assert np.array_equal(out.up_rotation, np.eye(3))
    assert main(["edit", "in.ply"]) == 2  # nothing to write
