"""Tests of CLoD-GS: formulas against float64 references, initial decays, and whole runs."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.lod.rule import collect_facts, rules
from training.lod.selection import resolve_controls, select
from training.methods import create, method_info
from training.methods.clod.train import ClodDrawing
from training.optimize.parameters import override
from training.rasterize import contributions
from training.splats.levels import Bundle


def make(data, base=None, preset="draft", **values):
    values = {"steps": 24, "begin": 0.5, "densify_until": 0.4, "prune_interval": 6, **values}
    return create("clod", data, override(method_info("clod").preset(preset), values), 0, "cpu", base)


def trained(clod, until=None):
    levels = []
    for step in range(until or clod.steps):
        clod.train_step(step)
        levels += clod.levels_after(step)
    return levels


def bundle_of(clod, levels) -> Bundle:
    return Bundle("clod", levels, "decay", clod.facts)


def test_steps_before_decay_equal_3dgs(data):
    values = {"steps": 24, "densify_until": 0.4, "prune_interval": 6, "margin": 0.0}
    plain = create("3dgs", data, override(method_info("3dgs").preset("draft"), values), 0, "cpu")
    clod = make(data, margin=0.0)
    for step in range(12):
        assert clod.train_step(step)[0] == plain.train_step(step)[0]
    assert torch.equal(clod.model["means"], plain.model["means"])
    assert clod.sigma.detach().unique().tolist() == pytest.approx([10.0])
    initial = len(clod.model)
    clod.train_step(12)
    assert len(clod.model) < initial and len(clod.sigma.detach().unique()) > initial / 4


def test_training_weights_equal_rule(data):
    """Attenuations and masks of a step equal the rule's results for the returned splats."""
    clod = make(data, keep_share=1.0)
    [level] = trained(clod)
    camera, rule = data.train[1], rules()["decay"]
    for s_v in (1.0, 2.5):
        falloff, _, drawn = clod.attenuate(camera, s_v)
        opacity = clod.model["opacity_logits"].sigmoid()
        columns = {"sigma_d": clod.sigma.detach().numpy(), "opacity": opacity.detach().numpy()}
        facts = collect_facts(rule, clod.facts, [(1, {})], 1)
        means = clod.model["means"].detach().numpy()
        values = {"s_v": s_v, "at_most": 0}
        expected = rule.weights(means, camera.center, camera.focal, columns, facts, values)
        contribution = (falloff * drawn).detach().numpy()
        assert (np.abs(contribution - expected) > 1e-5).sum() <= 1
    assert level.splats.extras["sigma_d"].shape == (len(level.splats),)


def test_count_uses_straight_through_gradient(data):
    clod = make(data)
    trained(clod, 13)
    camera, p = data.train[0], clod.parameters
    in_view = torch.from_numpy(camera.sees(clod.model["means"].detach().numpy(), near=data.near))
    assert 3 < in_view.sum() < len(in_view)
    opacities = torch.rand(len(in_view), dtype=torch.float64, requires_grad=True)
    s_v = 4.0
    drawn = opacities.detach() > p.tau * s_v
    excess = clod.count_excess(ClodDrawing(None, s_v, opacities, drawn, in_view))
    share = drawn[in_view].double().mean()
    target = (s_v / p.onset) ** -p.exponent
    assert share > target
    assert excess.item() == pytest.approx(9 * (share - target).item() ** 2)
    excess.backward()
    # d excess / d share times the mean's, times the sigmoid's of the logarithm, by hand
    margin = (opacities.detach() / (p.tau * s_v)).log() / p.count_softness
    slope = margin.sigmoid() * (1 - margin.sigmoid()) / p.count_softness / opacities.detach()
    expected = 18 * (share - target) / in_view.sum() * slope * in_view
    torch.testing.assert_close(opacities.grad, expected)
    few = clod.count_excess(ClodDrawing(None, s_v, opacities, torch.zeros_like(drawn), in_view))
    near = clod.count_excess(ClodDrawing(None, 1.9, opacities, torch.ones_like(drawn), in_view))
    assert few.item() == near.item() == 0


def test_initial_decays_follow_importance(data):
    clod = make(data, tau=0.004)
    trained(clod, 12)
    initial, p = clod.model["opacity_logits"].detach().sigmoid(), clod.parameters
    contribution = contributions(
        clod.model.gaussians.detach(), data.train, near=data.near, antialias=True, backend="cpu"
    )
    means = clod.model["means"].detach().numpy().copy()
    clod.begin_decay()
    # those that give most to the pixels of a view stay, as many as views draw 74 % of what they drew
    remaining = torch.from_numpy((means[:, None] == clod.model["means"].detach().numpy()[None]).all(2).any(1))
    views, importance = contribution.views.double(), contribution.total / contribution.views.clamp_min(1)
    assert importance[remaining].min() >= importance[~remaining].max()
    assert 0.6 < views[remaining].sum() / views.sum() <= 0.74

    distances = np.stack(
        [np.linalg.norm(means[remaining] - camera.center, axis=1) for camera in data.train], 1
    )
    in_view = np.stack([camera.sees(means[remaining], near=data.near) for camera in data.train], 1)
    subset = torch.from_numpy(in_view.any(1))
    mean = torch.from_numpy((distances * in_view).sum(1) / in_view.sum(1).clip(1) / clod.reference)
    nearest = torch.from_numpy(np.where(in_view, distances, np.inf).min(1) / clod.reference)
    alpha, sigma = clod.model["opacity_logits"].detach().sigmoid(), clod.sigma.detach()
    subset &= (sigma > 2e-3) & (sigma < 49) & (alpha < 0.989) & (alpha > 2e-4)
    # from its nearest view a splat looks as before ...
    visible = alpha * torch.exp(-(nearest**2) / (2 * sigma**2))
    assert subset.sum() > 5
    torch.testing.assert_close(visible[subset], initial[remaining].double()[subset], rtol=2e-3, atol=1e-5)
    # ... and from its mean one it is gone at the scale of its rank
    rank = (torch.argsort(torch.argsort(importance[remaining], descending=True, stable=True)) + 0.5) / int(
        remaining.sum()
    )
    vanishes = (p.onset * rank ** (-1 / p.exponent)).clamp(1.1, 50)
    edge = alpha * torch.exp(-((mean * vanishes) ** 2) / (2 * sigma**2))
    close = subset & (initial[remaining] > 1.06 * p.tau * vanishes)
    assert close.sum() > 5
    torch.testing.assert_close(edge[close], (p.tau * vanishes[close]).double(), rtol=2e-2, atol=0)


def test_reference_distance(data):
    points = data.scene.points
    visible = [
        np.linalg.norm(points[camera.sees(points, near=data.near)] - camera.center, axis=1)
        for camera in data.train
    ]
    clod = make(data, reference_quantile=0.9)
    assert clod.reference == pytest.approx(np.quantile(np.concatenate(visible), 0.9), rel=1e-5)
    published = make(data, reference_quantile=0.0)
    assert published.facts["reference"] == 0
    means = published.model["means"].detach().numpy()
    in_view = data.train[0].sees(means, near=data.near)
    assert published.normalized_distances(data.train[0])[in_view].max() == pytest.approx(1)


def test_prefixes_are_coarser_and_counts_fall_with_scale(data):
    clod = make(data)
    [level] = trained(clod)
    bundle, camera = bundle_of(clod, [level]), data.train[0]
    counts = []
    for s_v in (1.0, 2.0, 4.0):
        chosen, weights = select(bundle, camera.center, camera.focal, resolve_controls(bundle, {"s_v": s_v}))
        counts.append(len(chosen))
        assert weights is not None
    assert counts[0] > counts[1] > counts[2] > 0
    mean = np.zeros(len(level.splats))
    for view in data.train:
        rule, facts = rules()["decay"], collect_facts(rules()["decay"], clod.facts, [(1, {})], 1)
        opacity = 1 / (1 + np.exp(-level.splats.opacity_logits))
        columns = {"sigma_d": level.splats.extras["sigma_d"], "opacity": opacity}
        values = {"s_v": 1.0, "at_most": 0}
        mean += rule.weights(level.splats.means, view.center, view.focal, columns, facts, values)
    assert (np.diff(mean) <= 1e-4).all()


def test_undrawn_splats_are_removed(data):
    clod = make(data, keep_share=1.0)
    trained(clod, 13)
    subset = torch.arange(5)
    with torch.no_grad():
        clod.model["opacity_logits"][subset] = -6.0  # far below tau
    visible = clod.drawn_anywhere()
    assert not visible[subset].any() and visible.sum() > 5


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_base_starts_decay_without_new_splats(data, preset):
    first = make(data, steps=12, begin=1.0)
    [level] = trained(first)
    clod = make(data, base=level.splats, preset=preset, steps=4, prune_interval=0, opacity_reset_interval=0)
    assert len(clod.model) == len(level.splats)
    torch.testing.assert_close(clod.model["means"].detach(), torch.from_numpy(level.splats.means))
    trained(clod)
    assert len(clod.model) == len(level.splats) if preset == "paper" else len(clod.model) < len(level.splats)


def test_resume_keeps_decay(data):
    clod = make(data)
    trained(clod, 15)
    again = make(data)
    again.load_state_dict(deepcopy(clod.state_dict()))
    assert clod.train_step(15)[0] == again.train_step(15)[0]


def test_invalid_values_raise():
    draft = method_info("clod").preset("draft")
    for name, value in (("s_v_most", 0.5), ("exponent", 0), ("keep_share", 0), ("tau", 0), ("begin", 1.5)):
        with pytest.raises(LodgsError, match=name):
            override(draft, {name: value})


def test_published_distances_are_relative_to_the_farthest_splat_in_view(data):
    clod = make(data, preset="paper", steps=4, begin=0.0, **NO_RESETS)
    camera = data.train[2]
    means = clod.model["means"].detach().numpy()
    distances = np.linalg.norm(means - camera.center, axis=1)
    in_view = camera.sees(means, near=data.near)
    assert distances[~in_view].max() > distances[in_view].max()
    expected = distances / distances[in_view].max()
    np.testing.assert_allclose(clod.normalized_distances(camera), expected, rtol=1e-5)
    trained(clod)
    means = clod.model["means"].detach().numpy()
    reaches = [
        np.linalg.norm(means[view.sees(means, near=data.near)] - view.center, axis=1).max()
        for view in data.train
    ]
    assert clod.facts["reference"] == pytest.approx(np.median(reaches))


NO_RESETS = {"opacity_reset_interval": 0, "prune_interval": 0, "densify_until": 0.0}


def test_preset_paper_makes_detail_from_the_start(data):
    """Opacity halves at the median distance and scale √5, so that scale 5 draws a fraction of the splats."""
    clod = make(data, preset="paper", steps=6, begin=0.0, **NO_RESETS)
    ratios = []
    for camera in data.train:
        points = data.scene.points[camera.sees(data.scene.points, near=data.near)]
        distances = np.linalg.norm(points - camera.center, axis=1)
        ratios.append(distances / distances.max())
    median = np.median(np.concatenate(ratios))
    sigma = clod.sigma.detach().unique()
    assert np.exp(-(median**2) * 5 / (2 * float(sigma) ** 2)) == pytest.approx(0.5, abs=1e-5)
    trained(clod)
    with torch.no_grad():
        counts = [sum(clod.attenuate(view, s_v)[2].sum() for view in data.train) for s_v in (1.0, 2.0, 5.0)]
    assert counts[0] > counts[1] > counts[2] and counts[2] < 0.6 * counts[0]


def test_count_of_all_splats_and_ablations(data):
    """η of Eq. 3 is a fraction of all splats; Table 2 leaves out w_s = (s_v - 1)² or the regularization."""
    for values, weight in (({}, 9.0), ({"scale_weight": False}, 1.0)):
        clod = make(data, preset="paper", begin=0.0, **values)
        opacities = torch.linspace(0, 1, 40, dtype=torch.float64)
        drawn = opacities > 0.3
        in_view = torch.arange(40) < 5
        excess = clod.count_excess(ClodDrawing(None, 4.0, opacities, drawn, in_view))
        assert excess.item() == pytest.approx(weight * (28 / 40 - 4**-1.5) ** 2)
    assert make(data, count_weight=0.0).parameters.count_weight == 0


@pytest.mark.parametrize("prune_undrawn", [True, False])
def test_culling_of_undrawn_splats_is_a_parameter(data, prune_undrawn):
    values = {**NO_RESETS, "prune_interval": 2}
    clod = make(data, preset="paper", steps=4, begin=0.0, prune_undrawn=prune_undrawn, **values)
    trained(clod, 1)
    with torch.no_grad():
        clod.model["opacity_logits"][:5] = -6.0  # far below tau
    count = len(clod.model)
    clod.control_density(1)
    assert (len(clod.model) < count) == prune_undrawn
