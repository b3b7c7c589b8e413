"""What a coarser level keeps of a finer one, and how much it is enlarged, by hand."""

import numpy as np
import pytest

from training.lod.blocks import SIZE
from training.optimize.pruning import importance_threshold, log_scale_gain


@pytest.mark.parametrize("most, kept", [(100, "abcd"), (11, "abcd"), (10.9, "abd"), (4, "ab"), (3, "b")])
def test_the_most_important_stay_as_long_as_views_draw_no_more_than_they_may(most, kept):
    importance, views = np.array([0.5, 0.9, 0.1, 0.2]), np.array([1, 3, 4, 3])
    least = importance_threshold(importance, views, most)
    assert "".join(np.array(list("abcd"))[importance >= least]) == kept


def test_where_not_even_one_may_stay_nothing_is_said():
    assert importance_threshold(np.array([0.5, 0.9]), np.array([2, 3]), 1) == 0


def test_what_stays_takes_over_the_room_of_what_goes():
    """Discs of the area e^-3 in two blocks: of the first a quarter stays, of the second all."""
    log_scales = np.tile(np.float32([-9, -1, -2]), (2 * SIZE, 1))
    kept, shares = np.ones(2 * SIZE, bool), np.ones(2 * SIZE, np.float32)
    kept[: 3 * SIZE // 4] = False
    wider = log_scale_gain(log_scales, shares, kept)
    np.testing.assert_allclose(wider[:SIZE], np.log(2), rtol=1e-5)  # four times the area is twice the size
    np.testing.assert_allclose(wider[SIZE:], 0, atol=1e-7)
    shares[: 3 * SIZE // 4] = 0  # what nobody saw leaves no room
    np.testing.assert_allclose(log_scale_gain(log_scales, shares, kept), 0, atol=1e-7)
