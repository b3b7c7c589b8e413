"""Errors of levels in a part of space, against values worked by hand."""

import numpy as np
import pytest

from training.evaluate.level_errors import measure_level_errors
from training.splats.gaussians import SH_C0, Splats


def ball(color: float, scale: float = 0.3, shift: float = 0.0, logit: float = 1.0) -> Splats:
    """One grey splat at (shift, 0, 0)."""
    return Splats(
        np.float32([[shift, 0, 0]]), np.float32([[1, 0, 0, 0]]), np.full((1, 3), np.log(scale), np.float32),
        np.float32([logit]), np.full((1, 1, 3), (color - 0.5) / SH_C0, np.float32),
    )  # fmt: skip


def bounds(radius: float = 1.0) -> np.ndarray:
    return radius * np.array([[-1.0] * 3, [1.0] * 3]) / np.sqrt(3)


def test_errors_are_relative_squared_differences_of_colour_and_opacity():
    """With colour c, all channels are c times alpha: a black copy misses 3 c² of 3 c² + 1."""
    errors = measure_level_errors({0: ball(0.6), 2: ball(0.6), 3: ball(0.0)}, bounds(), "cpu")
    assert errors[0] == errors[2] == 0
    assert errors[3] == pytest.approx(3 * 0.36 / (3 * 0.36 + 1), rel=1e-4)


def test_an_invisible_level_has_the_error_1():
    errors = measure_level_errors({1: ball(0.6), 4: ball(0.6, logit=-20)}, bounds(), "cpu")
    assert errors == {1: 0, 4: pytest.approx(1)}


def test_errors_do_not_depend_on_the_unit():
    small = measure_level_errors({0: ball(0.6), 1: ball(0.6, 0.3, 0.1)}, bounds(), "cpu")
    large = measure_level_errors({0: ball(0.6, 30), 1: ball(0.6, 30, 10)}, bounds(100), "cpu")
    assert 0.01 < small[1] < 1 and large[1] == pytest.approx(small[1], rel=0.01)


def test_a_single_level_has_no_error():
    assert measure_level_errors({2: ball(0.5)}, bounds(), "cpu") == {2: 0}
