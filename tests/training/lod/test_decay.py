"""CLoD-GS's rule: Eq. 2 and mask by hand, budget by counting."""

from itertools import pairwise
from math import exp, log

import numpy as np
import pytest

from training.evaluate.views import full_detail_source
from training.lod.rule import rules
from training.lod.rules.decay import attenuation, max_visible_scale
from training.runs.base import read_base
from training.scenes.cameras import Camera
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

DECAY = rules()["decay"]
FACTS = {"reference": 8.0, "tau": 0.004, "level": 1, "levels": 1}


def scene(count=4000, seed=0):
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 5, (count, 3)).astype(np.float32)
    columns = {
        "sigma_d": rng.uniform(-0.2, 2, count).astype(np.float32),
        "opacity": rng.uniform(0, 1, count).astype(np.float32),
    }
    return means, columns


def weights(means, columns, s_v=1.0, at_most=0, facts=FACTS, position=(0, 0, 0)):
    values = {"s_v": s_v, "at_most": at_most}
    return DECAY.weights(means, np.array(position), 500.0, columns, facts, values)


def test_attenuation_matches_equation_2():
    # 4 units away of 8: d' = 0.5; s_v = 2, sigma 0.8: exp(-(0.5 * 2)^2 / (2 * 0.64 + 1e-8))
    means = np.float32([[4, 0, 0], [4, 0, 0], [4, 0, 0], [4, 0, 0]])
    falloff = exp(-1 / 1.28)
    edge = 0.004 * 2 / falloff  # the opacity that just meets tau * s_v
    columns = {
        "sigma_d": np.float32([0.8, 0.8, 0.8, -1]),
        "opacity": np.float32([1, edge * 1.01, edge * 0.99, 1]),
    }
    assert weights(means, columns, 2.0).tolist() == pytest.approx([falloff, falloff, 0, 0])


def test_position_matters_and_focal_length_does_not():
    means, columns = scene()
    values = {"s_v": 2.0, "at_most": 0}
    near, far = (DECAY.weights(means, np.zeros(3), focal, columns, FACTS, values) for focal in (100, 900))
    np.testing.assert_array_equal(near, far)
    assert (weights(means, columns, position=(50, 0, 0)) > 0).sum() < (weights(means, columns) > 0).sum()


def test_default_reference_is_the_farthest_splat():
    means, columns = scene()
    farthest = np.linalg.norm(means, axis=1).max()
    published = weights(means, columns, 2.0, facts=FACTS | {"reference": 0.0})
    stored = weights(means, columns, 2.0, facts=FACTS | {"reference": farthest})
    np.testing.assert_allclose(published, stored, rtol=1e-5)


def test_larger_scale_selects_a_subset():
    means, columns = scene()
    selected = [weights(means, columns, s_v) > 0 for s_v in (1, 1.5, 2, 3, 5, 20)]
    for more, less in pairwise(selected):
        assert less.sum() < more.sum() and not (less & ~more).any()


def test_max_visible_scale_is_where_opacity_meets_the_threshold():
    means, columns = scene()
    normalized = (np.linalg.norm(means, axis=1) / 8).astype(np.float32)
    sigma, opacity = columns["sigma_d"], columns["opacity"]
    limit = max_visible_scale(normalized, sigma, opacity, 0.004).astype(np.float64)
    subset = (sigma > 0.01) & (opacity > 0.01)
    attenuated = opacity * attenuation(normalized.astype(np.float64), sigma.astype(np.float64), limit)
    np.testing.assert_allclose(np.log(attenuated[subset]), np.log(0.004 * limit[subset]), atol=1e-4)
    assert np.isfinite(limit).all()


@pytest.mark.parametrize("at_most", [1, 7, 500, 1500])
@pytest.mark.parametrize("position", [(0, 0, 0), (30, 1, 2)])
def test_budget_keeps_the_splats_with_the_largest_limits(at_most, position):
    means, columns = scene()
    total = (weights(means, columns, position=position) > 0).sum()
    selected = weights(means, columns, at_most=at_most, position=position) > 0
    assert min(at_most, total) - 2 <= selected.sum() <= at_most
    normalized = DECAY.normalized(means, np.float32(position), FACTS)
    limit = max_visible_scale(normalized, columns["sigma_d"], columns["opacity"], 0.004)
    assert limit[selected].min() >= limit[~selected].max() * (1 - 1e-4)


def test_sufficient_budget_changes_nothing():
    means, columns = scene()
    for at_most in (0, 4000, 10**6):
        np.testing.assert_array_equal(weights(means, columns, 2.0, at_most), weights(means, columns, 2.0))


def test_coarser_values_raise_the_scale():
    values = {"s_v": 1.0, "at_most": 0}
    steps = 0
    while (values := DECAY.coarser(values, [1])) is not None:
        assert values["at_most"] == 0 and values["s_v"] <= 100
        steps += 1
    assert steps == int(log(100) / log(1.25))


def test_base_and_full_detail_apply_the_weights(tmp_path):
    """Raw opacities differ from the trained scene: a base applies weights of the mean camera."""
    means, columns = scene(300)
    splats = Splats(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (300, 1)),
        np.full((300, 3), -3, np.float32),
        np.log(columns["opacity"] / (1 - columns["opacity"])).astype(np.float32),
        np.zeros((300, 1, 3), np.float32),
        {"sigma_d": columns["sigma_d"]},
    )
    meta = {"camera_center": [2.0, 0.0, 0.0]}
    bundle = Bundle("clod", [Level(1, splats)], "decay", FACTS, meta=meta)
    write_bundle(tmp_path / "a.ply", bundle)
    base, _ = read_base(tmp_path / "a.ply")
    by_rule = weights(means, columns, position=(2, 0, 0))
    expected = (by_rule * columns["opacity"])[by_rule > 0]
    assert 0 < len(expected) < 300 and len(base) == len(expected)
    np.testing.assert_allclose(1 / (1 + np.exp(-base.opacity_logits)), expected, rtol=1e-4)
    camera = Camera("a", 64, 64, 100.0, 100.0, 32.0, 32.0, np.eye(4))
    visible, fixed = full_detail_source(bundle, bundle.levels[-1])(camera)
    np.testing.assert_allclose(fixed, weights(means, columns), rtol=1e-4)
    assert len(visible) == len(fixed) == 300


def test_only_the_finest_level_is_drawn():
    from training.lod.selection import resolve_controls, select_levels
    from training.splats.levels import Bundle, Level

    means, columns = scene(50)
    splats = Splats(
        means, np.ones((50, 4), np.float32), np.zeros((50, 3), np.float32), np.zeros(50, np.float32),
        np.zeros((50, 1, 3), np.float32), {"sigma_d": columns["sigma_d"]},
    )  # fmt: skip
    single = Bundle("clod", [Level(3, splats)], "decay", {"reference": 8.0, "tau": 0.004})
    several = Bundle("clod", [Level(1, splats), Level(3, splats)], "decay", single.facts)
    (expected,), (coarse, fine) = (
        select_levels(first, np.zeros(3), 500.0, resolve_controls(first, {})) for first in (single, several)
    )
    assert len(coarse.splats) == 0 and len(fine.splats) == len(expected.splats) > 0
    np.testing.assert_array_equal(fine.weights, expected.weights)


@pytest.mark.filterwarnings("error")
def test_threshold_of_zero_gives_no_warning():
    count = 3000
    means, columns = scene(count)
    values = {"s_v": 1.0, "at_most": count // 2}
    weights = DECAY.weights(means, np.zeros(3), 500.0, columns, FACTS | {"tau": 0.0}, values)
    assert 0 < np.count_nonzero(weights) <= count // 2
    splats = Splats(
        means, np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32), np.zeros((count, 1, 3), np.float32), {"sigma_d": columns["sigma_d"]},
    )  # fmt: skip
    bundle = Bundle("clod", [Level(1, splats)], "decay", {"reference": 8.0, "tau": 0.0})
    assert all(np.isfinite(level.facts["d_l"]) for level in DECAY.nested_levels(bundle).levels)
