"""FLoD's rules against the paper's numbers and formulas worked by hand."""

from math import inf

import numpy as np
import pytest

from training.lod.rules import band_mask, flod_bands, flod_s_min


def test_scale_constraints_are_the_published_ones():
    # methods: lambda 0.2, rho 4, five levels -> .2 / .05 / .0125 / .003125 / 0
    assert flod_s_min(0.2, 4, 5) == pytest.approx([0.2, 0.05, 0.0125, 0.003125, 0])


def test_one_level_has_no_constraint():
    assert flod_s_min(0.2, 4, 1) == [0.0]


def test_bands_of_levels_three_to_five():
    # d_proj(l) = s_min(l) / gamma * f: level 4 at 0.003125 / 0.5 * 800 = 5, level 3 at 20
    bands = flod_bands([0.2, 0.05, 0.0125, 0.003125, 0], focal_px=800, gamma=0.5, start=3, end=5)
    assert bands[:2] == [(inf, inf), (inf, inf)]
    assert bands[2] == (pytest.approx(20), inf)
    assert bands[3] == (pytest.approx(5), pytest.approx(20))
    assert bands[4] == (0.0, pytest.approx(5))


@pytest.mark.parametrize("start, end", [(1, 5), (2, 4), (3, 3), (5, 5)])
def test_every_distance_belongs_to_exactly_one_level(start, end):
    bands = flod_bands(flod_s_min(0.3, 3, 5), 500, 2.0, start, end)
    borders = [border for band in bands for border in band if 0 < border < inf]
    distances = np.concatenate([np.linspace(0, 200, 1001), borders])
    assert (sum(band_mask(distances, *band).astype(int) for band in bands) == 1).all()


def test_a_larger_gamma_brings_coarser_levels_nearer():
    near = [flod_bands(flod_s_min(0.2, 4, 5), 800, gamma, 3, 5)[2][0] for gamma in (0.5, 1, 2)]
    assert near == pytest.approx([20, 10, 5])


@pytest.mark.parametrize("start, end, gamma", [(0, 3, 1), (4, 3, 1), (1, 6, 1), (1, 5, 0)])
def test_impossible_ranges_are_refused(start, end, gamma):
    with pytest.raises(ValueError):
        flod_bands(flod_s_min(0.2, 4, 5), 800, gamma, start, end)
