"""Checkpoints and networks: read completely and unchanged, or rejected."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.entry_points import attempt
from tests.fuzz.mutations import corrupted
from training.errors import LodgsError
from training.runs import checkpoints
from training.runs.arrays import read_arrays
from training.runs.folder import RunFolder

STATE = {
    "model": {"means": torch.arange(600.0).reshape(200, 3), "level": torch.ones(200, dtype=torch.uint8)},
    "steps": {"means": 7},
}
LEVELS = [{"level": 1, "path": "levels/level_1.ply", "splats": 7, "facts": {"s_min": 0.5}}]
ARRAYS = {"means": np.arange(60.0, dtype="f4").reshape(20, 3), "network.weight": np.ones((4, 4), "f4")}


def archive() -> bytes:
    file = io.BytesIO()
    np.savez(file, **ARRAYS)
    return file.getvalue()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Create a run with two checkpoints."""
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    folder.create()
    (folder.levels_folder / "level_1.ply").touch()
    for step in (3, 5):
        checkpoints.write_checkpoint(folder, step, LEVELS, STATE)
    return folder


@pytest.fixture(scope="module")
def checkpoint(run) -> bytes:
    return (run.checkpoints / "step_0000005.pt").read_bytes()


def check(state: dict) -> None:
    """Check that the state is bit-identical."""
    assert state["steps"] == STATE["steps"]
    for name, tensor in STATE["model"].items():
        assert torch.equal(state["model"][name], tensor) and state["model"][name].dtype == tensor.dtype


@pytest.mark.cases(short=60, weight=1)
@given(data=st.data())
def test_corrupt_newest_checkpoint(run, checkpoint, data):
    content = data.draw(corrupted([checkpoint]))
    (run.checkpoints / "step_0000005.pt").write_bytes(content)
    warnings: list[str] = []

    def resume() -> None:
        try:
            result = checkpoints.read_newest(run, "cpu", check, warnings.append)
        except checkpoints.OtherVersion:
            raise
        except LodgsError as error:
            raise AssertionError("the previous checkpoint is intact") from error
        assert result in ((5, LEVELS), (3, LEVELS)) and (result[0] == 5 or len(warnings) == 1)
        "".join(warnings).encode()

    attempt("checkpoint", resume, content)


@pytest.mark.cases(short=60, weight=1)
@given(content=corrupted([archive()]))
def test_networks(run, content):
    run.model.write_bytes(content)
    if arrays := attempt("networks", lambda: read_arrays(run.model), content):
        for name, array in arrays.items():
            assert name not in ARRAYS or np.array_equal(array, ARRAYS[name])
