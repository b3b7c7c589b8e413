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
def check_resumed() -> Callable[..., None]:
    """``check_resumed(make, *stops)``: resume a method after these numbers of steps.

    Each resumed run must return the same bits as the uninterrupted run.
    """

    def check(make: Callable[[], Method], *stops: int) -> None:
        full_run, states = make(), {}
        levels: list[Level] = []
        step = 0
        while step < full_run.steps:  # some methods determine the number while training
            levels += _train(full_run, step)
            step += 1
            if step in stops:
                torch.save(full_run.state_dict(), file := io.BytesIO())
                states[step] = file, len(levels)
        assert sorted(states) == sorted(stops)
        for stop, (file, count) in states.items():
            resumed, final, step = make(), levels[:count], stop
            file.seek(0)
            resumed.load_state_dict(torch.load(file, weights_only=True))
            while step < resumed.steps:
                final += _train(resumed, step)
                step += 1
            _require_equal(final, levels)
            assert resumed.meta() == full_run.meta()

    return check


def _train(method: Method, step: int) -> list[Level]:
    """Make a step; return the levels that it completes."""
    method.train_step(step)
    return method.levels_after(step)


def _require_equal(actual: list[Level], expected: list[Level]) -> None:
    assert [level.number for level in actual] == [level.number for level in expected] != []
    for expected_level, actual_level in zip(expected, actual, strict=True):
        expected_columns, actual_columns = (
            splat_columns(x.splats) | extra_columns(x.splats) for x in (expected_level, actual_level)
        )
        assert expected_level.facts == actual_level.facts and expected_columns.keys() == actual_columns.keys()
        for name, column in expected_columns.items():
            np.testing.assert_array_equal(column, actual_columns[name])
