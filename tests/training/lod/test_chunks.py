"""LODGE's rule: Eq. 2 worked by hand."""

import numpy as np
import pytest

from training.lod.rule import facts_of, rules

CHUNKS = rules()["chunks"]
LEVELS = [(1, {"d_l": 20.0}), (2, {"d_l": 5.0}), (3, {"d_l": 0.0})]
AWAY = np.float32([0, 4.999, 5, 19.999, 20, 1e6])


def weights(number, levels=LEVELS, scale=1.0, focal_px=500.0):
    means = np.stack([AWAY + 1, 0 * AWAY, 0 * AWAY], axis=1)
    values = {"distance_scale": scale}
    return CHUNKS.weights(
        means, np.array([1.0, 0, 0]), focal_px, {}, facts_of(CHUNKS, {}, levels, number), values
    ).tolist()


def test_each_distance_is_one_levels():
    assert weights(3) == [1, 1, 0, 0, 0, 0]
    assert weights(2) == [0, 0, 1, 1, 0, 0]
    assert weights(1) == [0, 0, 0, 0, 1, 1]


def test_what_lacks_its_neighbours_takes_over_their_distances():
    assert weights(2, LEVELS[1:]) == [0, 0, 1, 1, 1, 1]  # the coarsest that there is has no end
    assert weights(2, LEVELS[:2]) == [1, 1, 1, 1, 0, 0]  # the finest begins at the eye
    assert weights(1, [LEVELS[0], LEVELS[2]]) == [0, 0, 0, 0, 1, 1]
    assert weights(3, [LEVELS[0], LEVELS[2]]) == [1, 1, 1, 1, 0, 0]


def test_a_distance_scale_is_as_if_all_were_farther_away():
    assert weights(3, scale=0.1) == [1, 1, 1, 1, 1, 0]
    assert weights(1, scale=4.0) == [0, 0, 1, 1, 1, 1]
    coarser = CHUNKS.coarser({"distance_scale": 2.0}, [1, 2, 3])
    assert coarser == {"distance_scale": 2.5}
    assert CHUNKS.coarser({"distance_scale": 90.0}, [1, 2, 3]) is None


def test_the_focal_length_does_not_count():
    assert weights(2, focal_px=50.0) == weights(2)
    assert CHUNKS.defaults([1, 2, 3]) == pytest.approx({"distance_scale": 1})
