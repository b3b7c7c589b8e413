"""Benchmark of quality over training time: its runs, points, plot, and rejected options."""

import json
import subprocess
from types import SimpleNamespace

import pytest

from tools import bench_quality
from training.errors import LodgsError
from training.methods import METHODS


def bench(*arguments) -> int:
    """Run the tool in this process; return its exit code."""
    try:
        return bench_quality.main([str(argument) for argument in arguments])
    except SystemExit as error:
        return int(error.code or 0)


@pytest.mark.slow
@pytest.mark.nightly
def test_each_run_gives_a_point_and_is_reused(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_quality, "_version", lambda checkout: "v")
    options = "--methods", "3dgs", "--shares", "0.001", "0.002", "--image-scale", "1", "--out", tmp_path
    assert bench(tiny_scene, *options) == 0
    points = json.loads((tmp_path / "quality.json").read_text())
    assert [(p["method"], p["version"], p["share"]) for p in points] == [
        ("3dgs", "this", 0.001), ("3dgs", "this", 0.002)
    ]  # fmt: skip
    assert all(p["psnr"] > 3 and p["seconds"] > 0 and 0 <= p["veil"] <= 1 for p in points)
    assert (tmp_path / "quality.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "levels.png").read_bytes()[:4] == b"\x89PNG"
    run = next(tmp_path.glob("tiny-3dgs-this-0.001-*"))
    job = (run / "job.toml").read_text()
    assert "validation = true" in job and "steps = 3\n" in job
    events = (run / "events.jsonl").read_bytes()
    assert bench(tiny_scene, *options) == 0
    assert (run / "events.jsonl").read_bytes() == events


def test_levels_are_listed_with_their_merges():
    rows = [
        {"level": 1, "splats": 20, "by_size": [20.0, 21.0, 22.0, 23.0], "merged": [19.0, 18.0, 17.0, 16.0]},
        {"level": 2, "splats": 40, "by_size": [30.0, 31.0, 32.0, 33.0]},
    ]
    point = bench_quality.Point("a", "flod", "this", 0.5, 0, *[30.0] * 6, 0, 40, 1.5, rows, [])
    names, _, coarse, finest = (line.split(" | ") for line in bench_quality.level_table([point]).splitlines())
    assert dict(zip(names, coarse, strict=True))["merged 1/8"] == "16"
    assert dict(zip(names, finest, strict=True))["1/8"] == "33" and finest[-4:] == [""] * 4


def test_plot_has_levels_selections_and_merges(tmp_path):
    levels = [
        {"splats": 40, "by_size": [30.0, 31.0, 32.0, 33.0]},
        {"splats": 20, "by_size": [20.0, 21.0, 22.0, 23.0], "merged": [19.0, 18.0, 17.0, 16.0]},
    ]
    curve = [{"pixels": 2.0, "splats": 30, "psnr": 25.0, "merged": 24.0}]
    point = bench_quality.Point("a", "tree", "this", 1.0, 0, *[30.0] * 6, 0, 40, 1.5, levels, curve)
    curves = bench_quality.sizes_and_quality(point)
    assert curves == ([(20, 20.0), (30, 25.0), (40, 30.0)], [(20, 19.0), (30, 24.0)])
    bench_quality.plot_levels([point], tmp_path / "levels.png")
    assert (tmp_path / "levels.png").read_bytes()[:4] == b"\x89PNG"


def test_comparison_with_another_checkout_requires_test_views(tiny_scene, tmp_path, capsys):
    assert bench(tiny_scene, "--base", tmp_path) == 2
    assert "--base requires --report" in capsys.readouterr().err


def test_folder_without_the_trainer_is_rejected(tiny_scene, tmp_path, capsys):
    (tmp_path / "training").mkdir()
    assert bench(tiny_scene, "--report", "--base", tmp_path) == 2
    assert f"{tmp_path} is not a checkout" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.nightly
def test_error_of_the_trainer_is_reported(tmp_path, capsys):
    assert bench(tmp_path / "missing", "--methods", "3dgs", "--shares", "0.001", "--out", tmp_path) == 2
    errors = capsys.readouterr().err
    assert "Traceback" not in errors and "missing" in errors


def test_run_with_other_options_is_not_reused(monkeypatch, tmp_path):
    def run(command, **options):
        if command[0] != "git":
            (tmp_path / "out" / "bundle.ply").touch()
        return subprocess.CompletedProcess(command, 0, "this version", "")

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "out").mkdir()
    args = SimpleNamespace(preset="draft", image_scale=1.0, set=[], report=True)
    for _ in range(2):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, "3dgs", 0.5, 0, args)
    args.image_scale = 0.5
    with pytest.raises(LodgsError, match="other options"):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, "3dgs", 0.5, 0, args)


@pytest.mark.parametrize(
    "options", [["--shares", "nan"], ["--shares", "0"], ["--report", "--base", "/missing"]]
)
def test_invalid_options_are_rejected(options, tmp_path, capsys):
    assert bench(tmp_path, *options) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_share_scales_all_steps(monkeypatch, tmp_path):
    changes = []

    def run(command, **options):
        changes.extend(word for word in command if word.startswith("--set="))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    args = SimpleNamespace(preset="draft", image_scale=1.0, set=[], report=True)
    for method in ("lodge", "flod"):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, method, 0.5, 0, args)
    lodge, flod = (METHODS[name].preset("draft") for name in ("lodge", "flod"))
    assert changes == [
        f"--set=steps={lodge.steps // 2}",
        f"--set=tune_steps={lodge.tune_steps // 2}",
        f"--set=steps={[steps // 2 for steps in flod.steps]}",
    ]


def test_failed_import_of_a_checkout_is_reported_in_a_line(monkeypatch, tmp_path):
    error = "Traceback (most recent call last):\n  ...\nModuleNotFoundError: No module named 'gsplat'\n"
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 1, "", error))
    args = SimpleNamespace(preset="draft", image_scale=1.0, set=[], report=True)
    with pytest.raises(LodgsError, match="No module named 'gsplat'") as raised:
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, "3dgs", 0.5, 0, args)
    assert "Traceback" not in str(raised.value)
