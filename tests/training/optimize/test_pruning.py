"""Tests of pruning and enlargement of coarser levels, computed by hand."""

import numpy as np
import pytest

from training.lod.blocks import SIZE
from training.optimize.pruning import importance_threshold, log_scale_gain


@pytest.mark.parametrize(
    "budget, expected", [(100, "abcd"), (11, "abcd"), (10.9, "abd"), (4, "ab"), (3, "b")]
)
def test_most_important_splats_are_kept_within_the_budget(budget, expected):
    importance, views = np.array([0.5, 0.9, 0.1, 0.2]), np.array([1, 3, 4, 3])
    threshold = importance_threshold(importance, views, budget)
    assert "".join(np.array(list("abcd"))[importance >= threshold]) == expected


def test_threshold_is_zero_if_no_splat_fits():
    assert importance_threshold(np.array([0.5, 0.9]), np.array([2, 3]), 1) == 0


def test_kept_splats_cover_the_area_of_removed_ones():
    """Discs of area e^-3 in two blocks: a quarter of the first and all of the second are kept."""
    log_scales = np.tile(np.float32([-9, -1, -2]), (2 * SIZE, 1))
    mask, shares = np.ones(2 * SIZE, bool), np.ones(2 * SIZE, np.float32)
    mask[: 3 * SIZE // 4] = False
    gain = log_scale_gain(log_scales, shares, mask)
    np.testing.assert_allclose(gain[:SIZE], np.log(2), rtol=1e-5)  # four times the area, twice the size
    np.testing.assert_allclose(gain[SIZE:], 0, atol=1e-7)
    shares[: 3 * SIZE // 4] = 0  # invisible splats have no area
    np.testing.assert_allclose(log_scale_gain(log_scales, shares, mask), 0, atol=1e-7)
