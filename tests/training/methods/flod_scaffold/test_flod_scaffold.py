"""Tests of FLoD on Scaffold-GS: constraints of baked levels, Eq. 5 between levels, voxels and schedules."""

import numpy as np
import pytest
import torch

from training.evaluate.views import Evaluation, full_detail_source
from training.methods.flod_scaffold import METHOD
from training.methods.flod_scaffold.train import Method, smallest_log_scale
from training.optimize.anchors.anchor_octree import visible_distances
from training.optimize.parameters import override
from training.splats.levels import Bundle


def make(data, preset="draft", **values) -> Method:
    values = {
        "levels": 3, "steps": [4, 4, 4], "coarsest": 40.0, "offsets": 3, "features": 8, "grow_interval": 2,
        "sh_degree": 1, "margin": 0.0, **values,
    }  # fmt: skip
    return Method(data, override(METHOD.preset(preset), values), seed=0, backend="cpu")


def trained(method, until=None):
    levels = []
    for step in range(until or method.steps):
        method.train_step(step)
        levels += method.levels_after(step)
    return levels


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_no_baked_splat_is_below_the_minimum_of_its_level(data, margin):
    """40 px exceed the distances of the points, so that the constraint binds. Exact in float64."""
    method = make(data, margin=margin)
    levels = trained(method)
    assert [level.number for level in levels] == [1, 2, 3]
    assert [level.facts["s_min"] for level in levels] == method.s_min
    assert method.s_min == [pytest.approx(40 * data.median_depth / data.focal * x) for x in (1, 0.25, 0)]
    for level in levels:
        assert len(level.splats) and not level.splats.extras
        assert np.exp(level.splats.log_scales.astype(np.float64)).min() >= level.facts["s_min"]
    assert np.exp(levels[0].splats.log_scales).min() < 1.3 * method.s_min[0]
    assert np.exp(levels[2].splats.log_scales).min() < method.s_min[1]


def test_quality_rises_by_level(data):
    """Five levels with minimum sizes of 40, 10, 2.5, 0.6 and 0 pixels."""
    method = make(data, levels=5, steps=[10, 10, 10, 10, 20], grow_interval=5)
    bundle = Bundle("flod_scaffold", trained(method), "bands", method.facts, method.controls)
    evaluation = Evaluation(data, "cpu")
    quality = [
        evaluation.compare_views(data.train, full_detail_source(bundle, level)).mean()
        for level in bundle.levels
    ]
    assert len(quality) == 5
    assert quality == sorted(quality) and quality[-1] > quality[0] + 2


@pytest.mark.parametrize("s_min", [0.48846706814502583, 1e-7, 3.0, 0.0])
def test_smallest_log_scale(s_min):
    log_scale = smallest_log_scale(s_min)
    assert log_scale.dtype == np.float32 and np.exp(np.float64(log_scale)) >= s_min
    if s_min:
        assert np.exp(np.float64(log_scale)) == pytest.approx(s_min, rel=1e-5)


def test_image_is_continuous_between_levels(data):
    """Eq. 5: Gaussians with own looks keep all scales; new anchors at points are faint."""
    method = make(data, steps=[6, 4, 4], max_splats=0, least_weight=0.0)
    trained(method, 5)
    method.train_step(5)
    camera, old = data.train[0], method.model
    anchors = torch.arange(len(old))
    with torch.no_grad():
        first = method.decoder.decode(old, camera, anchors)
        assert len(method.levels_after(5)) == 1 and method.level == 2
        second = method.decoder.decode(method.model, camera, anchors)
    assert method.decoder.min_scale == method.s_min[1] < method.s_min[0]
    for name in ("means", "quats", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(second, name), getattr(first, name), rtol=2e-4, atol=1e-6)
    assert len(method.model) > len(old)
    assert (
        not method.model.adam.state_dict()["step"].any() if "step" in method.model.adam.state_dict() else True
    )


def test_disabled_gaussians_restart_in_the_next_level(data):
    """Otherwise the voxel of their anchor would remain empty in all finer levels."""
    method = make(data, steps=[6, 4, 4])
    trained(method, 5)
    method.train_step(5)
    looks, offsets = (method.model[name].detach().clone() for name in ("looks", "offsets"))
    disabled = looks[..., 0] < -15
    assert disabled.any() and not disabled.all()
    method.levels_after(5)
    opacity, new_offsets = method.model["looks"][: len(looks), :, 0], method.model["offsets"][: len(looks)]
    torch.testing.assert_close(opacity[disabled].sigmoid(), torch.full((int(disabled.sum()),), 0.1))
    assert torch.equal(opacity[~disabled], looks[..., 0][~disabled])
    assert torch.equal(new_offsets[~disabled], offsets[~disabled])
    assert (new_offsets[disabled].abs() <= 0.5).all()
    assert method.splats >= looks[..., 0].numel()


def test_published_networks_keep_the_mean_scale_of_an_anchor(data):
    method = make(data, preset="paper", steps=[4, 4, 4], grow_from=0, stats_from=0)
    trained(method, 3)
    method.train_step(3)

    def means() -> torch.Tensor:
        with torch.no_grad():
            extents = method.model["log_scales"][:, None, 3:].exp()
            return (extents * method.decoder.relative_scales(method.model) + method.decoder.min_scale).mean(1)

    before = means()
    method.levels_after(3)
    torch.testing.assert_close(means()[: len(before)], before, rtol=1e-4, atol=0)


def test_voxels_are_at_least_the_minimum_size(data):
    method = make(data)
    distances = np.concatenate(visible_distances(data.full_scene.points, data.full_train, data.focal))
    base = method.parameters.footprint * np.quantile(distances, method.parameters.nearest) / data.focal
    for number in (1, 2, 3):
        assert method.schedule.tree.voxel == pytest.approx(max(base, method.s_min[number - 1]))
        assert method.schedule.tree.levels == 1 and (method.model.columns["level"] == 1).all()
        if number < 3:
            method.start_level(number + 1)
            cells = method.schedule.tree.keys(method.model.read("means").double().numpy(), 1)
            points = method.start_anchors()["means"].double().numpy()
            assert np.isin(method.schedule.tree.keys(points, 1), cells).all(), "every point has an anchor"


def test_levels_respect_their_budgets(data):
    method = make(data, max_splats=120, budget_ratio=0.5, coarsest=2.0)
    counts = [len(method.model)]
    for number in (2, 3):
        method.start_level(number)
        counts.append(len(method.model))
    assert counts[0] <= 10 and counts[1] == 20 and counts[2] == 40  # 3 Gaussians per anchor: 30, 60 and 120


def test_levels_need_no_growth(data):
    method = make(data, grow_until=0.0)
    assert [level.number for level in trained(method)] == [1, 2, 3]


def test_levels_have_an_anchor_with_few_splats(data):
    method = make(data, max_splats=20, budget_ratio=0.1)
    levels = trained(method)
    assert [level.number for level in levels] == [1, 2, 3]
    assert len(levels[0].splats) <= len(levels[2].splats) <= 20


def test_schedule_restarts_at_each_level(data):
    """Growth, statistics and learning rates follow the steps of the level."""
    method = make(data, preset="paper", steps=[6000] * 3, grow_interval=[500, 500, 200])
    paper = METHOD.preset("paper")
    assert paper.total_steps == 100_000
    grown: list[int] = []
    method.grow = lambda step: grown.append(step + 1)
    for number, (begin, interval, until) in enumerate(
        zip((0, 6000, 12_000), (500, 500, 200), (0.399, 0.399, 0.499), strict=True), 1
    ):
        method._use_level(number)
        method.start_anchors()
        grown.clear()
        steps = range(begin, begin + method.run_parameters.steps[number - 1])
        for step in steps:
            assert method.level_at(step) == number
            method.control_density(step)
        last = until * len(steps)
        assert grown == [n for n in range(interval, len(steps), interval) if 1500 < n <= last]
        method.set_learning_rates(begin)
        assert method.model.adam.lr["offsets"] == pytest.approx(1e-2 * data.extent)


def test_resume_is_bit_identical(data, check_resumed):
    check_resumed(lambda: make(data, appearance=2), 3, 4, 9)


def test_single_level_is_scaffold_gs(data):
    method = make(data, levels=1, steps=[4])
    assert method.s_min == [0.0] and not method.controls
    assert [level.number for level in trained(method)] == [1]
