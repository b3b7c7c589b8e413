"""The bench of quality runs, measures views that settings may be chosen by, and goes on where it was."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools import bench_quality
from training.errors import LodgsError
from training.methods import METHODS

ROOT = Path(__file__).resolve().parents[2]


def bench(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, ROOT / "tools" / "bench_quality.py", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
def test_a_point_for_every_run_and_a_picture_of_them(tiny_scene, tmp_path):
    options = "--methods", "3dgs", "--shares", "0.001", "0.002", "--image-scale", "1", "--out", tmp_path
    first = bench(tiny_scene, *options)
    assert first.returncode == 0, first.stderr
    points = json.loads((tmp_path / "quality.json").read_text())
    assert [(p["method"], p["version"], p["share"]) for p in points] == [
        ("3dgs", "this", 0.001), ("3dgs", "this", 0.002)
    ]  # fmt: skip
    assert all(p["psnr"] > 3 and p["seconds"] > 0 and 0 <= p["veil"] <= 1 for p in points)
    assert (tmp_path / "quality.png").read_bytes()[:4] == b"\x89PNG"
    run = next(tmp_path.glob("tiny-3dgs-this-0.001-*"))
    assert (
        "validation = true" in (run / "job.toml").read_text()
        and "steps = 3\n" in (run / "job.toml").read_text()
    )
    before = (run / "events.jsonl").read_bytes()
    assert bench(tiny_scene, *options).returncode == 0
    assert (run / "events.jsonl").read_bytes() == before


def test_another_version_is_not_asked_for_views_that_it_may_not_know(tiny_scene, tmp_path):
    refused = bench(tiny_scene, "--base", tmp_path)
    assert refused.returncode == 2 and "--base needs --report" in refused.stderr


@pytest.mark.slow
def test_what_the_trainer_says_is_passed_on(tmp_path):
    refused = bench(tmp_path / "nothing", "--methods", "3dgs", "--shares", "0.001", "--out", tmp_path)
    assert refused.returncode == 2 and "Traceback" not in refused.stderr and "nothing" in refused.stderr


def test_what_was_trained_otherwise_is_not_shown(monkeypatch, tmp_path):
    def run(command, **options):
        if command[0] != "git":
            (tmp_path / "out" / "bundle.ply").touch()
        return subprocess.CompletedProcess(command, 0, "made by this", "")

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "out").mkdir()
    args = SimpleNamespace(preset="draft", image_scale=1.0, set=[], report=True)
    for _ in range(2):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, "3dgs", 0.5, 0, args)
    args.image_scale = 0.5
    with pytest.raises(LodgsError, match="other options"):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, "3dgs", 0.5, 0, args)


@pytest.mark.parametrize(
    "given", [["--shares", "nan"], ["--shares", "0"], ["--report", "--base", "/nowhere"]]
)
def test_impossible_options_are_refused_in_a_sentence(given, tmp_path):
    refused = bench(tmp_path, *given)
    assert refused.returncode == 2 and "Traceback" not in refused.stderr


def test_a_share_is_of_all_steps(monkeypatch, tmp_path):
    said = []

    def run(command, **options):
        said.extend(each for each in command if each.startswith("--set="))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    args = SimpleNamespace(preset="draft", image_scale=1.0, set=[], report=True)
    for method in ("lodge", "flod"):
        bench_quality.train(tmp_path, tmp_path / "out", tmp_path, method, 0.5, 0, args)
    lodge, flod = (METHODS[name].preset("draft") for name in ("lodge", "flod"))
    assert said == [
        f"--set=steps={lodge.steps // 2}",
        f"--set=tune_steps={lodge.tune_steps // 2}",
        f"--set=steps={[each // 2 for each in flod.steps]}",
    ]
