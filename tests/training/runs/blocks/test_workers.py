"""Who trains blocks: here, and Dask's workers."""

import sys
from pathlib import Path

import pytest

from training.errors import LodgsError
from training.runs.blocks import workers as workers_module
from training.runs.blocks.plan import write_plan
from training.runs.blocks.workers import train_block, workers
from training.runs.folder import RunFolder

from .test_blocks import job_for


@pytest.fixture
def block(tiny_scene, tmp_path):
    job = job_for(tiny_scene, tmp_path / "run").resolved()
    folder = RunFolder(job.out)
    folder.make()
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
    monkeypatch.setattr(workers_module, "ANSWERS", 1)
    with pytest.raises(LodgsError, match="No Dask scheduler answers"), workers("tcp://127.0.0.1:1"):
        pass


def test_a_block_that_was_asked_to_stop_does_not_begin(block):
    block.request_cancel()
    assert train_block(str(block.path)) == 3
    assert not block.events_file.exists()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_worker_of_dask_trains_a_block(block):
    pytest.importorskip("distributed")
    with workers("local:1", {"GPU": 1}) as submit:
        assert submit(block.path).result() == 0
    assert block.state() == "done" and block.bundle.exists()
    assert Path(block.log).exists()
