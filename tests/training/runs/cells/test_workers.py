"""Workers that train cells: this process and Dask clusters."""

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.runs.cells import workers as workers_module
from training.runs.cells.plan import read_plan, write_plan
from training.runs.cells.workers import train_part, workers
from training.runs.events import event_line
from training.runs.folder import RunFolder
from training.runs.outcome import run_outcome
from training.runs.train import train

from .conftest import train_in_process
from .test_cells import TINY, job_for


@pytest.fixture
def cell(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run").resolved()
    folder = RunFolder(job.out)
    folder.create()
    return write_plan(job, folder).cells[0].folder


@pytest.mark.parametrize(
    "on", ["", "there", "local", "local:", "local:0", "local:-1", "local:x", "host:8786"]
)
def test_unknown_workers_are_rejected(on):
    pytest.importorskip("distributed")
    with pytest.raises(LodgsError, match="Unknown workers"), workers(on):
        pass


def test_missing_dask_is_reported_with_its_installation(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(LodgsError, match="Dask is not installed") as error, workers("local:2"):
        pass
    assert "pip install" in error.value.remedy


@pytest.mark.slow
def test_unreachable_scheduler_is_reported(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers_module, "TIMEOUT_SECONDS", 1)
    with pytest.raises(LodgsError, match="Cannot connect"), workers("tcp://127.0.0.1:1", tls=False):
        pass


def test_worker_waits_for_the_trainer_of_a_lost_worker(cell, monkeypatch):
    """A run that this trainer cancels is not started again."""
    monkeypatch.setattr(workers_module.time, "sleep", lambda _: stop.set())
    stop = threading.Event()
    started = threading.Event()
    run = RunFolder(cell.path)

    def trainer():
        with run.locked():
            started.set()
            stop.wait(200)
            with run.events_file.open("a") as file:
                file.write(event_line("hello") + "\n" + event_line("cancelled", message="Stopped.") + "\n")

    threading.Thread(target=trainer, daemon=True).start()
    assert started.wait(200)
    assert train_part(str(cell.path)) == 3
    assert not cell.log.exists(), "no other trainer was started"


def test_cancelled_cell_does_not_start(cell):
    cell.request_cancel()
    assert train_part(str(cell.path)) == 3
    assert not cell.events_file.exists()


def test_cell_whose_log_cannot_be_written_names_its_folder(cell):
    cell.log.mkdir()
    with pytest.raises(LodgsError, match="Cannot start the trainer of") as error:
        train_part(str(cell.path))
    assert str(cell.log) in error.value.what and "Is a directory" in error.value.what


@pytest.mark.slow
def test_reason_why_a_trainer_cannot_open_its_cell_is_kept(cell):
    cell.job.write_text("method = 3dgs")
    assert train_part(str(cell.path)) == 2
    assert str(cell.job) in run_outcome(cell, 2)[1]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("method", "kinds"),
    [
        ("3dgs", ["block", "block"]),
        pytest.param("flod", ["coarse", "block", "block", "seam", "seam"], marks=pytest.mark.nightly),
    ],
)
def test_dask_workers_give_the_same_bundle_as_this_process(tiny_scene, tmp_path, monkeypatch, method, kinds):
    """Two parts at a time."""
    pytest.importorskip("distributed")
    levels = {"levels": 3, "steps": [15, 15, 15], "footprint": 6.0} if method == "flod" else {}
    keys = {"test_every": 0, "polish": 4 if "seam" in kinds else 0, "parameters": {**TINY, **levels}}
    local, cluster = (job_for(tiny_scene, tmp_path / name, method, **keys) for name in ("local", "cluster"))
    with monkeypatch.context() as patch:
        train_in_process(patch)
        assert train(local) == 0
    assert train(cluster, on="local:2", resources={"GPU": 1}) == 0
    division = read_plan(RunFolder(cluster.out))
    parts = [part for stage in division.stages for part in stage]
    assert [part.kind for part in parts] == kinds
    assert all(part.folder.state() == "done" and part.folder.log.exists() for part in parts)
    assert RunFolder(cluster.out).bundle.read_bytes() == RunFolder(local.out).bundle.read_bytes()


RECORD_CARD = """
import os, sys, time
if "train" in sys.orig_argv:
    folder = os.path.dirname(__file__)
    open(os.path.join(folder, "card-" + os.environ["CUDA_VISIBLE_DEVICES"]), "w").close()
    end = time.monotonic() + 200  # the other worker takes the second cell
    while time.monotonic() < end and sum(name.startswith("card-") for name in os.listdir(folder)) < 2:
        time.sleep(0.05)
    os._exit(0)
"""


@pytest.fixture
def cards_used(tmp_path, monkeypatch):
    """``cards_used(cell)`` returns the cards visible to two simulated trainers."""
    pytest.importorskip("distributed")
    folder = tmp_path / "stand-in"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(RECORD_CARD)
    monkeypatch.setenv("PYTHONPATH", str(folder))

    def used(cell):
        with workers("local:2") as submit:
            for pending in [submit(cell.path) for _ in range(2)]:
                assert pending.result() == 0
        return {path.name.removeprefix("card-") for path in folder.glob("card-*")}

    return used


@pytest.mark.slow
def test_each_local_worker_uses_one_of_the_given_cards(cell, cards_used, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3, 5,7")
    assert cards_used(cell) == {"3", "5"}


@pytest.mark.skipif(os.name == "nt", reason="the simulated nvidia-smi is a shell script")
def test_installed_cards(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\nprintf 'GPU-a1\\nGPU-b2\\n'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert workers_module.graphics_cards() == ["GPU-a1", "GPU-b2"]


def test_computer_without_cards(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert workers_module.graphics_cards() == []
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("PATH", "")
    assert workers_module.graphics_cards() == []


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_external_scheduler_trains_a_cell_and_its_loss_is_reported(cell, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers_module, "TIMEOUT_SECONDS", 5)
    key, root = tmp_path / "cluster.pem", Path(workers_module.__file__).parents[3]

    def command(*arguments):
        return subprocess.Popen(
            [sys.executable, "-m", "training", "blocks", *arguments],
            env={**os.environ, "PYTHONPATH": str(root)}, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    scheduler = command("scheduler", str(key), "--host", "127.0.0.1", "--port", str(port))
    while not key.exists():
        time.sleep(0.1)
    worker = command("worker", str(key), "--offers", "GPU=1")
    try:
        with pytest.raises(LodgsError, match="Lost the connection"), workers(str(key), {"GPU": 1}) as submit:
            assert submit(cell.path).result() == 0
            assert cell.state() == "done"
            scheduler.kill()
            scheduler.wait()
            deadline = time.monotonic() + 200
            while time.monotonic() < deadline:
                pending = submit(cell.path)
                while not pending.done():
                    time.sleep(0.05)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
