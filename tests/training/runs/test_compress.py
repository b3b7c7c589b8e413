"""Compression of runs: significance worked by hand, the codebook against known clusters, and the command."""

import shutil
from dataclasses import replace
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.training.conftest import WIDTH
from training.__main__ import main
from training.editing.export import Compression
from training.rasterize import Gaussians, contributions, rasterize
from training.runs import compress as module
from training.runs.compress import compress, distill, make_codebook, shrink_levels, significance
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.cameras import Camera, look_at
from training.scenes.colmap import read_scene
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import SH_C0, Splats
from training.splats.level_folder import write_folder
from training.splats.levels import NO_SPLATS, Bundle, Level
from training.splats.ply import write_ply


def spheres(means, radius, logit=3.0, colors=0.5, degree=0) -> Splats:
    count = len(means)
    sh = np.zeros((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (np.asarray(colors) - 0.5) / SH_C0
    return Splats(
        np.asarray(means, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.broadcast_to(np.log(np.asarray(radius, np.float32)).reshape(-1, 1), (count, 3)).copy(),
        np.broadcast_to(np.float32(logit), count).copy(),
        sh,
    )


@pytest.fixture(scope="module")
def splats(tiny_scene) -> Splats:
    """The points of the tiny scene as opaque spheres, with colours that depend on the direction."""
    model = read_scene(tiny_scene)
    result = spheres(model.points, 0.12, colors=model.point_colors / 255, degree=1)
    result.sh[:, 1:] = 0.1 * np.random.default_rng(3).normal(size=result.sh[:, 1:].shape)
    return result


@pytest.fixture
def run(tmp_path, tiny_scene, splats):
    """A finished run of two levels whose coarser one has a minimum size."""
    folder = RunFolder(tmp_path / "run")
    folder.create()
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    values = {"scene": str(scene), "out": str(folder.path), "image_scale": 1.0, "test_every": 4}
    Job.from_dict(values | {"backend": "cpu"}).write(folder.job)
    splats = replace(splats, extras={"row": np.arange(len(splats), dtype="u2")})
    levels = [Level(1, splats.select(slice(0, 20)), {"s_min": 0.1}), Level(2, splats, {"s_min": 0.0})]
    write_bundle(folder.bundle, Bundle("flod", levels, "bands", controls={"gamma": 2.0}))
    return folder.path


def test_significance_of_two_splats_in_a_line():
    """Opacities a and b, standard deviations p and q in pixels, the first in front. Over the pixels, a
    Gaussian sums to 2π a p², and the product of two to 2π a b p² q² / (p² + q²), which hides the second."""
    camera = Camera("view", 128, 128, 100.0, 100.0, 64.0, 64.0, np.eye(4))
    pair = spheres([(0, 0, 2), (0, 0, 4)], (0.2, 0.6), logit=np.float32([0, 1]))
    a, b = 1 / 2, 1 / (1 + np.exp(-1))
    p2, q2 = (100 * 0.2 / 2) ** 2 + 0.3, (100 * 0.6 / 4) ** 2 + 0.3
    front, behind = 2 * pi * a * p2, 2 * pi * (b * q2 - a * b * p2 * q2 / (p2 + q2))
    total = contributions(Gaussians.of(pair), [camera], backend="cpu").total.numpy()
    np.testing.assert_allclose(total, [front, behind], rtol=0.03)  # alphas under 1/255 are not drawn
    # volumes are as 1 to 27; their 90 % quantile is 1 + 0.9 · 26
    expected = [front * (1 / 24.4) ** 0.1, behind]
    np.testing.assert_allclose(significance(pair, np.array([front, behind])), expected, rtol=1e-6)


def test_codebook_of_known_clusters():
    """Splats of two levels around 4 centres: each gets a set near its own centre."""
    rng = np.random.default_rng(0)
    centers = 10 * np.eye(4, 9, dtype=np.float32).reshape(4, 3, 3)
    labels = np.arange(1024) % 4
    all_splats = spheres(rng.normal(size=(1024, 3)), 0.1, degree=1)
    all_splats.sh[:, 1:] = centers[labels] + 0.01 * rng.normal(size=(1024, 3, 3))
    levels = [Level(1, all_splats.select(slice(0, 80))), Level(3, all_splats.select(slice(80, None)))]
    book = make_codebook(Bundle("flod", levels), 32)
    codes = np.concatenate([book.codes[1], book.codes[3]])
    np.testing.assert_allclose(book.sets[codes], centers[labels], atol=0.05)
    assert len(make_codebook(Bundle("flod", levels[:1]), 8).sets) == 80 // 32  # few splats, few sets
    flat = Bundle("flod", [Level(1, spheres(np.zeros((40, 3)), 0.1))])
    assert make_codebook(flat, 8).sets.shape == (1, 0, 3)


def test_sets_favour_significant_splats():
    """One set for two groups of splats is the mean of the group with all significance."""
    pair = spheres(np.zeros((64, 3)), 0.1, degree=1)
    pair.sh[:32, 1:], pair.sh[32:, 1:] = 1, -1
    weights = np.repeat([1.0, 0.0], 32)
    book = make_codebook(Bundle("", [Level(1, pair)]), 1, weights)
    np.testing.assert_allclose(book.sets, 1)


def test_pruned_splats_are_the_least_significant_in_the_training_views(run, tmp_path, monkeypatch):
    bundle = read_bundle(RunFolder(run).bundle)
    measured, views = [], []

    def spy(gaussians, cameras, **options):
        cameras = list(cameras)
        views.append([(camera.name, camera.width) for camera in cameras])
        measured.append(contributions(gaussians, cameras, **options))
        return measured[-1]

    monkeypatch.setattr(module, "contributions", spy)
    report = compress(run, tmp_path / "small.ply", Compression(prune=0.25, distill_steps=0))
    result = read_bundle(tmp_path / "small.ply")
    names = sorted(camera.name for camera in read_scene(tmp_path / "scene").cameras)
    width = WIDTH + 2 * WIDTH // 2  # of a photo with the margins of the draft, half its width each
    assert views == [[(name, width) for i, name in enumerate(names) if i % 4]] * 2
    assert (result.rule, result.controls) == (bundle.rule, bundle.controls)
    for level, given, measure in zip(result.levels, bundle.levels, measured, strict=True):
        count = len(given.splats) - int(0.25 * len(given.splats))
        scores = significance(given.splats, measure.total.numpy())
        assert (level.facts, len(level.splats)) == (given.facts, count)
        rows = given.splats.extras["row"][np.sort(np.argsort(scores)[-count:])]
        assert scores[level.splats.extras["row"]].min() >= np.sort(scores)[-count]
        assert list(level.splats.extras) == ["row"] and len(rows) == count
    assert f"level 1: 15 of 20 splats\nlevel 2: {count} of {len(given.splats)} splats\n" in report
    assert report.endswith("than a PLY")


def test_defaults_keep_levels_whose_splats_are_all_significant():
    """Held-out views of 400 similar spheres: a level that shows photos with 34.5 dB loses under 0.7 dB."""
    rng = np.random.default_rng(0)
    means = np.column_stack([rng.uniform(-end, end, 400) for end in (2, 1.5, 0.2)])
    radii = 0.12 * np.exp(0.1 * rng.normal(size=400))
    level = spheres(means, radii, logit=rng.normal(0.5, 0.2, 400), colors=rng.random((400, 3)))

    def views(positions):
        poses = [look_at(np.array([*position, -3]), np.zeros(3), (0, -1, 0)) for position in positions]
        return [Camera(f"{n}", 64, 48, 50.0, 50.0, 32.0, 24.0, pose) for n, pose in enumerate(poses)]

    data = SimpleNamespace(train=views([(-0.6, 0), (0, 0), (0.6, 0)]), near=0.01)
    (small,) = shrink_levels(Bundle("flod", [Level(1, level)]), data, Compression(), 0.0, "cpu").levels
    held_out = views([(x, 0.3) for x in (-0.9, -0.3, 0.3, 0.9)])
    before, after = (
        torch.stack([rasterize(Gaussians.of(s), view, backend="cpu").image for view in held_out])
        for s in (level, small.splats)
    )
    error = float(((after - before) ** 2).mean())
    assert 10 * np.log10(1 + error / 10**-3.45) < 0.7


def test_distillation_approaches_the_original_and_keeps_minimum_sizes(tiny_scene, splats):
    views = [camera for camera in read_scene(tiny_scene).cameras][:3]
    student = replace(splats, opacity_logits=splats.opacity_logits - 2)
    student.sh = np.ascontiguousarray(student.sh[:, :1])
    result = distill(student, splats, views, 30, backend="cpu", near=0.01, antialias=False)
    rendered = [
        [rasterize(Gaussians.of(x), view, backend="cpu").image for view in views]
        for x in (splats, student, result)
    ]
    original, before, after = (torch.stack(images) for images in rendered)
    assert ((after - original) ** 2).mean() < 0.6 * ((before - original) ** 2).mean()
    assert result.log_scales.min() >= student.log_scales.min()
    np.testing.assert_array_equal(result.means, student.means)
    again = distill(student, splats, views, 30, backend="cpu", near=0.01, antialias=False)
    np.testing.assert_allclose(again.sh, result.sh, atol=1e-5)


def test_command(run, tmp_path, splats, capsys):
    """Of a run with a lower degree, of a file with the views of a run, and of a file alone."""
    small = tmp_path / "small.ply"
    arguments = ["--out", str(small), "--distill-steps", "2", "--prune", "0.5"]
    assert main(["compress", str(run), *arguments, "--sh-degree", "0"]) == 0
    assert [len(level.splats) for level in read_bundle(small).levels] == [10, -(-len(splats) // 2)]
    assert read_bundle(small).levels[0].splats.sh.shape[1] == 1
    plain = tmp_path / "plain.ply"
    write_ply(plain, splats)
    assert main(["compress", str(plain), *arguments, "--run", str(run)]) == 0
    assert len(read_bundle(small).levels[0].splats) == -(-len(splats) // 2)
    capsys.readouterr()
    assert main(["compress", str(plain), *arguments]) == 0
    assert "none are removed, because it has no training views" in capsys.readouterr().err
    assert len(read_bundle(small).levels[0].splats) == len(splats)


def test_levels_of_several_degrees_need_a_common_one(tmp_path, splats, capsys):
    """A folder of levels may come from other programs."""
    write_folder(tmp_path / "levels", Bundle("", [Level(1, splats), Level(2, splats)]))
    write_ply(tmp_path / "levels" / "lod1.ply", replace(splats, sh=splats.sh[:, :1]))
    arguments = ["compress", str(tmp_path / "levels"), "--out", str(tmp_path / "a.ply")]
    assert main(arguments) == 2
    assert "different degrees [0, 1]" in capsys.readouterr().err
    assert main([*arguments, "--sh-degree", "0"]) == 0


@pytest.mark.parametrize(
    ("source", "out", "words", "message"),
    [
        ("run", "run/bundle.ply", (), "bundle.ply: it is the source"),
        ("missing", "a.ply", (), "missing"),
        ("run", "a.spz", (), "compressed bundles are PLY files"),
        ("run", "a.ply", ("--prune", "2"), "prune = 2.0 is invalid"),
        ("empty.ply", "a.ply", (), "it has no splats"),
    ],
)
def test_mistakes_give_one_sentence(run, tmp_path, capsys, source, out, words, message):
    write_ply(tmp_path / "empty.ply", NO_SPLATS)
    assert main(["compress", str(tmp_path / source), "--out", str(tmp_path / out), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("size", "plain", "text"),
    [
        (70_000, 1_000_000, "0.07 MB, 93.0% smaller than a PLY"),
        (16_000, 10_000, "0.02 MB, 60.0% larger than a PLY"),  # the codebook of a tiny file
    ],
)
def test_sizes_are_described_as_smaller_or_larger(size, plain, text):
    assert module.describe_size(size, plain) == text
