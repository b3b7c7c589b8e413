"""Who trains blocks: here, and Dask's workers."""

import sys

import pytest

from training.errors import LodgsError
from training.runs.blocks import workers as workers_module
from training.runs.blocks.plan import read_plan, write_plan
from training.runs.blocks.workers import train_block, workers
from training.runs.folder import RunFolder
from training.runs.train import train

from .test_blocks import TINY, job_for


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
