"""Octree-GS's rule, by hand."""

import numpy as np
import pytest

from training.lod.rule import collect_facts
from training.lod.rules.octree import BIAS, RULE, fade_weights, target_level


def test_target_level_rises_by_one_per_halved_distance():
    distances = np.array([64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1000.0])
    assert target_level(distances, 0.0, 32.0, 4).tolist() == [1, 1, 2, 3, 4, 4, 1]
    assert target_level(distances, 1.0, 32.0, 4).tolist() == [1, 2, 3, 4, 4, 4, 1]


def test_level_fades_in_over_a_complete_coarser_level():
    expected = np.array([1.0, 2.0, 2.25, 2.5, 2.625, 2.75, 3.0])
    assert fade_weights(expected, 1).tolist() == [1, 1, 1, 1, 1, 1, 1]
    assert fade_weights(expected, 2).tolist() == [0, 1, 1, 1, 1, 1, 1]
    assert fade_weights(expected, 3).tolist() == [0, 0, 0, 0.5, 0.75, 1, 1]
    assert (fade_weights(expected, 3) >= 0.5).tolist() == (np.round(expected + 1e-9) >= 3).tolist()


def test_zero_distance_selects_all_levels():
    with np.errstate(divide="raise"):
        assert target_level(np.zeros(1, np.float32), 0.0, 32.0, 4).tolist() == [4]


def test_numpy_and_torch_agree():
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(0)
    distances, bias = rng.uniform(0.1, 50, 1000), rng.uniform(0, 1, 1000)
    level = rng.integers(1, 6, 1000)
    by_numpy = fade_weights(target_level(distances, bias, 20.0, 5), level)
    by_torch = fade_weights(
        target_level(torch.tensor(distances), torch.tensor(bias), 20.0, 5), torch.tensor(level)
    )
    assert np.allclose(by_numpy, by_torch.numpy(), atol=1e-12)


def test_missing_focal_length_selects_all_levels():
    facts = collect_facts(RULE, {"d_max": 32.0, "d_max_focal": 0.0}, [(1, {}), (2, {})], 2)
    columns = {name: np.zeros(1, np.float32) for name in RULE.columns}
    position, means = np.zeros(3, np.float32), np.full((1, 3), 50, np.float32)
    assert RULE.weights(means, position, 100.0, columns, facts, RULE.defaults([1, 2])).tolist() == [1]


@pytest.mark.parametrize("fade", [0, 1])
def test_band_ends_with_the_last_weight(fade):
    """For each splat, the weight is positive just inside the band, and 0 just outside."""
    rng = np.random.default_rng(2)
    bias = rng.uniform(-2, 2, 500).astype(np.float32)
    values = RULE.defaults([1, 2, 3, 4]) | {"fade": fade, "offset": 0.3}
    for level in (2, 3, 4):
        facts = collect_facts(
            RULE, {"d_max": 9.0, "d_max_focal": 50.0}, [(n, {}) for n in (1, 2, 3, 4)], level
        )
        near, far = RULE.distance_band(70.0, facts, values, {BIAS: bias})
        assert near == 0 and far.shape == (500,)
        for share, present in ((0.999, True), (1.001, False)):
            means = np.zeros((500, 3), np.float32)
            means[:, 1] = share * far
            weights = RULE.weights(means, np.zeros(3, np.float32), 70.0, {BIAS: bias}, facts, values)
            assert ((weights > 0) == present).all()


def test_band_is_unbounded_for_level_1_and_unknown_bias():
    levels = [(1, {}), (2, {})]
    facts = [collect_facts(RULE, {"d_max": 9.0, "d_max_focal": 50.0}, levels, number) for number in (1, 2)]
    values = RULE.defaults([1, 2])
    assert RULE.distance_band(50.0, facts[0], values, {BIAS: np.zeros(3, np.float32)}) == (0.0, np.inf)
    assert RULE.distance_band(50.0, facts[1], values) == (0.0, np.inf)
