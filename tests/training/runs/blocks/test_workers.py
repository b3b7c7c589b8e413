"""Who trains blocks: here, and Dask's workers."""

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.runs.blocks import workers as workers_module
from training.runs.blocks.plan import read_plan, write_plan
from training.runs.blocks.workers import train_block, workers
from training.runs.events import event_line
from training.runs.folder import RunFolder
from training.runs.train import train

from .test_blocks import TINY, job_for


@pytest.fixture
def block(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run").resolved()
    folder = RunFolder(job.out)
    folder.create()
    return write_plan(job, folder).blocks[0].folder


@pytest.mark.parametrize(
    "on", ["", "there", "local", "local:", "local:0", "local:-1", "local:x", "host:8786"]
)
def test_places_that_there_are_not_are_told(on):
    pytest.importorskip("distributed")
    with pytest.raises(LodgsError, match="nothing to train on"), workers(on):
        pass


def test_without_dask_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(LodgsError, match="Dask is not installed") as found, workers("local:2"):
        pass
    assert "pip install" in found.value.remedy


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_told(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers_module, "TIMEOUT_SECONDS", 1)
    with pytest.raises(LodgsError, match="No Dask scheduler answers"), workers("tcp://127.0.0.1:1"):
        pass


def test_a_trainer_that_was_left_behind_is_waited_for_and_stopped_with_its_run(block, monkeypatch):
    """Whose worker was lost goes on; what it is asked to is not begun again by the next worker."""
    monkeypatch.setattr(workers_module.time, "sleep", lambda _: stop.set())
    stop, begun = threading.Event(), threading.Event()
    left = RunFolder(block.path)

    def trainer():
        with left.locked():
            begun.set()
            stop.wait(10)
            with left.events_file.open("a") as file:
                file.write(event_line("hello") + "\n" + event_line("cancelled", message="Stopped.") + "\n")

    threading.Thread(target=trainer, daemon=True).start()
    assert begun.wait(10)
    assert train_block(str(block.path)) == 3
    assert not block.log.exists(), "no other trainer was started"


def test_a_block_that_was_asked_to_stop_does_not_begin(block):
    block.request_cancel()
    assert train_block(str(block.path)) == 3
    assert not block.events_file.exists()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_workers_of_dask_make_the_bundle_that_is_made_here(tiny_scene, tmp_path):
    """Coarse levels, blocks and seams, two at a time."""
    pytest.importorskip("distributed")
    steps = {"levels": 3, "steps": [15, 15, 15], "footprint": 6.0}
    here, there = (
        job_for(tiny_scene, tmp_path / name, "flod", test_every=0, polish=4, parameters={**TINY, **steps})
        for name in ("here", "there")
    )
    assert train(here) == 0 and train(there, on="local:2", resources={"GPU": 1}) == 0
    division = read_plan(RunFolder(there.out))
    parts = [part for stage in division.stages for part in stage]
    assert [part.kind for part in parts] == ["coarse", "block", "block", "seam", "seam"]
    assert all(part.folder.state() == "done" and part.folder.log.exists() for part in parts)
    assert RunFolder(there.out).bundle.read_bytes() == RunFolder(here.out).bundle.read_bytes()


PRINTS_ITS_CARD = """
import os, sys, time
if "train" in sys.orig_argv:
    folder = os.path.dirname(__file__)
    open(os.path.join(folder, "card-" + os.environ["CUDA_VISIBLE_DEVICES"]), "w").close()
    end = time.monotonic() + 30  # so that another worker takes the other block
    while time.monotonic() < end and sum(name.startswith("card-") for name in os.listdir(folder)) < 2:
        time.sleep(0.05)
    os._exit(0)
"""


@pytest.fixture
def cards_of(tmp_path, monkeypatch):
    """``cards_of(block)``: the cards that two trainers see, each played by one that says it and ends."""
    pytest.importorskip("distributed")
    folder = tmp_path / "stand-in"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(PRINTS_ITS_CARD)
    monkeypatch.setenv("PYTHONPATH", str(folder))

    def seen(block):
        with workers("local:2") as submit:
            for pending in [submit(block.path) for _ in range(2)]:
                assert pending.result() == 0
        return {path.name.removeprefix("card-") for path in folder.glob("card-*")}

    return seen


@pytest.mark.slow
def test_each_worker_of_this_computer_has_a_card_of_those_that_are_named(block, cards_of, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3, 5,7")
    assert cards_of(block) == {"3", "5"}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="the stand-in for nvidia-smi is a shell script")
def test_or_of_those_that_the_computer_has(block, cards_of, tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\nprintf 'GPU-a1\\nGPU-b2\\n'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert cards_of(block) == {"GPU-a1", "GPU-b2"}


def test_a_computer_without_cards_has_none(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert workers_module.graphics_cards() == []
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("PATH", "")
    assert workers_module.graphics_cards() == []


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_scheduler_that_was_started_by_hand_trains_a_block_and_its_loss_is_told(
    block, tmp_path, monkeypatch
):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers_module, "TIMEOUT_SECONDS", 5)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address, root = f"tcp://127.0.0.1:{port}", Path(workers_module.__file__).parents[3]

    def dask(*what):
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *what, "--dashboard-address", ":0"],
            env={**os.environ, "PYTHONPATH": str(root)}, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    scheduler = dask("scheduler", "--host", "127.0.0.1", "--port", str(port))
    worker = dask(
        "worker", address, "--nthreads", "1", "--local-directory", str(tmp_path), "--resources", "GPU=1",
        "--death-timeout", "60",
    )  # fmt: skip
    try:
        while not listening(port):
            time.sleep(0.1)
        with pytest.raises(LodgsError, match=r"scheduler .* is gone"), workers(address, {"GPU": 1}) as submit:
            assert submit(block.path).result() == 0
            assert block.state() == "done"
            scheduler.kill()
            scheduler.wait()
            end = time.monotonic() + 60
            while time.monotonic() < end:
                pending = submit(block.path)
                while not pending.done():
                    time.sleep(0.05)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()


def listening(port: int) -> bool:
    """Whether anybody answers at a port of this computer."""
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True
