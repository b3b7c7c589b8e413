"""Training runs as processes: events, files, resuming and failures."""

import errno
import io
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
import zipfile
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.lod import on_disk
from training.methods import METHODS
from training.runs import train as training_loop
from training.runs.data import training_data
from training.runs.events import EventWriter
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.colmap import read_scene
from training.scenes.orientation import up_rotation
from training.scenes.view_tables import read_view_tables
from training.splats.bundle import read_bundle
from training.splats.levels import NO_SPLATS
from training.splats.ply import read_ply
from training.splats.scratch import ScratchFile

ROOT = Path(__file__).resolve().parents[3]


def run_in_process(keys: dict) -> tuple[int, list[dict]]:
    code = training_loop.train(Job.from_dict(keys))
    return code, RunFolder(keys["out"]).events()[0]


def method_of(keys: dict) -> type:
    return import_module(f"{METHODS[keys['method']].package}.train").Method


def with_steps(keys: dict, total: int) -> dict:
    """Return the job's keys with another total number of steps, a multiple of 3."""
    steps = [total // 3] * 3 if keys["method"] == "flod" else total
    extra = {"finish_share": 0.0} if keys["method"] == "flod" else {}
    return {**keys, "parameters": {**keys["parameters"], "steps": steps, **extra}}


def command(path: Path, keys: dict) -> list[str]:
    path.write_text(json.dumps(keys))
    return [sys.executable, "-m", "training", "train", str(path)]


TINY = {
    "flod": {
        "levels": 3, "steps": [19, 21, 27], "refine_steps": 15, "footprint": 6.0, "densify_interval": 5,
        "prune_interval": 10, "overlap_interval": 10, "sh_interval": 15, "grad_threshold": 1e-5,
        "max_splats": 300, "merge_ratio": 0.05, "random_background": False, "margin": 0.0,
    },
    "octree": {
        "levels": 3, "steps": 70, "footprint": 6.0, "grow_interval": 5, "far_share": 0.2, "sh_interval": 15,
        "grad_threshold": 1e-5, "max_splats": 300, "full_share": 0.1, "random_background": False,
        "levels_from": "anchors",
    },
    "octree_neural": {
        "levels": 3, "steps": 70, "footprint": 6.0, "grow_interval": 5, "far_share": 0.2, "offsets": 3,
        "grad_threshold": 1e-5, "max_splats": 300, "appearance": 4, "sh_degree": 2,
        "random_background": False,
    },
}  # fmt: skip
"""Parameters by method for 70 steps and 3 levels on the tiny scene, which has a black background."""


@pytest.fixture(
    scope="module",
    params=["flod", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("octree", "octree_neural"))],
)
def uninterrupted(request, tiny_scene, tmp_path_factory) -> dict:
    """Keys, output lines and bundle of an uninterrupted run of the tiny job."""
    out = tmp_path_factory.mktemp("uninterrupted")
    keys = {
        "scene": str(tiny_scene), "out": str(out / "run"), "image_scale": 1.0, "test_every": 4,
        "method": request.param, "parameters": TINY[request.param],
    }  # fmt: skip
    stream = io.StringIO()
    assert training_loop.train(Job.from_dict(keys), stream) == 0
    return {
        "keys": keys,
        "lines": stream.getvalue().splitlines(),
        "bundle": (out / "run" / "bundle.ply").read_bytes(),
    }


def test_printed_lines_are_the_stored_events(uninterrupted):
    folder = RunFolder(uninterrupted["keys"]["out"])
    printed = [json.loads(line) for line in uninterrupted["lines"]]
    assert printed == folder.events()[0]
    kinds = [event["event"] for event in printed]
    assert kinds[0] == "hello" and kinds[-1] == "done"
    assert {"train_psnr", "veil", "oversized", "worst"} <= printed[-1].keys()
    assert {event["level"] for event in folder.levels()} == {1, 2, 3}
    assert folder.state() == "done"
    last = folder.last_event("progress")
    assert last is not None and last["step"] == last["of"] == 70


def test_time_left_follows_the_speed_of_the_last_steps(monkeypatch):
    """Steps take 1 s, and 3 s from step 40 of 100 on: the time left is 3 s for each remaining step."""
    now, events = 0.0, []
    monkeypatch.setattr(training_loop, "time", SimpleNamespace(monotonic=lambda: now))
    run = object.__new__(training_loop._TrainingRun)
    run.method = SimpleNamespace(steps=100, levels=1, splats=5, stage=lambda step: "")
    run.events = lambda kind, **values: events.append(values)
    run._speed_start, run.step = (0.0, 0), 0
    while run.step < 100:
        now += 1.0 if run.step < 40 else 3.0
        run.step += 1
        run._report_progress(1, 0.1, 20.0)
    left = {event["step"]: event["eta_s"] for event in events}
    assert left[40] == 60 and left[100] == 0
    assert [left[step] for step in (50, 60, 80)] == [150, 120, 60]


def test_long_runs_report_progress_less_often(monkeypatch):
    """After 500 s, events are at least a thousandth of the elapsed time apart: at most 1000 (1 + ln 6)."""
    now, events, pixels = 0.0, [], torch.zeros(1, 1, 3)
    monkeypatch.setattr(training_loop, "time", SimpleNamespace(monotonic=lambda: now))
    run = object.__new__(training_loop._TrainingRun)

    def train_step(step):
        nonlocal now
        now += 0.5
        return lambda: 0.1, lambda: pixels, SimpleNamespace(image=pixels, mask=None)

    run.method = SimpleNamespace(
        steps=6000, levels=1, splats=5, stage=lambda step: "", level_at=lambda step: 1,
        levels_after=lambda step: [], train_step=train_step,
    )  # fmt: skip
    run.events = lambda kind, **values: events.append(values["step"])
    run.step, run._stopped, run._save = 0, lambda received: False, lambda: None
    assert run.run([])
    assert 2000 < len(events) <= 1000 * (1 + np.log(6)) and events[-1] == 6000


def test_run_without_held_out_views_measures_training_views(tiny_scene, tmp_path):
    keys = {
        "scene": str(tiny_scene), "out": str(tmp_path / "run"), "image_scale": 1.0, "test_every": 0,
        "method": "3dgs", "backend": "cpu", "parameters": {"steps": 5},
    }  # fmt: skip
    code, events = run_in_process(keys)
    assert code == 0
    (level,) = (event for event in events if event["event"] == "level")
    assert "psnr" not in level and level["train_psnr"] == events[-1]["train_psnr"] > 5
    assert "held_out" not in read_bundle(tmp_path / "run" / "bundle.ply").meta
    assert "worst" not in events[-1] and 0 <= events[-1]["veil"]["mean"] <= events[-1]["veil"]["max"] <= 1


def test_bundle_contains_the_levels_and_their_facts(uninterrupted):
    folder = RunFolder(uninterrupted["keys"]["out"])
    bundle = read_bundle(folder.bundle)
    assert [level.number for level in bundle.levels] == [1, 2, 3]
    assert bundle.meta["held_out"] == [0, 4]
    for level, event in zip(bundle.levels, folder.levels(), strict=True):
        stored = read_ply(folder.path / event["path"])
        assert len(level.splats) == event["splats"]
        np.testing.assert_array_equal(level.splats.means, stored.means)
        assert level.splats.extras.keys() == stored.extras.keys()
        assert level.facts == event["facts"]
    upright = up_rotation(read_scene(Path(uninterrupted["keys"]["scene"])).cameras)
    np.testing.assert_allclose(bundle.meta["up_rotation"], upright, atol=1e-6)
    if bundle.method == "flod":
        detail = bundle.levels[0].facts["s_min"] * bundle.meta["focal_px"] / bundle.meta["median_depth"]
        assert bundle.meta["footprint_px"] == pytest.approx(detail) and 0 < detail < 100
    else:
        assert bundle.cumulative and bundle.rule == "octree"
        d_max, focal_px = bundle.facts["d_max"], bundle.facts["d_max_focal"]
        assert bundle.meta["voxel"] * focal_px / d_max == pytest.approx(6.0)


def test_bundle_contains_the_cameras(uninterrupted):
    cameras, near, held_out = read_view_tables(
        read_bundle(RunFolder(uninterrupted["keys"]["out"]).bundle).tables
    )
    scene = read_scene(Path(uninterrupted["keys"]["scene"]))
    assert [camera.name for camera in cameras] == [camera.name for camera in scene.cameras]
    for camera, view in zip(cameras, scene.cameras, strict=True):
        assert np.array_equal(camera.world_to_camera, view.world_to_camera)
        assert (camera.fx, camera.cy, camera.width) == (view.fx, view.cy, view.width)
    assert near == scene.near() and held_out == {view.name for view in scene.split(4)[1]}


def test_training_improves_the_images(uninterrupted):
    """Quality of levels at their first completion; FLoD trains coarser ones again after the finest."""
    levels = [json.loads(line) for line in uninterrupted["lines"] if '"level"' in line]
    finished = {e["level"]: e["psnr"] for e in reversed(levels) if e["event"] == "level"}
    quality = [finished[level] for level in sorted(finished)]
    newest = [event["psnr"] for event in RunFolder(uninterrupted["keys"]["out"]).levels()]
    if uninterrupted["keys"]["method"] != "flod":
        quality = newest  # levels are written again at the end
    assert quality == sorted(quality) and quality[-1] > quality[0] + 0.5
    assert newest[-1] > newest[0] + 0.25


KILLED = """
import os, signal, sys
from tests.training.runs.test_train import method_of
from training.__main__ import run

method, last = method_of({"method": sys.argv[1]}), int(sys.argv[2])
train_step = method.train_step

def dying_step(self, step):
    if step == last:
        os.kill(os.getpid(), signal.SIGKILL)
    return train_step(self, step)

method.train_step = dying_step
sys.argv[1:] = ["train", sys.argv[3]]
run()
"""


@pytest.mark.slow
@pytest.mark.parametrize("step", [*(pytest.param(n, marks=pytest.mark.nightly) for n in (3, 44, 61)), 23])
def test_killed_run_resumes_to_the_same_bits(uninterrupted, tmp_path, step):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    environment = {**os.environ, "LODGS_CHECKPOINT_SECONDS": "0"}  # a checkpoint after every step
    (tmp_path / "job.json").write_text(json.dumps(keys))
    words = [sys.executable, "-c", KILLED, keys["method"], str(step), tmp_path / "job.json"]
    process = subprocess.run(words, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, check=False)
    folder = RunFolder(keys["out"])
    assert process.returncode == -signal.SIGKILL and folder.state() == "interrupted"
    code, events = run_in_process(keys)
    assert code == 0 and folder.state() == "done"
    assert any(f"Resuming at step {step} of 70" in event.get("message", "") for event in events)
    assert folder.bundle.read_bytes() == uninterrupted["bundle"]


@pytest.mark.parametrize("last", [*(pytest.param(n, marks=pytest.mark.nightly) for n in (7, 58)), 33])
def test_cancelled_run_resumes_to_the_same_bits(uninterrupted, tmp_path, monkeypatch, last):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    method = method_of(keys)
    train_step = method.train_step

    def cancelling_step(self, step):
        if step == last:
            folder.request_cancel()
        return train_step(self, step)

    monkeypatch.setattr(method, "train_step", cancelling_step)
    code, events = run_in_process(keys)
    assert code == training_loop.CANCELLED and folder.state() == "cancelled"
    assert events[-1]["event"] == "cancelled" and events[-1]["step"] == last + 1
    monkeypatch.undo()
    keys["photo_memory"] = 1  # megabyte; does not change the result
    assert run_in_process(keys)[0] == 0
    assert Job.from_file(folder.job).photo_memory == 1
    assert folder.bundle.read_bytes() == uninterrupted["bundle"]


def test_run_resumes_with_another_backend(uninterrupted, tmp_path, monkeypatch, fake_card):
    """Simulated cuda backend until the middle of level 2, then the cpu backend."""
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run"), "backend": "cuda"}
    keys = with_steps(keys, 18)
    folder, method = RunFolder(keys["out"]), method_of(keys)
    train_step = method.train_step

    def cancelling_step(self, step):
        if step == 8:
            folder.request_cancel()
        return train_step(self, step)

    monkeypatch.setattr(method, "train_step", cancelling_step)
    code, events = run_in_process(keys)
    assert code == training_loop.CANCELLED
    assert [event["backend"] for event in events if "backend" in event] == ["cuda"]
    monkeypatch.undo()
    code, events = run_in_process({**keys, "backend": "cpu"})
    assert code == 0 and {event["level"] for event in folder.levels()} == {1, 2, 3}
    assert any("Resuming at step 9 of 18" in event.get("message", "") for event in events)
    assert [event["backend"] for event in events if "backend" in event] == ["cuda", "cpu"]
    assert Job.from_file(folder.job).backend == "cpu", "evaluation uses the last backend"


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
def test_cuda_without_a_gpu_is_rejected_and_auto_uses_the_cpu(uninterrupted, tmp_path):
    code, events = run_in_process({**uninterrupted["keys"], "out": str(tmp_path / "run"), "backend": "cuda"})
    assert code == 2 and "no NVIDIA GPU" in events[-1]["what"] and "auto" in events[-1]["remedy"]
    events, _ = RunFolder(uninterrupted["keys"]["out"]).events()
    assert [event["backend"] for event in events if "backend" in event] == ["cpu"]


def test_unused_gpu_is_reported(uninterrupted, tmp_path, monkeypatch):
    from training.rasterize import cuda
    from training.rasterize.cuda import driver

    def fail():
        raise OSError("NVRTC is not installed")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(driver, "kernels", fail)
    cuda.find_problem.cache_clear()
    try:
        keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
        code, events = run_in_process(with_steps(keys, 3))
    finally:
        cuda.find_problem.cache_clear()
    assert code == 0
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    (warning,) = [message for message in warnings if "GPU is not used" in message]
    assert "NVRTC is not installed. Install torch built for CUDA" in warning


@pytest.mark.skipif(os.name == "nt", reason="Windows cancels with a file")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_signal_saves_a_checkpoint(uninterrupted, tmp_path, monkeypatch, number):
    keys = with_steps({**uninterrupted["keys"], "out": str(tmp_path / "run")}, 30000)
    method = method_of(keys)
    train_step = method.train_step

    def signalling_step(self, step):
        if step == 3:
            os.kill(os.getpid(), number)
        return train_step(self, step)

    monkeypatch.setattr(method, "train_step", signalling_step)
    assert run_in_process(keys)[0] == training_loop.CANCELLED
    folder = RunFolder(keys["out"])
    assert folder.state() == "cancelled" and list(folder.checkpoints.glob("*.pt"))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(os.name == "nt", reason="Windows cancels with a file")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_signal_ends_the_process(uninterrupted, tmp_path, number):
    keys = with_steps({**uninterrupted["keys"], "out": str(tmp_path / "run")}, 30000)
    process = subprocess.Popen(
        command(tmp_path / "job.json", keys), cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if '"progress"' in line:
            process.send_signal(number)
            break
    assert process.wait(200) == 3
    folder = RunFolder(keys["out"])
    assert folder.state() == "cancelled" and list(folder.checkpoints.glob("*.pt"))


@pytest.mark.skipif(os.name == "nt", reason="Windows cancels with a file")
def test_stop_signal_after_the_last_step(uninterrupted, tmp_path, monkeypatch):
    """Commands that train several runs would otherwise go on with the next one."""
    write_levels = training_loop._TrainingRun._write_levels

    def write_levels_and_stop(run, levels):
        write_levels(run, levels)
        if run.step == run.method.steps:
            os.kill(os.getpid(), signal.SIGTERM)

    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    with monkeypatch.context() as patch:
        patch.setattr(training_loop._TrainingRun, "_write_levels", write_levels_and_stop)
        assert run_in_process(keys)[0] == 3
    assert RunFolder(keys["out"]).state() == "cancelled"
    assert run_in_process(keys)[0] == 0
    assert RunFolder(keys["out"]).bundle.read_bytes() == uninterrupted["bundle"]


def test_second_trainer_in_a_run_folder_is_rejected(uninterrupted, tmp_path, capsys):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    folder.create()
    with folder.locked():
        assert folder.state() == "running"
        assert training_loop.train(Job.from_dict(keys), sys.stdout) == 2
        assert "another trainer is running" in json.loads(capsys.readouterr().out.splitlines()[-1])["what"]
        assert not folder.events()[0], "the rejected trainer writes nothing"
    assert folder.state() == "empty"


def test_other_job_does_not_change_a_run(uninterrupted):
    folder = RunFolder(uninterrupted["keys"]["out"])
    events = folder.events_file.read_bytes()
    assert training_loop.train(Job.from_dict({**uninterrupted["keys"], "seed": 9})) == 2
    assert folder.events_file.read_bytes() == events and folder.state() == "done"


def test_seed_changes_the_model(uninterrupted, tmp_path):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run"), "seed": 1}
    assert run_in_process(keys)[0] == 0
    assert RunFolder(keys["out"]).bundle.read_bytes() != uninterrupted["bundle"]


def test_full_disk_is_reported_and_the_run_resumes(uninterrupted, tmp_path, monkeypatch):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    save = torch.save
    calls = []

    def second_save_fails(*arguments, **options):
        calls.append(1)
        if len(calls) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return save(*arguments, **options)

    monkeypatch.setattr(torch, "save", second_save_fails)
    code, events = run_in_process(keys)
    folder = RunFolder(keys["out"])
    assert code == 2 and folder.state() == "failed"
    assert events[-1]["event"] == "error" and "No space left" in events[-1]["what"]
    assert "Free some space" in events[-1]["remedy"] and events[-1]["cause"] == "disk"
    assert not [path for path in folder.path.rglob("*") if ".tmp" in path.name], "no incomplete file remains"
    monkeypatch.undo()
    assert run_in_process(keys)[0] == 0
    assert folder.bundle.read_bytes() == uninterrupted["bundle"]


@pytest.fixture
def stopped(uninterrupted, tmp_path, monkeypatch) -> dict:
    """Keys of a run with two checkpoints that was cancelled after 40 of its 70 steps."""
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    method, folder = method_of(keys), RunFolder(keys["out"])
    train_step = method.train_step

    def cancelling_step(self, step):
        if step in (33, 39):
            folder.request_cancel()
        return train_step(self, step)

    monkeypatch.setattr(method, "train_step", cancelling_step)
    assert [run_in_process(keys)[0] for _ in range(2)] == [training_loop.CANCELLED] * 2
    monkeypatch.undo()
    assert [path.name for path in sorted(folder.checkpoints.iterdir())] == [
        "step_0000034.pt", "step_0000040.pt",
    ]  # fmt: skip
    return keys


def test_run_resumes_from_an_older_checkpoint_if_the_newest_is_damaged(uninterrupted, stopped):
    folder = RunFolder(stopped["out"])
    newest = folder.checkpoints / "step_0000040.pt"
    data = bytearray(newest.read_bytes())
    with zipfile.ZipFile(newest) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    name, extra = struct.unpack_from("<HH", data, largest.header_offset + 26)
    data[largest.header_offset + 30 + name + extra + largest.file_size // 2] ^= (
        1  # padding lies between entries
    )
    newest.write_bytes(data)
    code, events = run_in_process(stopped)
    assert code == 0 and folder.bundle.read_bytes() == uninterrupted["bundle"]
    assert any("Resuming at step 34" in event.get("message", "") for event in events)
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    assert any("checkpoint step_0000040.pt" in warning for warning in warnings)


def test_run_without_a_readable_checkpoint_fails_instead_of_restarting(stopped):
    folder = RunFolder(stopped["out"])
    for path in folder.checkpoints.iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    code, events = run_in_process(stopped)
    assert code == 2 and "no checkpoint is readable" in events[-1]["what"]
    assert "delete checkpoints" in events[-1]["remedy"]
    start = max(index for index, event in enumerate(events) if event["event"] == "hello")
    assert not any(event["event"] == "level" for event in events[start:])


def test_checkpoint_of_another_version_is_rejected(stopped):
    folder = RunFolder(stopped["out"])
    for path in folder.checkpoints.iterdir():
        state = torch.load(path, weights_only=True)
        torch.save({**state, "format": 0, "version": "0.0.9"}, path)
    code, events = run_in_process(stopped)
    assert code == 2 and "LODGS 0.0.9 wrote it" in events[-1]["what"]


def test_incompatible_checkpoint_leaves_no_partial_state(uninterrupted, stopped):
    folder = RunFolder(stopped["out"])
    newest = folder.checkpoints / "step_0000040.pt"
    state = torch.load(newest, weights_only=True)
    state["method"]["exposure"] = {}
    state["method"]["model"]["tensors"]["means"] += 1
    torch.save(state, newest)
    assert run_in_process(stopped)[0] == 0
    assert folder.bundle.read_bytes() == uninterrupted["bundle"]


def test_moved_run_resumes_in_its_new_folder(uninterrupted, stopped, tmp_path):
    """Even if its job names another folder."""
    moved = tmp_path / "other" / "run"
    moved.parent.mkdir()
    os.rename(stopped["out"], moved)
    folder = RunFolder(moved)
    assert 'out = "."' in folder.job.read_text()
    folder.job.write_text(folder.job.read_text().replace('out = "."', f'out = "{stopped["out"]}"'))
    assert training_loop.train(Job.from_file(folder.job)) == 0
    assert folder.bundle.read_bytes() == uninterrupted["bundle"]
    assert not Path(stopped["out"]).exists()


def test_finished_run_deletes_checkpoints_and_repeats_its_final_event(uninterrupted, capsys):
    folder = RunFolder(uninterrupted["keys"]["out"])
    assert not folder.checkpoints.exists()
    events = folder.events_file.read_bytes()
    assert training_loop.train(Job.from_dict(uninterrupted["keys"]), sys.stdout) == 0
    event = json.loads(capsys.readouterr().out)
    assert event["event"] == "done" and event["bundle"] == "bundle.ply"
    assert sys.platform != "linux" or event["memory"] > 1e7
    assert folder.events_file.read_bytes() == events


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN])
@pytest.mark.parametrize("early", [True, False])
def test_cancel_works_while_the_trainer_starts(uninterrupted, tmp_path, monkeypatch, handler, early):
    """Also before the trainer locks the run, and in a shell's background, which ignores Ctrl-C."""
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    folder.create()
    if early:
        folder.request_cancel()

    def read_slowly(*_, **__):  # an interrupted compiler or import may crash this process later
        if not early:
            folder.request_cancel()
        time.sleep(100)

    monkeypatch.setattr(training_loop, "training_data", read_slowly)
    previous = signal.signal(signal.SIGINT, handler)
    try:
        assert run_in_process(keys)[0] == training_loop.CANCELLED and folder.state() == "cancelled"
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, previous)
    assert not folder.take_cancel()


@pytest.mark.skipif(os.name == "nt", reason="Windows does not delete open files")
@pytest.mark.parametrize("lost", ["run", "run/lock"])
def test_run_folder_deleted_during_training_is_not_recreated(
    uninterrupted, tmp_path, monkeypatch, capsys, lost
):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    method = method_of(keys)
    train_step = method.train_step

    def losing_step(self, step):
        if step == 5:
            os.rename(tmp_path / lost, tmp_path / "moved")
        return train_step(self, step)

    monkeypatch.setattr(method, "train_step", losing_step)
    monkeypatch.setattr(training_loop, "CHECKPOINT_SECONDS", 0)  # the step is followed by a write
    assert training_loop.train(Job.from_dict(keys), sys.stdout) == 2
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert event["event"] == "error" and "moved or deleted" in event["what"]
    assert lost == "run/lock" or not (tmp_path / "run").exists()
    assert not (tmp_path / "run" / "checkpoints" / "step_0000006.pt").exists()


def test_trainer_saves_and_resumes_when_its_parent_ended(uninterrupted, tmp_path, monkeypatch):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    method = method_of(keys)
    train_step = method.train_step
    ended = threading.Event()
    monkeypatch.setattr(training_loop.processes, "parent_ended", ended)

    def orphaning_step(self, step):
        if step == 7:
            ended.set()
        return train_step(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(method, "train_step", orphaning_step)
        code, events = run_in_process(keys)
    assert code == 2 and "process that started it has ended" in events[-1]["what"]
    assert RunFolder(keys["out"]).state() == "failed", "not cancelled: its blocks' run resumes it"
    ended.clear()
    assert run_in_process(keys)[0] == 0
    assert RunFolder(keys["out"]).bundle.read_bytes() == uninterrupted["bundle"]


def test_final_event_is_written_to_a_full_disk(uninterrupted, tmp_path, monkeypatch):
    keys = {**uninterrupted["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    append = EventWriter._append

    def full(self, data):
        if b"progress" in data:
            self._file.write(data[:20])  # a partial write
            self._torn = True
        if folder.reserve.exists() and (self._torn or b"progress" in data):
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, data)

    monkeypatch.setattr(EventWriter, "_append", full)
    code, events = run_in_process(keys)
    assert code == 2 and events[-1]["what"] == "Training stopped: the disk is full."
    assert folder.state() == "failed" and not folder.reserve.exists()


def test_unexpected_error_is_an_event_with_details_in_the_log(uninterrupted, tmp_path, monkeypatch, capsys):
    def broken(*_):
        raise RuntimeError("a bug")

    monkeypatch.setattr(training_loop._TrainingRun, "run", broken)
    code, events = run_in_process({**uninterrupted["keys"], "out": str(tmp_path / "run")})
    assert code == 1
    assert events[-1]["event"] == "error" and "a bug" in events[-1]["what"]
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("views", "keys", "message"),
    [
        (2, {}, "1 of 2 usable views in .* remain"),
        (4, {"test_every": 3, "validation": True}, "1 of 4 usable views in .* remain"),
        (4, {"validation": True}, "for validation"),
        (4, {"test_every": 0, "image_scale": 0.15}, "9 x 7 pixels, 11 per side"),
    ],
)
def test_scene_with_too_few_views_or_pixels_is_rejected(tiny_scene, tmp_path, views, keys, message):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    for photo in sorted((scene / "images").iterdir())[views:]:
        photo.unlink()
    job = Job.from_dict({"scene": str(scene), "out": str(tmp_path / "run"), **keys})
    with pytest.raises(LodgsError, match=message):
        training_data(job, RunFolder(tmp_path / "run"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: [p.unlink() for p in (scene / "images").iterdir()], "view"),
        (lambda scene: (scene / "sparse/0/cameras.txt").unlink(), "cameras.txt is missing"),
        (lambda scene: [p.unlink() for p in sorted((scene / "images").iterdir())[1:]], "1 usable view"),
        (shutil.rmtree, "does not exist"),
    ],
)
def test_unusable_scenes_are_rejected_with_a_remedy(tiny_scene, tmp_path, capsys, change, message):
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    change(scene)
    keys = {"scene": str(scene), "out": str(tmp_path / "run"), "test_every": 0}
    assert training_loop.train(Job.from_dict(keys), sys.stdout) == 2
    output = capsys.readouterr()
    event = json.loads(output.out.splitlines()[-1])
    assert event["event"] == "error" and message in event["what"] and event["remedy"]
    assert "Traceback" not in output.err


def test_missing_scene_does_not_reserve_the_run_folder(tmp_path, capsys):
    run = tmp_path / "run"

    def error(name):
        assert training_loop.train(
            Job.from_dict({"scene": str(tmp_path / name), "out": str(run)}), sys.stdout
        )
        event = json.loads(capsys.readouterr().out.splitlines()[-1])
        return f"{event['what']} {event['remedy']}"

    assert f"{tmp_path / 'first'}: the folder does not exist" in error("first")
    assert f"{tmp_path / 'second'}: the folder does not exist" in error("second")
    RunFolder(run).level_file(1).touch()
    assert "another job (different: scene)" in error("first")
    assert "its scene" in error("second") and "job.toml" in error("second")


def test_reading_events_continues_at_an_offset_and_leaves_incomplete_lines(tmp_path):
    folder = RunFolder(tmp_path)
    folder.events_file.write_bytes(b'{"event": "hello"}\nnot json\n{"event": "can')
    events, offset = folder.events()
    assert [event["event"] for event in events] == ["hello"]
    with folder.events_file.open("ab") as file:
        file.write(b'celled"}\n')
    events, end = folder.events(offset)
    assert [event["event"] for event in events] == ["cancelled"]
    assert folder.events(end) == ([], end)


def test_levels_on_disk_give_the_same_bundle(tiny_scene, tmp_path, monkeypatch):
    """A tree with its nodes on disk, in a run that keeps few splats in memory."""
    parameters = {"steps": 10, "tune_steps": 4, "densify_until": 0.2, "margin": 0.0}
    keys = {
        "scene": str(tiny_scene), "out": str(tmp_path / "in_memory"), "image_scale": 1.0, "test_every": 4,
        "method": "tree", "backend": "cpu", "parameters": parameters,
    }  # fmt: skip
    code, in_memory = run_in_process(keys)
    assert code == 0
    method = method_of(keys)

    levels_after = method.levels_after

    def levels_on_disk(self, step):
        levels = levels_after(self, step)
        for level in levels:
            if len(levels) > 1 and level.on_disk is None:
                level.on_disk = file = ScratchFile(tmp_path)
                file.append(level.splats)
                level.splats = NO_SPLATS
        return levels

    monkeypatch.setattr(method, "levels_after", levels_on_disk)
    for module in (training_loop, on_disk):
        monkeypatch.setattr(module, "MAX_IN_MEMORY", 20)
    code, on_disk_events = run_in_process({**keys, "out": str(tmp_path / "on_disk")})
    assert code == 0
    bundles = [(tmp_path / name / "bundle.ply").read_bytes() for name in ("in_memory", "on_disk")]
    assert bundles[0] == bundles[1]
    results = [
        [event for event in run if event["event"] in ("level", "done")] for run in (in_memory, on_disk_events)
    ]
    for expected, event in zip(*results, strict=True):
        for name in ("splats", "drawn", "psnr", "train_psnr", "veil", "oversized", "worst"):
            assert event.get(name) == expected.get(name)
