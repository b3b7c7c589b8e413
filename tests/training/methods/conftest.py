"""Fixture that compares resumed and uninterrupted training."""

import io
from collections.abc import Callable

import numpy as np
import pytest
import torch

from training.optimize.method import Method
from training.splats.levels import Level
from training.splats.ply import extra_columns, splat_columns


@pytest.fixture
def check_resumed() -> Callable[[Callable[[], Method], int], None]:
    """Return check_resumed(make, stop): resume a method after ``stop`` steps from a state file, and require
    the same bits as from an uninterrupted run.
    """

    def check(make: Callable[[], Method], stop: int) -> None:
        full_run, first, second, file = make(), make(), make(), io.BytesIO()
        levels, initial = _train(full_run, 0), _train(first, 0, stop)
        torch.save(first.state_dict(), file)
        file.seek(0)
        second.load_state_dict(torch.load(file, weights_only=True))
        final = initial + _train(second, stop)
        assert [level.number for level in final] == [level.number for level in levels] != []
        for one, other in zip(levels, final, strict=True):
            columns, theirs = (splat_columns(x.splats) | extra_columns(x.splats) for x in (one, other))
            assert one.facts == other.facts and columns.keys() == theirs.keys()
            for name, column in columns.items():
                np.testing.assert_array_equal(column, theirs[name])
        assert second.meta() == full_run.meta()

    return check


def _train(method: Method, step: int, until: int | None = None) -> list[Level]:
    levels = []
    while step < (until or method.steps):  # which some learn on the way
        method.train_step(step)
        levels += method.levels_after(step)
        step += 1
    return levels
