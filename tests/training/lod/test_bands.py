"""FLoD's rule, compared with numbers of the paper and formulas by hand."""

from math import inf

import numpy as np
import pytest

from training.errors import LodgsError
from training.lod.rule import collect_facts, rules
from training.lod.rules.bands import min_scales

BANDS = rules()["bands"]


def bands_of(s_min, focal_px, gamma, start, end):
    """Return near and far distance of every level."""
    levels = [(number, {"s_min": value}) for number, value in enumerate(s_min, 1)]
    values = {"gamma": gamma, "first": start, "last": end}
    return [
        BANDS.distance_band(focal_px, collect_facts(BANDS, {}, levels, number), values)
        for number, _ in levels
    ]


def test_scale_constraints_match_the_paper():
    # methods: lambda 0.2, rho 4, five levels -> .2 / .05 / .0125 / .003125 / 0
    assert min_scales(0.2, 4, 5) == pytest.approx([0.2, 0.05, 0.0125, 0.003125, 0])


def test_one_level_has_no_constraint():
    assert min_scales(0.2, 4, 1) == [0.0]


def test_bands_of_levels_three_to_five():
    # d_proj(l) = s_min(l) / gamma * f: level 4 at 0.003125 / 0.5 * 800 = 5, level 3 at 20
    bands = bands_of([0.2, 0.05, 0.0125, 0.003125, 0], focal_px=800, gamma=0.5, start=3, end=5)
    assert bands[:2] == [(inf, inf), (inf, inf)]
    assert bands[2] == (pytest.approx(20), inf)
    assert bands[3] == (pytest.approx(5), pytest.approx(20))
    assert bands[4] == (0.0, pytest.approx(5))


@pytest.mark.parametrize("start, end", [(1, 5), (2, 4), (3, 3), (5, 5), (4, 2), (6, 9)])
def test_every_distance_belongs_to_exactly_one_level(start, end):
    s_min = min_scales(0.3, 3, 5)
    bands = bands_of(s_min, 500, 2.0, start, end)
    borders = [border for band in bands for border in band if 0 < border < inf]
    means = np.zeros((1001 + len(borders), 3), np.float32)
    means[:, 0] = np.concatenate([np.linspace(0, 200, 1001), borders])
    levels = [(number, {"s_min": value}) for number, value in enumerate(s_min, 1)]
    values = {"gamma": 2.0, "first": start, "last": end}
    weights = [
        BANDS.weights(means, np.zeros(3), 500, {}, collect_facts(BANDS, {}, levels, number), values)
        for number, _ in levels
    ]
    assert (sum(weights) == 1).all()


def test_deleted_level_leaves_no_gap():
    levels = [(number, {"s_min": s_min}) for number, s_min in ((1, 0.2), (3, 0.0125), (5, 0.0))]
    values = {"gamma": 1.0, "first": 1, "last": 5}
    result = [
        BANDS.distance_band(100, collect_facts(BANDS, {}, levels, number), values) for number, _ in levels
    ]
    near, border, far = (0, 1.25, 20)
    expected = [(far, inf), (border, far), (near, border)]
    assert [pytest.approx(band) for band in expected] == result


def test_larger_gamma_moves_coarser_levels_closer():
    near = [bands_of(min_scales(0.2, 4, 5), 800, gamma, 3, 5)[2][0] for gamma in (0.5, 1, 2)]
    assert near == pytest.approx([20, 10, 5])


@pytest.mark.parametrize("first, last, gamma", [(0, 3, 1), (4, 3, 1), (1, 6, 1), (1, 5, 0), (1.5, 5, 1)])
def test_invalid_controls_are_rejected(first, last, gamma):
    with pytest.raises(LodgsError):
        BANDS.resolve_controls({"first": first, "last": last, "gamma": gamma}, [1, 2, 3, 4, 5])


def test_default_is_the_three_finest_levels():
    assert BANDS.resolve_controls({}, [1, 2, 3, 4, 5]) == {"gamma": 1.0, "first": 3, "last": 5}
    assert BANDS.resolve_controls({"last": 4}, [1, 2, 3, 4, 5])["first"] == 3
    assert BANDS.resolve_controls({"first": 1}, [1, 2], {"gamma": 2.5}) == {
        "gamma": 2.5,
        "first": 1,
        "last": 2,
    }


def test_coarser_values_drop_the_finest_level():
    values = {"gamma": 1.0, "first": 2, "last": 5}
    values = BANDS.coarser(values, [1, 2, 4, 5])
    assert values == {"gamma": 1.0, "first": 2, "last": 4}
    values = BANDS.coarser(values, [1, 2, 4, 5])
    assert values["last"] == 2 and BANDS.coarser(values, [1, 2, 4, 5]) is None
