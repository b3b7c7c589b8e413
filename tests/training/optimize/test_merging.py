"""Tests of merging: moments by hand, mass, counts and the choice of pairs."""

import numpy as np
import pytest
from scipy.special import expit, logit

from training.optimize.merging import merge, optical_depth
from training.splats.gaussians import SH_C0, Splats, splat_area


def make(means, log_scales, opacities, colors) -> Splats:
    count = len(means)
    return Splats(
        np.array(means, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.array(log_scales, np.float32),
        logit(np.array(opacities)).astype(np.float32),
        ((np.array(colors, np.float32) - 0.5) / np.float32(SH_C0))[:, None, :],
        {"label": np.arange(count, dtype=np.uint8)},
    )


def masses(splats: Splats) -> np.ndarray:
    return optical_depth(expit(splats.opacity_logits.astype(float))) * splat_area(splats.log_scales)


def test_moments_of_two_splats():
    """Spheres of mass 1 : 3 at distance 4: mean at 3, variance s² + 1/4 · 3/4 · 4² along their line."""
    opacity = 0.1
    samples = np.linspace(1e-4, 0.5, 200_001)
    third = samples[np.argmin(abs(optical_depth(samples) - 3 * optical_depth(np.array([opacity]))))]
    two = make([[0, 0, 0], [4, 0, 0]], np.log(np.full((2, 3), 0.5)), [opacity, third], [[1, 0, 0], [0, 1, 0]])
    merged = merge(two, 1)
    np.testing.assert_allclose(merged.means, [[3, 0, 0]], atol=1e-3)
    np.testing.assert_allclose(np.sort(np.exp(merged.log_scales[0])), [0.5, 0.5, 3.25**0.5], rtol=1e-3)
    np.testing.assert_allclose(0.5 + SH_C0 * merged.sh[0, 0], [0.25, 0.75, 0], atol=1e-3)
    assert masses(merged)[0] == pytest.approx(masses(two).sum(), rel=1e-3)
    assert merged.extras["label"].tolist() == [1], "the value of the heavier splat"


@pytest.mark.parametrize("count", [0, 1, 37, 299, 300, 400])
def test_count_is_exact_and_mass_is_kept(count):
    rng = np.random.default_rng(0)
    splats = make(
        rng.normal(size=(300, 3)),
        rng.normal(-2.5, 0.4, (300, 3)),
        rng.uniform(0.02, 0.2, 300),
        rng.uniform(0, 1, (300, 3)),
    )
    merged = merge(splats, count)
    assert len(merged) == min(max(count, 1), 300)
    assert masses(merged).sum() == pytest.approx(masses(splats).sum(), rel=1e-3)
    center = masses(splats) @ splats.means / masses(splats).sum()
    np.testing.assert_allclose(masses(merged) @ merged.means / masses(merged).sum(), center, atol=1e-4)
    unmerged = {tuple(mean) for mean in splats.means.tolist()} & {tuple(m) for m in merged.means.tolist()}
    assert len(unmerged) >= 2 * len(merged) - 300


def test_equal_splats_merge_first():
    """Of three neighbours, the two of one colour merge."""
    row = make(
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        np.log(np.full((3, 3), 0.6)),
        [0.8] * 3,
        [[0.9, 0, 0], [0.9, 0, 0], [0, 0.9, 0]],
    )
    assert merge(row, 2).extras["label"].tolist() in ([0, 2], [1, 2])


def test_wire_before_wall_stays_thin():
    """Splats of a dark wire merge along it, not with the bright wall behind it."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 20)] * 2), axis=-1).reshape(-1, 2)
    wall = make(
        np.column_stack([grid, np.zeros(400)]),
        np.tile(np.log([0.1, 0.1, 0.01]), (400, 1)),
        [0.9] * 400,
        np.full((400, 3), 0.9),
    )
    wire = make(
        np.column_stack([np.linspace(-1, 1, 20), np.zeros(20), np.full(20, -0.1)]),
        np.tile(np.log([0.05, 0.02, 0.02]), (20, 1)),
        [0.9] * 20,
        np.full((20, 3), 0.1),
    )
    merged = merge(Splats.concatenated([wall, wire]), 210)
    dark = merged.sh[:, 0, 0] < 0
    assert masses(merged)[dark].sum() == pytest.approx(masses(wire).sum(), rel=1e-3)
    assert np.sort(np.exp(merged.log_scales[dark]))[:, :2].max() < 0.03


def test_equal_positions_merge():
    same = make(np.zeros((50, 3)), np.full((50, 3), -3), [0.5] * 50, np.full((50, 3), 0.4))
    merged = merge(same, 3)
    assert len(merged) == 3 and np.isfinite(merged.log_scales).all() and (merged.means == 0).all()
