"""Runs from the outside: the process, its lines, its files, and everything that can befall it."""

import errno
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zipfile
from importlib import import_module
from pathlib import Path

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
from training.splats.bundle import NO_SPLATS, read_bundle
from training.splats.ply import read_ply
from training.splats.scratch import ScratchFile

ROOT = Path(__file__).resolve().parents[3]


def run_in_process(keys: dict) -> tuple[int, list[dict]]:
    code = training_loop.train(Job.from_dict(keys))
    return code, RunFolder(keys["out"]).events()[0]


def method_of(keys: dict) -> type:
    return import_module(f"{METHODS[keys['method']].package}.train").Method


def lasting(keys: dict, total: int) -> dict:
    """The job's keys with another number of steps in all, a multiple of 3."""
    steps = [total // 3] * 3 if keys["method"] == "flod" else total
    further = {"finish_share": 0.0} if keys["method"] == "flod" else {}
    return {**keys, "parameters": {**keys["parameters"], "steps": steps, **further}}


def command(path: Path, keys: dict) -> list[str]:
    path.write_text(json.dumps(keys))
    return [sys.executable, "-m", "training", "train", str(path)]


TINY = {
    "flod": {
        "levels": 3, "steps": [14, 16, 20], "finish_share": 0.4, "footprint": 6.0, "densify_interval": 5,
        "prune_interval": 10, "overlap_interval": 10, "sh_interval": 15, "grad_threshold": 1e-5,
        "max_splats": 300, "budget_ratio": 0.5, "random_background": False, "margin": 0.0,
    },
    "octree": {
        "levels": 3, "steps": 70, "footprint": 6.0, "grow_interval": 5, "far_share": 0.2, "sh_interval": 15,
        "grad_threshold": 1e-5, "max_splats": 300, "full_share": 0.1, "random_background": False,
    },
    "octree_neural": {
        "levels": 3, "steps": 70, "footprint": 6.0, "grow_interval": 5, "far_share": 0.2, "offsets": 3,
        "grad_threshold": 1e-5, "max_splats": 300, "appearance": 4, "sh_degree": 2,
        "random_background": False,
    },
}  # fmt: skip
"""Parameters of a run of 70 steps and 3 levels on the tiny scene, whose background is black, by method."""


@pytest.fixture(scope="module", params=TINY)
def unbroken(request, tiny_scene, tmp_path_factory) -> dict:
    """What an undisturbed run of the tiny job gives: its keys, output lines and bundle."""
    out = tmp_path_factory.mktemp("unbroken")
    keys = {
        "scene": str(tiny_scene), "out": str(out / "run"), "image_scale": 1.0, "test_every": 4,
        "method": request.param, "parameters": TINY[request.param],
    }  # fmt: skip
    done = subprocess.run(
        command(out / "job.json", keys), cwd=ROOT, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr
    return {
        "keys": keys,
        "lines": done.stdout.splitlines(),
        "bundle": (out / "run" / "bundle.ply").read_bytes(),
    }


def test_every_line_is_an_event_and_the_file_holds_the_same(unbroken):
    folder = RunFolder(unbroken["keys"]["out"])
    printed = [json.loads(line) for line in unbroken["lines"]]
    assert printed == folder.events()[0]
    kinds = [event["event"] for event in printed]
    assert kinds[0] == "hello" and kinds[-1] == "done"
    assert {"train_psnr", "veil", "oversized", "worst"} <= printed[-1].keys()
    assert {event["level"] for event in folder.levels()} == {1, 2, 3}
    assert folder.state() == "done"
    last = folder.last_event("progress")
    assert last is not None and last["step"] == last["of"] == 70


def test_without_held_out_views_a_run_measures_training_views_and_says_so(tiny_scene, tmp_path):
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


def test_levels_and_bundle_agree_and_record_the_constraint(unbroken):
    folder = RunFolder(unbroken["keys"]["out"])
    bundle = read_bundle(folder.bundle)
    assert [level.number for level in bundle.levels] == [1, 2, 3]
    assert bundle.meta["held_out"] == [0, 4]
    for level, event in zip(bundle.levels, folder.levels(), strict=True):
        alone = read_ply(folder.path / event["path"])
        assert len(level.splats) == event["splats"]
        np.testing.assert_array_equal(level.splats.means, alone.means)
        assert level.splats.extras.keys() == alone.extras.keys()
        assert level.facts == event["facts"]
        if level.facts.get("s_min"):
            assert np.exp(alone.log_scales).min() >= level.facts["s_min"] * (1 - 1e-5)
    upright = up_rotation(read_scene(Path(unbroken["keys"]["scene"])).cameras)
    np.testing.assert_allclose(bundle.meta["up_rotation"], upright, atol=1e-6)
    if bundle.method == "flod":
        assert bundle.meta["footprint_px"] == pytest.approx(6.0)
    else:
        assert bundle.cumulative and bundle.rule == "octree"
        d_max, focal_px = bundle.facts["d_max"], bundle.facts["d_max_focal"]
        assert bundle.meta["voxel"] * focal_px / d_max == pytest.approx(6.0)


def test_the_bundle_tells_where_the_scene_was_photographed_from(unbroken):
    cameras, near, unseen = read_view_tables(read_bundle(RunFolder(unbroken["keys"]["out"]).bundle).tables)
    scene = read_scene(Path(unbroken["keys"]["scene"]))
    assert [camera.name for camera in cameras] == [camera.name for camera in scene.cameras]
    for camera, view in zip(cameras, scene.cameras, strict=True):
        assert np.array_equal(camera.world_to_camera, view.world_to_camera)
        assert (camera.fx, camera.cy, camera.width) == (view.fx, view.cy, view.width)
    assert near == scene.near() and unseen == {view.name for view in scene.split(4)[1]}


def test_training_makes_the_pictures_better(unbroken):
    """Level by level as each is finished; FLoD's finishing steps then go on with the coarser ones."""
    levels = [json.loads(line) for line in unbroken["lines"] if '"level"' in line]
    finished = {e["level"]: e["psnr"] for e in reversed(levels) if e["event"] == "level"}
    quality = [finished[level] for level in sorted(finished)]
    newest = [event["psnr"] for event in RunFolder(unbroken["keys"]["out"]).levels()]
    if unbroken["keys"]["method"] != "flod":
        quality = newest  # levels that join later are handed over again when they are done
    assert quality == sorted(quality) and quality[-1] > quality[0] + 0.5
    assert newest[-1] > newest[0] + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, 23, 44, 61])
def test_a_killed_run_resumes_to_the_same_bits(unbroken, tmp_path, step):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    environment = {**os.environ, "LODGS_CHECKPOINT_SECONDS": "0"}  # a checkpoint after every step
    process = subprocess.Popen(
        command(tmp_path / "job.json", keys), cwd=ROOT, env=environment, stdout=subprocess.DEVNULL
    )
    folder = RunFolder(keys["out"])
    reached = folder.checkpoints / f"step_{step:07d}.pt"
    while not reached.exists() and process.poll() is None:
        time.sleep(0.001)
    process.kill()
    process.wait()
    assert folder.state() == "interrupted"
    code, events = run_in_process(keys)
    assert code == 0 and folder.state() == "done"
    assert any("Going on from step" in event.get("message", "") for event in events)
    assert folder.bundle.read_bytes() == unbroken["bundle"]


@pytest.mark.parametrize("at", [7, 33, 58])
def test_cancel_by_file_saves_and_resume_gives_the_same_bits(unbroken, tmp_path, monkeypatch, at):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    method = method_of(keys)
    real = method.train_step

    def ask_to_stop(self, step):
        if step == at:
            folder.request_cancel()
        return real(self, step)

    monkeypatch.setattr(method, "train_step", ask_to_stop)
    code, events = run_in_process(keys)
    assert code == training_loop.CANCELLED and folder.state() == "cancelled"
    assert events[-1]["event"] == "cancelled" and events[-1]["step"] == at + 1
    monkeypatch.undo()
    keys["photo_memory"] = 1  # megabyte, of which nothing that is trained depends
    assert run_in_process(keys)[0] == 0
    assert Job.from_file(folder.job).photo_memory == 1
    assert folder.bundle.read_bytes() == unbroken["bundle"]


def test_a_run_begun_on_one_backend_goes_on_with_another(unbroken, tmp_path, monkeypatch, fake_card):
    """With the cuda backend on the CPU, to the middle of level 2; then with the cpu backend to the end."""
    keys = {**unbroken["keys"], "out": str(tmp_path / "run"), "backend": "cuda"}
    keys = lasting(keys, 18)
    folder, method = RunFolder(keys["out"]), method_of(keys)
    real = method.train_step

    def ask_to_stop(self, step):
        if step == 8:
            folder.request_cancel()
        return real(self, step)

    monkeypatch.setattr(method, "train_step", ask_to_stop)
    code, events = run_in_process(keys)
    assert code == training_loop.CANCELLED
    assert [event["backend"] for event in events if "backend" in event] == ["cuda"]
    monkeypatch.undo()
    code, events = run_in_process({**keys, "backend": "cpu"})
    assert code == 0 and {event["level"] for event in folder.levels()} == {1, 2, 3}
    assert any("Going on from step 9 of 18" in event.get("message", "") for event in events)
    assert [event["backend"] for event in events if "backend" in event] == ["cuda", "cpu"]
    assert Job.from_file(folder.job).backend == "cpu", "what measures the run draws with what there is"


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
def test_without_a_gpu_cuda_is_refused_and_auto_is_the_cpu(unbroken, tmp_path):
    code, events = run_in_process({**unbroken["keys"], "out": str(tmp_path / "run"), "backend": "cuda"})
    assert code == 2 and "no NVIDIA GPU" in events[-1]["what"] and "auto" in events[-1]["remedy"]
    events, _ = RunFolder(unbroken["keys"]["out"]).events()
    assert [event["backend"] for event in events if "backend" in event] == ["cpu"]


def test_a_gpu_that_is_not_used_is_a_warning(unbroken, tmp_path, monkeypatch):
    from training.rasterize import cuda

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    cuda.problem.cache_clear()
    try:
        keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
        code, events = run_in_process(lasting(keys, 3))
    finally:
        cuda.problem.cache_clear()
    assert code == 0
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    (warning,) = [message for message in warnings if "GPU is not used" in message]
    assert "pip install gsplat" in warning


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows cancels by the file")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_polite_signal_saves(unbroken, tmp_path, number):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    keys = lasting(keys, 30000)
    process = subprocess.Popen(
        command(tmp_path / "job.json", keys), cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if '"progress"' in line:
            process.send_signal(number)
            break
    assert process.wait(60) == 3
    folder = RunFolder(keys["out"])
    assert folder.state() == "cancelled" and list(folder.checkpoints.glob("*.pt"))


@pytest.mark.slow
def test_two_trainings_in_one_folder_are_refused_and_the_first_goes_on(unbroken, tmp_path):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    folder.create()
    with folder.locked():
        assert folder.state() == "running"
        second = subprocess.run(
            command(tmp_path / "job.json", keys), cwd=ROOT, capture_output=True, text=True, timeout=120
        )
        assert second.returncode == 2
        assert "already at work" in json.loads(second.stdout.splitlines()[-1])["what"]
        assert not folder.events()[0], "the refused one leaves no trace in the run"
    assert folder.state() == "empty"


def test_another_job_does_not_touch_a_run(unbroken):
    folder = RunFolder(unbroken["keys"]["out"])
    before = folder.events_file.read_bytes()
    assert training_loop.train(Job.from_dict({**unbroken["keys"], "seed": 9})) == 2
    assert folder.events_file.read_bytes() == before and folder.state() == "done"


def test_another_seed_gives_another_model(unbroken, tmp_path):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run"), "seed": 1}
    assert run_in_process(keys)[0] == 0
    assert RunFolder(keys["out"]).bundle.read_bytes() != unbroken["bundle"]


def test_a_full_disk_is_said_and_the_run_resumes(unbroken, tmp_path, monkeypatch):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    real, calls = torch.save, []

    def full_from_the_second_on(*arguments, **options):
        calls.append(1)
        if len(calls) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **options)

    monkeypatch.setattr(torch, "save", full_from_the_second_on)
    code, events = run_in_process(keys)
    folder = RunFolder(keys["out"])
    assert code == 2 and folder.state() == "failed"
    assert events[-1]["event"] == "error" and "No space left" in events[-1]["what"]
    assert "Free some space" in events[-1]["remedy"]
    assert not [path for path in folder.path.rglob("*") if ".tmp" in path.name], "no half file stays"
    monkeypatch.undo()
    assert run_in_process(keys)[0] == 0
    assert folder.bundle.read_bytes() == unbroken["bundle"]


@pytest.fixture
def stopped(unbroken, tmp_path, monkeypatch) -> dict:
    """The keys of a run with two checkpoints that was cancelled after 40 of its 70 steps."""
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    method, folder = method_of(keys), RunFolder(keys["out"])
    real = method.train_step

    def ask_to_stop(self, step):
        if step in (33, 39):
            folder.request_cancel()
        return real(self, step)

    monkeypatch.setattr(method, "train_step", ask_to_stop)
    assert [run_in_process(keys)[0] for _ in range(2)] == [training_loop.CANCELLED] * 2
    monkeypatch.undo()
    assert [path.name for path in sorted(folder.checkpoints.iterdir())] == [
        "step_0000034.pt", "step_0000040.pt",
    ]  # fmt: skip
    return keys


def test_a_damaged_checkpoint_falls_back_to_the_one_before_and_that_is_told(unbroken, stopped):
    folder = RunFolder(stopped["out"])
    newest = folder.checkpoints / "step_0000040.pt"
    data = bytearray(newest.read_bytes())
    with zipfile.ZipFile(newest) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    name, extra = struct.unpack_from("<HH", data, largest.header_offset + 26)
    data[largest.header_offset + 30 + name + extra + largest.file_size // 2] ^= (
        1  # between entries it is padding
    )
    newest.write_bytes(data)
    code, events = run_in_process(stopped)
    assert code == 0 and folder.bundle.read_bytes() == unbroken["bundle"]
    assert any("Going on from step 34" in event.get("message", "") for event in events)
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    assert any("step_0000040.pt cannot be read" in warning for warning in warnings)


def test_where_no_checkpoint_can_be_read_the_run_says_so_and_does_not_begin_anew(stopped):
    folder = RunFolder(stopped["out"])
    for path in folder.checkpoints.iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    code, events = run_in_process(stopped)
    assert code == 2 and "No checkpoint of the run" in events[-1]["what"]
    assert "deleting checkpoints" in events[-1]["remedy"]
    begun = max(place for place, event in enumerate(events) if event["event"] == "hello")
    assert not any(event["event"] == "level" for event in events[begun:])


def test_a_checkpoint_of_another_version_is_not_gone_on_from(stopped):
    folder = RunFolder(stopped["out"])
    for path in folder.checkpoints.iterdir():
        state = torch.load(path, weights_only=True)
        torch.save({**state, "format": 0, "version": "0.0.9"}, path)
    code, events = run_in_process(stopped)
    assert code == 2 and "was made by LODGS 0.0.9" in events[-1]["what"]


def test_a_checkpoint_that_does_not_fit_leaves_nothing_behind(unbroken, stopped):
    folder = RunFolder(stopped["out"])
    newest = folder.checkpoints / "step_0000040.pt"
    state = torch.load(newest, weights_only=True)
    state["method"]["exposure"] = {}
    state["method"]["model"]["tensors"]["means"] += 1
    torch.save(state, newest)
    assert run_in_process(stopped)[0] == 0
    assert folder.bundle.read_bytes() == unbroken["bundle"]


def test_a_moved_run_goes_on_where_it_is(unbroken, stopped, tmp_path):
    """Also one whose job was written when it named its folder: a stranger's names any."""
    moved = tmp_path / "elsewhere" / "run"
    moved.parent.mkdir()
    os.rename(stopped["out"], moved)
    folder = RunFolder(moved)
    assert 'out = "."' in folder.job.read_text()
    folder.job.write_text(folder.job.read_text().replace('out = "."', f'out = "{stopped["out"]}"'))
    assert training_loop.train(Job.from_file(folder.job)) == 0
    assert folder.bundle.read_bytes() == unbroken["bundle"]
    assert not Path(stopped["out"]).exists()


def test_a_finished_run_keeps_no_checkpoints_and_says_its_end_again(unbroken, capsys):
    folder = RunFolder(unbroken["keys"]["out"])
    assert not list(folder.checkpoints.iterdir())
    before = folder.events_file.read_bytes()
    assert training_loop.train(Job.from_dict(unbroken["keys"]), sys.stdout) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["event"] == "done" and said["bundle"] == "bundle.ply"
    assert folder.events_file.read_bytes() == before


@pytest.mark.parametrize("of_ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_cancel_is_heard_while_the_trainer_starts(unbroken, tmp_path, monkeypatch, of_ctrl_c):
    """In the background of a shell, too, which has programs ignore Ctrl-C."""
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    folder.create()
    folder.request_cancel()  # pressed before the trainer had the run's lock
    assert run_in_process(keys)[0] == training_loop.CANCELLED and folder.state() == "cancelled"

    def slow(*_):
        folder.request_cancel()
        time.sleep(60)

    monkeypatch.setattr(training_loop, "warm_up", slow)
    before = signal.signal(signal.SIGINT, of_ctrl_c)
    try:
        assert run_in_process(keys)[0] == training_loop.CANCELLED
        assert signal.getsignal(signal.SIGINT) is of_ctrl_c
    finally:
        signal.signal(signal.SIGINT, before)
    assert not folder.take_cancel()


@pytest.mark.skipif(os.name == "nt", reason="Windows does not delete what is open")
@pytest.mark.parametrize("lost", ["run", "run/lock"])
def test_a_run_that_is_deleted_while_it_trains_is_not_made_again(
    unbroken, tmp_path, monkeypatch, capsys, lost
):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    method = method_of(keys)
    real = method.train_step

    def lose(self, step):
        if step == 5:
            os.rename(tmp_path / lost, tmp_path / "gone")
        return real(self, step)

    monkeypatch.setattr(method, "train_step", lose)
    assert training_loop.train(Job.from_dict(keys), sys.stdout) == 2
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["event"] == "error" and "moved or deleted" in said["what"]
    assert lost == "run/lock" or not (tmp_path / "run").exists()
    assert not list(tmp_path.glob("run/checkpoints/*"))


def test_a_disk_that_is_full_for_events_too_still_takes_the_last_words(unbroken, tmp_path, monkeypatch):
    keys = {**unbroken["keys"], "out": str(tmp_path / "run")}
    folder = RunFolder(keys["out"])
    real = EventWriter._append

    def full(self, data):
        if b"progress" in data:
            self._file.write(data[:20])  # as much as there was room for
            self._torn = True
        if folder.reserve.exists() and (self._torn or b"progress" in data):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(self, data)

    monkeypatch.setattr(EventWriter, "_append", full)
    code, events = run_in_process(keys)
    assert code == 2 and events[-1]["what"] == "The disk is full; training stopped."
    assert folder.state() == "failed" and not folder.reserve.exists()


def test_an_unexpected_error_is_an_event_and_its_details_go_to_the_log(
    unbroken, tmp_path, monkeypatch, capsys
):
    def broken(*_):
        raise RuntimeError("a bug")

    monkeypatch.setattr(training_loop._TrainingRun, "run", broken)
    code, events = run_in_process({**unbroken["keys"], "out": str(tmp_path / "run")})
    assert code == 1
    assert events[-1]["event"] == "error" and "a bug" in events[-1]["what"]
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("views", "keys", "said"),
    [
        (2, {}, "Of the 2 usable views in .* 1 would be trained on"),
        (4, {"test_every": 2, "validation": True}, "Of the 4 usable views in .* 0 would be"),
        (4, {"validation": True}, "validation leaves some out and measures none"),
        (4, {"test_every": 0, "image_scale": 0.15}, "at 9 x 7 pixels; 11 are needed"),
    ],
)
def test_too_little_to_train_on_and_measure_says_what_would_be_enough(
    tiny_scene, tmp_path, views, keys, said
):
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    for photograph in sorted((scene / "images").iterdir())[views:]:
        photograph.unlink()
    job = Job.from_dict({"scene": str(scene), "out": str(tmp_path / "run"), **keys})
    with pytest.raises(LodgsError, match=said):
        training_data(job, RunFolder(tmp_path / "run"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "change, said",
    [
        (lambda scene: [p.unlink() for p in (scene / "images").iterdir()], "view"),
        (lambda scene: (scene / "sparse/0/points3D.txt").write_text(""), "no 3D points"),
        (lambda scene: (scene / "sparse/0/cameras.txt").unlink(), "no COLMAP model"),
        (lambda scene: [p.unlink() for p in sorted((scene / "images").iterdir())[1:]], "1 usable view"),
    ],
)
def test_scenes_that_cannot_be_trained_on_say_why(tiny_scene, tmp_path, change, said):
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    change(scene)
    keys = {"scene": str(scene), "out": str(tmp_path / "run"), "test_every": 0}
    done = subprocess.run(
        command(tmp_path / "job.json", keys), cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2
    last = json.loads(done.stdout.splitlines()[-1])
    assert last["event"] == "error" and said in last["what"] and last["remedy"]
    assert "Traceback" not in done.stderr


def test_reading_events_goes_on_where_it_stopped_and_leaves_half_lines(tmp_path):
    folder = RunFolder(tmp_path)
    folder.events_file.write_bytes(b'{"event": "hello"}\nnot json\n{"event": "can')
    events, offset = folder.events()
    assert [event["event"] for event in events] == ["hello"]
    with folder.events_file.open("ab") as file:
        file.write(b'celled"}\n')
    events, end = folder.events(offset)
    assert [event["event"] for event in events] == ["cancelled"]
    assert folder.events(end) == ([], end)


def test_levels_that_are_elsewhere_end_in_the_same_bundle(tiny_scene, tmp_path, monkeypatch):
    """A tree whose nodes are handed over in a file, and a run that keeps hardly any splats in memory."""
    few = {"steps": 10, "tune_steps": 4, "densify_until": 0.2, "margin": 0.0}
    keys = {
        "scene": str(tiny_scene), "out": str(tmp_path / "whole"), "image_scale": 1.0, "test_every": 4,
        "method": "tree", "backend": "cpu", "parameters": few,
    }  # fmt: skip
    code, whole = run_in_process(keys)
    assert code == 0
    method = method_of(keys)

    levels_after = method.levels_after

    def in_files(self, step):
        levels = levels_after(self, step)
        for level in levels:
            if len(levels) > 1 and level.on_disk is None:
                level.on_disk = file = ScratchFile(tmp_path)
                file.append(level.splats)
                level.splats = NO_SPLATS
        return levels

    monkeypatch.setattr(method, "levels_after", in_files)
    for module in (training_loop, on_disk):
        monkeypatch.setattr(module, "IN_MEMORY", 20)
    code, parts = run_in_process({**keys, "out": str(tmp_path / "parts")})
    assert code == 0
    bundles = [(tmp_path / name / "bundle.ply").read_bytes() for name in ("whole", "parts")]
    assert bundles[0] == bundles[1]
    said = [[event for event in run if event["event"] in ("level", "done")] for run in (whole, parts)]
    for one, other in zip(*said, strict=True):
        for name in ("splats", "drawn", "psnr", "ssim", "train_psnr", "veil", "oversized", "worst"):
            assert one.get(name) == other.get(name)
