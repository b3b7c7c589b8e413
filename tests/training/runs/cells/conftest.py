"""Fixtures for scenes in cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from training.runs import train as training_loop
from training.runs.cells import workers as workers_module
from training.runs.folder import RunFolder
from training.runs.job import Job


def train_in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train cells in this process, which saves starting a process for each."""

    def train_part(folder: str) -> int:
        run = RunFolder(Path(folder))
        return training_loop.train(Job.from_file(run.job))

    monkeypatch.setattr(workers_module, "train_part", train_part)


@pytest.fixture
def cells_in_process(monkeypatch) -> None:
    """Train cells in this process during a test."""
    train_in_process(monkeypatch)
