"""Tests of CLoD-GS: formulas against float64 references, initial decays, and whole runs."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.evaluate.views import Evaluation
from training.lod.rule import collect_facts, rules
from training.lod.selection import resolve_controls, select
from training.methods import create, method_info
from training.methods.clod.train import ClodDrawing
from training.optimize.parameters import override
from training.rasterize import contributions
from training.rasterize.resident import ResidentBundle
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
        assert clod.train_step(step).loss() == plain.train_step(step).loss()
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
    # by hand: derivatives of the excess, of the mean and of the sigmoid of the logarithm
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
    # the most important splats remain; views draw 74 % of the previous number of splats
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
    # in its nearest view, a splat keeps its opacity
    visible = alpha * torch.exp(-(nearest**2) / (2 * sigma**2))
    assert subset.sum() > 5
    torch.testing.assert_close(visible[subset], initial[remaining].double()[subset], rtol=2e-3, atol=1e-5)
    # at its mean distance, it vanishes at the scale of its rank
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
    assert published.facts["reference"] == pytest.approx(
        max(distances.max() for distances in visible), rel=1e-5
    )


def test_published_distances_are_relative_to_the_farthest_splat_in_view(data):
    """d′ of Sec. 3.2 by hand in a step; the bundle uses the mean of the farthest distances for all views."""
    clod = make(data, preset="paper", steps=13)
    [level] = trained(clod)
    means, sigma = (clod.model[name].detach().numpy().astype(float) for name in ("means", "sigma_d"))
    opacity, farthest = clod.model["opacity_logits"].detach().double().sigmoid().numpy(), []
    beyond = []
    for camera in data.train:
        distances = np.linalg.norm(means - camera.center, axis=1)
        farthest.append(distances[camera.sees(means, near=data.near)].max())
        beyond.append(distances.max() - farthest[-1])
        falloff = np.exp(-((distances / farthest[-1] * 2.5) ** 2) / (2 * sigma.clip(0) ** 2 + 1e-8))
        actual, _, drawn = clod.attenuate(camera, 2.5)
        np.testing.assert_allclose(actual.detach(), falloff, rtol=1e-3, atol=1e-7)
        assert (drawn.numpy() != (opacity * falloff > 2.5 / 255)).sum() <= 1
    assert max(beyond) > 0  # splats outside the view do not count
    distances = np.linalg.norm(level.splats.means - data.train[0].center, axis=1)
    rule, values = rules()["decay"], {"s_v": 2.5, "at_most": 0}
    stored = level.splats.extras["sigma_d"]
    columns = {"sigma_d": stored, "opacity": np.ones(len(stored), np.float32)}
    assert clod.facts == make(data, preset="paper").facts  # so that all cells of a run agree
    facts = collect_facts(rule, clod.facts, [(1, {})], 1)
    weights = rule.weights(level.splats.means, data.train[0].center, 1.0, columns, facts, values)
    trained_sigma = stored.astype(float) * clod.facts["reference"] / np.mean(farthest)
    np.testing.assert_allclose(np.sort(trained_sigma), np.sort(sigma), rtol=1e-5)
    expected = np.exp(-((distances / np.mean(farthest) * 2.5) ** 2) / (2 * trained_sigma.clip(0) ** 2 + 1e-8))
    np.testing.assert_allclose(weights, np.where(expected > 2.5 / 255, expected, 0), rtol=1e-3, atol=1e-6)


def test_published_decay_halves_opacities_at_the_middle_scale(data):
    """At the mean distance of its views, each splat has half of its opacity at the scale √5 of 1 to 5."""
    clod = make(data, preset="paper", steps=12, begin=1.0)
    trained(clod)
    clod.begin_decay()
    means = clod.model["means"].detach().numpy()
    distances = np.stack([np.linalg.norm(means - camera.center, axis=1) for camera in data.train], 1)
    in_view = np.stack([camera.sees(means, near=data.near) for camera in data.train], 1)
    farthest = np.mean([distances[visible, view].max() for view, visible in enumerate(in_view.T)])
    distance = (distances * in_view).sum(1) / in_view.sum(1).clip(1) / farthest
    subset = in_view.any(1)
    falloff = np.exp(-5 * distance[subset] ** 2 / (2 * clod.sigma.detach().numpy()[subset] ** 2))
    assert subset.sum() > 20
    np.testing.assert_allclose(falloff, 0.5, rtol=1e-4)


@pytest.mark.parametrize(("ablation", "weight"), [({}, 9), ({"scale_weight": False}, 1)])
def test_published_count_is_of_all_splats(data, ablation, weight):
    """Eq. 3 by hand: 30 of 40 splats at s_v = 4, target 4^-1.5 = 1/8; w_s = 9, or 1 in Table 2's ablation."""
    clod = make(data, preset="paper", **ablation)
    opacities = torch.where(torch.arange(40) < 30, 0.5, 1e-6)
    drawing = ClodDrawing(None, 4.0, opacities, opacities > 4 / 255, torch.arange(40) >= 35)
    assert clod.count_excess(drawing).item() == pytest.approx(weight * (30 / 40 - 1 / 8) ** 2)


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_published_count_trains_decays_only(data, preset):
    clod = make(data, preset=preset, onset=1.0)
    trained(clod, 13)
    camera = data.train[0]
    _, attenuated, drawn = clod.attenuate(camera, 5.0)
    all_splats = torch.ones_like(drawn)
    clod.model.adam.zero_grad()
    clod.count_excess(ClodDrawing(None, 5.0, attenuated, all_splats, all_splats)).backward()
    assert clod.model["sigma_d"].grad.abs().sum() > 0
    gradient = clod.model["opacity_logits"].grad
    assert (gradient is None or not gradient.any()) == (preset == "paper")


def test_loss_without_count_weight_is_that_of_the_images(data):
    """Table 2 without L_reg: the loss is the sum of both images' losses."""
    clod = make(data, preset="paper", count_weight=0.0)
    trained(clod, 13)
    view = clod.choose_view(13)
    first, scaled = clod.draw(view, 13)
    separate = [super(type(clod), clod).loss([drawing], view, 13) for drawing in (first, scaled)]
    assert clod.loss([first, scaled], view, 13).item() == pytest.approx(sum(separate).item())


@pytest.mark.slow
def test_paper_preset_makes_continuous_levels(data):
    """Fewer than 60 % of the splats remain at s_v = 5, and quality falls with them."""
    clod = make(data, preset="paper", steps=80, begin=1 / 6, lr_means_steps=80, sh_interval=30)
    bundle = bundle_of(clod, trained(clod))
    resident, evaluation = ResidentBundle(bundle, "cpu"), Evaluation(data, "cpu")
    evaluation.cameras = data.train
    rows = [evaluation.measure_by_distance(resident, {"s_v": s_v, "at_most": 0}) for s_v in (1, 1.5, 2, 3, 5)]
    counts, quality = ([row[name] for row in rows] for name in ("splats", "psnr"))
    assert 0 < counts[-1] < 0.6 * counts[0]
    assert counts == sorted(counts, reverse=True) and quality == sorted(quality, reverse=True)
    assert len(set(counts)) >= 4


def test_published_preset_keeps_undrawn_splats(data):
    for cull, remaining in ((False, True), (True, False)):
        clod = make(data, preset="paper", steps=24, begin=0.5, densify_until=0.0, prune_undrawn=cull)
        trained(clod, 17)
        initial = len(clod.model)
        with torch.no_grad():
            clod.model["sigma_d"][:5] = -1.0  # never drawn again
        clod.train_step(17)  # step 18 removes splats
        assert (len(clod.model) == initial) == remaining


def test_splats_that_eq_2_never_draws_are_not_stored(data):
    """ReLU(σ) = 0 leaves exp(-d'² / ε): such splats vanish at every distance, and get no gradient."""
    clod = make(data, preset="paper", steps=24, begin=0.5, densify_until=0.0)
    trained(clod, 22)
    with torch.no_grad():
        clod.model["sigma_d"][:5] = -1.0
    dead, count = clod.model["means"].detach()[:5].clone(), len(clod.model)
    clod.train_step(22)
    clod.train_step(23)
    [level] = clod.levels_after(23)
    assert level.splats.extras["sigma_d"].min() > 0 and len(level.splats) <= count - 5
    assert not np.isin(level.splats.means[:, 0], dead[:, 0].numpy()).any()
    with torch.no_grad():
        clod.model["sigma_d"].fill_(-1.0)
    with pytest.raises(LodgsError, match="lr_sigma"):
        clod.levels_after(23)


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
    resumed = make(data)
    resumed.load_state_dict(deepcopy(clod.state_dict()))
    assert clod.train_step(15).loss() == resumed.train_step(15).loss()


def test_invalid_values_raise():
    draft = method_info("clod").preset("draft")
    for name, value in (("s_v_most", 0.5), ("exponent", 0), ("keep_share", 0), ("tau", 0), ("begin", 1.5)):
        with pytest.raises(LodgsError, match=name):
            override(draft, {name: value})
