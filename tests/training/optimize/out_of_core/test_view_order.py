"""Tests of the view order: probabilities, coverage of all views, reproducibility."""

import numpy as np
import pytest
from scipy.stats import chi2

from training.optimize.out_of_core.view_order import BLOCK, ViewOrder

CENTERS = np.random.default_rng(0).random((30, 3)) * (4, 1, 2)


def expected_probabilities(centers: np.ndarray, k: int, spread: float) -> np.ndarray:
    """Return P(j | i) as a dense matrix, by sorting all distances."""
    count = len(centers)
    w = np.linalg.norm(centers[:, None] - centers, axis=2)
    np.fill_diagonal(w, np.inf)
    near = np.argsort(w, axis=1)[:, :k]
    median = np.median(np.take_along_axis(w, near, 1))
    probabilities = np.zeros((count, count))
    np.put_along_axis(probabilities, near, 1 / (np.take_along_axis(w, near, 1) + spread * median), 1)
    return probabilities / probabilities.sum(1, keepdims=True)


@pytest.mark.parametrize(("k", "spread"), [(5, 1.0), (100, 0.2), (29, 5.0)])
def test_successors_follow_the_formula(k, spread):
    """Compare the probabilities, and test the counts of a walk by a chi-squared test at 0.001."""
    walk = ViewOrder(CENTERS, 3, neighbors=k, spread=spread)
    truth = expected_probabilities(CENTERS, min(k, 29), spread)
    dense = np.zeros_like(truth)
    np.put_along_axis(dense, walk.neighbors, walk.probabilities, 1)
    np.testing.assert_allclose(dense, truth, atol=1e-12)
    views = np.array([walk(step) for step in range(200 * BLOCK)]).reshape(-1, BLOCK)
    counts = np.zeros_like(truth)
    np.add.at(counts, (views[:, :-1].ravel(), views[:, 1:].ravel()), 1)
    assert not counts[truth == 0].any()
    expected = counts.sum(1, keepdims=True) * truth
    possible = expected > 0
    statistic = ((counts - expected)[possible] ** 2 / expected[possible]).sum()
    assert statistic < chi2.ppf(0.999, possible.sum() - len(CENTERS))


def test_consecutive_views_are_nearer_than_in_a_shuffle():
    rng = np.random.default_rng(1)
    centers = np.stack([np.linspace(0, 100, 400), rng.random(400), rng.random(400)], 1)
    walk = ViewOrder(centers, 0, neighbors=20)
    views = np.array([walk(step) for step in range(20 * BLOCK)])
    distances = np.linalg.norm(np.diff(centers[views], axis=0), axis=1)
    within = np.arange(1, len(views)) % BLOCK != 0
    assert distances[within].max() < 7 < np.mean(distances[~within])


def test_every_view_begins_equally_many_blocks():
    walk = ViewOrder(CENTERS, 1, neighbors=3)
    first = [walk(block * BLOCK) for block in range(3 * len(CENTERS))]
    for epoch in range(3):
        assert sorted(first[30 * epoch : 30 * epoch + 30]) == list(range(30))
    assert first[:30] != first[30:60]


def test_view_depends_only_on_step_and_seed():
    steps = np.random.default_rng(2).permutation(5 * BLOCK)
    walk, copy = ViewOrder(CENTERS, 7), ViewOrder(CENTERS, 7)
    views = [walk(step) for step in range(5 * BLOCK)]
    assert [copy(step) for step in steps] == [views[step] for step in steps]
    reseeded = ViewOrder(CENTERS, 8)
    assert [reseeded(step) for step in range(5 * BLOCK)] != views


def test_order_is_independent_of_scale():
    small, large = ViewOrder(CENTERS, 7), ViewOrder(1000 * CENTERS + 5, 7)
    np.testing.assert_allclose(small.probabilities, large.probabilities, rtol=1e-9)
    assert [small(step) for step in range(500)] == [large(step) for step in range(500)]


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_coincident_and_few_cameras(spread):
    """One camera, two cameras, all cameras in one position, and rigs of six."""
    assert {ViewOrder(np.zeros((1, 3)), 0, spread=spread)(step) for step in range(300)} == {0}
    pair = ViewOrder(np.eye(3)[:2], 0, spread=spread)
    assert [pair(step) for step in range(4)] in ([0, 1, 0, 1], [1, 0, 1, 0])
    coincident = ViewOrder(np.zeros((40, 3)), 0, neighbors=8, spread=spread)
    np.testing.assert_allclose(coincident.probabilities, 1 / 8)
    rigs = ViewOrder(np.repeat(CENTERS, 6, axis=0), 0, neighbors=10, spread=spread)
    for walk in (coincident, rigs):
        assert not (walk.neighbors == np.arange(len(walk.neighbors))[:, None]).any()
        assert all(len(set(row)) == len(row) for row in walk.neighbors.tolist())
        assert np.isfinite(walk.probabilities).all() and len({walk(step) for step in range(2000)}) > 20
