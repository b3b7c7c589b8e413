"""Simplified splats of moving views."""

from types import SimpleNamespace

import numpy as np
import pytest


@pytest.mark.parametrize(
    ("cost", "motion_cost", "expected"), [(0.02, 0.0, 1.0), (0.1, 0.0, 0.5), (0.02, 0.1, 0.5)]
)
def test_only_slow_views_move_at_a_lower_resolution(lodgs, cost, motion_cost, expected):
    view = lodgs("viewport.view_state").ViewState(cost=(9, cost), motion_cost=(9, motion_cost))
    assert view.motion_resolution(0.5) == 1.0
    view.moving = True
    assert view.motion_resolution(0.5) == expected


def make_instances(count, seed=0):
    instances = np.zeros((count, 4), np.float32)
    instances[:, 0] = np.random.default_rng(seed).permutation(count)
    instances[:, 1:] = 1.0, 2.0, 3.0
    return instances


@pytest.mark.parametrize("share", [0.5, 0.1, 0.01])
def test_kept_splats_cover_the_area_of_all(lodgs, share):
    count = 200_000
    areas = np.random.default_rng(1).lognormal(0, 1.5, count).astype(np.float32)
    instances = make_instances(count)
    order, kept = lodgs("viewport.motion").simplify(instances, areas, round(share * count))
    assert len(kept) == pytest.approx(share * count, rel=0.03)
    assert (np.diff(order) > 0).all()
    assert np.array_equal(kept[:, [0, 1, 3]], instances[order][:, [0, 1, 3]])
    shrinking = 1 - (kept[:, 2] - 2)
    assert ((shrinking > 0) & (shrinking <= 1)).all()
    assert (areas[order] / shrinking**2).sum(dtype=np.float64) == pytest.approx(
        areas.sum(dtype=np.float64), rel=0.03
    )
    large = areas.sum(dtype=np.float64) / (share * count)  # more than the mean of the kept ones
    assert (shrinking[areas[order] >= large] == 1).all()
    assert (areas[order] >= large).sum() == (areas >= large).sum() > 10


def test_splats_beside_the_view_count_less(lodgs):
    visibility = np.ones(3, np.float32)
    offsets = np.float32([(0, 0, -5), (5, 0, 0), (0, 0, 5)])
    lodgs("viewport.motion").dim_beside(visibility, offsets, (0.0, 0.0, 1.0))
    assert visibility[0] == 1 and (visibility[1:] < 0.5).all()


def test_a_busy_moment_hardly_changes_the_measured_speed(lodgs):
    """A slower view counts after some measurements."""
    view = lodgs("viewport.view_state").ViewState(count=1000)
    view.set_cost(0.1)
    view.set_cost(2.0)
    assert view.cost == (1000, 0.125)
    for _ in range(20):
        view.set_cost(2.0)
    assert view.cost == (1000, 2.0)
    view.set_cost(0.1)
    assert view.cost == (1000, 0.1)
    view.count = 3000
    view.set_cost(0.3)
    assert view.cost == (3000, 0.3)


@pytest.mark.parametrize(
    ("cost", "motion_cost", "limit"),
    [
        ((0, 0.0), (0, 0.0), None),
        ((1_000_000, 0.05), (0, 0.0), None),
        ((1_000_000, 0.8), (0, 0.0), 100_000),
        ((1_000_000, 0.8), (100_000, 0.02), 400_000),
        ((1_000_000, 0.2), (600_000, 0.04), None),
        ((1_000_000, 500.0), (0, 0.0), 50_000),
    ],
)
def test_limit_follows_the_measured_speed(lodgs, cost, motion_cost, limit):
    """A moving view spends 0.08 seconds on splats; the limit has one digit."""
    view = lodgs("viewport.view_state").ViewState(
        cost=cost, motion_cost=motion_cost, arrangement=SimpleNamespace(count=1_000_000)
    )
    assert view.motion_limit() == limit
