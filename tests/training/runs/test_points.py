"""Training of scenes without points."""

import io
import json
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.training.scenes.walls import write_walls
from training.runs import train as training_loop
from training.runs.cells.plan import read_planned_scene
from training.runs.data import ensure_points
from training.runs.estimate import estimate_findings
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes import triangulate
from training.scenes.check import check_folder
from training.scenes.colmap import read_scene


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_walls(tmp_path_factory.mktemp("walls") / "scene")


def train(scene, out, on_message=lambda message: None):
    """Train a few steps; return the exit code and the messages."""
    messages = []

    class Stream(io.StringIO):
        def write(self, line):
            event = json.loads(line) if line.strip() else {}
            if "message" in event:
                messages.append(event["message"])
                on_message(event["message"])
            return len(line)

    job = Job(
        str(scene), str(out), method="3dgs", image_scale=0.2, test_every=3, backend="cpu",
        parameters={"steps": 8, "match_exposure": False},
    )  # fmt: skip
    return training_loop.train(job, Stream()), messages


@pytest.mark.parametrize("request_stop", [pytest.param("cancel", marks=pytest.mark.nightly), "SIGTERM"])
def test_stop_while_triangulating_then_resume(walls, tmp_path, monkeypatch, request_stop):
    scene = shutil.copytree(walls, tmp_path / "scene", ignore=shutil.ignore_patterns(".*"))
    folder = RunFolder(tmp_path / "run")

    def stop(message):
        if message.startswith("Comparing pair"):
            if request_stop == "cancel":
                folder.request_cancel()
                time.sleep(1000)  # the request interrupts it
            else:
                os.kill(os.getpid(), signal.SIGTERM)

    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as the command does
    try:
        code, messages = train(scene, folder.path, stop)
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert code == training_loop.CANCELLED and folder.state() == "cancelled"
    assert any(message.startswith("Extracting features of photo 0 of 6") for message in messages)
    assert not any((scene / triangulate.CACHE_FOLDER).iterdir())


def test_resumed_run_does_not_repeat_and_has_the_same_bits(walls, tmp_path, monkeypatch):
    code, messages = train(walls, tmp_path / "first")
    assert code == 0 and sum(message.startswith("Triangulated ") for message in messages) == 1
    assert not any("no points" in message for message in messages)
    monkeypatch.setattr(triangulate.pycolmap_process, "run_program", None)
    run = RunFolder(tmp_path / "second")

    def stop(message):
        if message.startswith("Training on"):
            run.request_cancel()
            time.sleep(1000)  # the request interrupts it

    assert train(walls, run.path, stop)[0] == training_loop.CANCELLED
    code, messages = train(walls, run.path)
    assert code == 0 and any(message.startswith("Triangulated ") for message in messages)
    assert run.bundle.read_bytes() == RunFolder(tmp_path / "first").bundle.read_bytes()
    job = Job(str(walls), str(tmp_path / "cells"), method="3dgs", cells="1x1")
    assert len(read_planned_scene(job).points) > triangulate.MIN_POINTS


def test_points_for_an_exposure_are_found_before_training(walls, tmp_path, monkeypatch):
    """The cache has a set of points for each exposure."""
    scene = shutil.copytree(walls, tmp_path / "scene", ignore=shutil.ignore_patterns(".*"))
    monkeypatch.setattr(triangulate.pycolmap_process, "run_program", lambda *_: "stopped by the test.")
    job = Job(str(scene), str(tmp_path / "run"), method="3dgs", exposure=1.5, cells="1x1")
    ensure_points(read_scene(scene), job, RunFolder(tmp_path / "run"), lambda *_, **__: None)
    assert len(read_planned_scene(job).points)
    assert not any("no points" in finding.what for finding in check_folder(scene, exposure=1.5))
    assert "no points" not in estimate_findings(replace(job, cells="", backend="cpu"))[0].what


def test_parts_of_a_read_only_scene_share_the_points(walls, tmp_path, monkeypatch):
    scene_folder = Path(shutil.copytree(walls, tmp_path / "scene", ignore=shutil.ignore_patterns(".*")))
    (scene_folder / triangulate.CACHE_FOLDER).write_text("a file, so that no folder can be created")
    calls = []

    def run_program(*arguments):
        calls.append(arguments)
        return "stopped by the test."

    monkeypatch.setattr(triangulate.pycolmap_process, "run_program", run_program)
    job = Job(str(scene_folder), str(tmp_path / "run"), method="flod", cells="2x1")
    job.write(tmp_path / "run" / "job.toml")
    run = RunFolder(tmp_path / "run")
    for folder in (run, RunFolder(run.coarse), RunFolder(run.blocks / "2"), RunFolder(run.seams / "2")):
        scene = ensure_points(read_scene(scene_folder), job, folder, lambda kind, **values: None)
        assert len(scene.points) == triangulate.RANDOM_POINTS and len(calls) == 1
    other = RunFolder(tmp_path / "blocks" / "1")  # the folder of another run's blocks
    ensure_points(read_scene(scene_folder), job, other, lambda kind, **values: None)
    assert len(calls) == 2 and other.triangulated.is_dir()
