"""Tests of cloning, splitting and pruning splats with any columns."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from training.optimize.density_control import (
    constrained_log_scales,
    densify,
    peak_scores,
    prune,
    prune_oversized,
    reset_opacities,
)
from training.optimize.model import NAMES, Model

ALL = (*NAMES, "decay")


def test_small_splats_are_cloned_in_place(model, moments):
    parents = {name: model[name].detach().clone() for name in ALL}
    gradients = torch.zeros(50)
    gradients[[4, 7]] = 1.0
    added = densify(
        model, gradients, threshold=0.5, clone_below=1e9, max_splats=1000, min_scale=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert added == 2 and len(model) == 52
    for name in ALL:
        assert torch.equal(model[name][:50], parents[name])
        assert torch.equal(model[name][50:], parents[name][[4, 7]])
        assert moments(model, name, 0)[50:].tolist() == [0, 0]
        assert torch.equal(moments(model, name, 0)[:50], torch.arange(1.0, 51.0))


def test_large_splats_are_split_at_random_positions_inside(model):
    model.assign("log_scales", torch.log(torch.tensor([[0.5, 1.0, 2.0]])).repeat(50, 1))
    # a rotation by 90 degrees about z: the splat's x axis is the world's y axis
    model.assign(
        "quats", torch.tensor([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], dtype=torch.float32).repeat(50, 1)
    )
    parents = model["means"].detach().clone()
    gradients = torch.ones(50)
    offsets = []
    for seed in range(40):
        copy = Model({name: model[name].detach().clone() for name in ALL}, model.adam.lr)
        densify(
            copy, gradients, threshold=0.5, clone_below=0.0, max_splats=1000, min_scale=0.1,
            rng=np.random.default_rng(seed),
        )  # fmt: skip
        assert len(copy) == 100
        assert copy["decay"].tolist() == [*range(10, 60)] * 2
        # FLoD: child scale + s_min = parent scale / 1.6, with the constrained scale
        expected = (torch.tensor([0.5, 1.0, 2.0]) + 0.1) / 1.6
        torch.testing.assert_close(copy["log_scales"].exp() + 0.1, expected.repeat(100, 1))
        offsets.append((copy["means"].detach() - parents.repeat(2, 1)).numpy())
    spread = np.concatenate(offsets).std(0)
    np.testing.assert_allclose(spread, [1.1, 0.6, 2.1], rtol=0.05)


def test_split_along_the_longest_axis_preserves_appearance(model, moments):
    """Positions, scales and opacity follow the formulas of Improved-GS."""
    model.assign("log_scales", torch.log(torch.tensor([[0.05, 0.4, 0.1]])).repeat(50, 1))
    # a rotation by 90 degrees about z: the splat's y axis is the world's -x axis
    rotation = torch.tensor([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], dtype=torch.float32)
    model.assign("quats", rotation.repeat(50, 1))
    model.assign("opacity_logits", torch.full((50,), 0.5).logit())
    parent = {name: model[name].detach()[7].clone() for name in ALL}
    gradients = torch.zeros(50)
    gradients[7] = 1.0
    added = densify(
        model, gradients, threshold=0.5, clone_below=None, max_splats=1000, rng=np.random.default_rng(0)
    )
    assert added == 1 and len(model) == 51 and not (model["decay"][:49] == 17).any()
    children = {name: model[name].detach()[49:] for name in ALL}
    offsets = children["means"] - parent["means"]
    torch.testing.assert_close(offsets, torch.tensor([[-0.54, 0, 0], [0.54, 0, 0]]), atol=1e-5, rtol=0)
    narrow = np.sqrt(1 - 0.45**2)
    expected = torch.tensor([[0.05 * narrow, 0.4 * 0.55, 0.1 * narrow]], dtype=torch.float32)
    torch.testing.assert_close(children["log_scales"].exp(), expected.repeat(2, 1))
    torch.testing.assert_close(children["opacity_logits"].sigmoid(), torch.full((2,), 0.3))
    for name in ("quats", "sh", "decay"):
        assert torch.equal(children[name], torch.stack([parent[name]] * 2))
    assert moments(model, "means", 0)[49:].tolist() == [0, 0]


def test_split_along_the_longest_axis_keeps_the_constraint_of_flod(model):
    model.assign("log_scales", torch.log(torch.tensor([[0.5, 1.0, 2.0]])).repeat(50, 1))
    densify(
        model, torch.ones(50), threshold=0.5, clone_below=None, max_splats=1000, min_scale=0.1,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    narrow = np.sqrt(1 - 0.45**2)
    expected = torch.tensor([0.6 * narrow, 1.1 * narrow, 2.1 * 0.55], dtype=torch.float32)
    torch.testing.assert_close(model["log_scales"].exp() + 0.1, expected.repeat(100, 1))


def test_largest_gradients_are_densified_first(model):
    gradients = torch.linspace(0, 1, 50)
    means = model["means"].detach().clone()
    added = densify(
        model, gradients, threshold=0.1, clone_below=1e9, max_splats=53, min_scale=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert added == 3
    assert torch.equal(model["means"][50:], means[[47, 48, 49]])


def test_peak_scores_match_equation_6():
    """Two views computed by hand, with the largest gradient and radius in different views."""
    tensors = {"means": torch.zeros(3, 3), "opacity_logits": torch.tensor([0.0, 0.0, -10.0])}
    model = Model(tensors, dict.fromkeys(tensors, 0.0), peaks=True)
    views = (
        ([[3e-4, 4e-4], [0.0, 1e-3], [3e-4, 4e-4]], [8.0, 0.0, 40.0]),
        ([[0.0, -1e-4], [0.0, 0.0], [0.0, 0.0]], [20.0, 15.0, 0.0]),
    )
    for gradients, radii in views:
        rendering = SimpleNamespace(grad2d=torch.tensor(gradients), radii=torch.tensor(radii))
        model.accumulate_stats(rendering)
    faint = 1 / (1 + np.exp(10.0))
    expected = [5e-4 * 20 * 0.5**0.2, 1e-3 * 15 * 0.5**0.2, 5e-4 * 40 * faint**0.2]
    np.testing.assert_allclose(peak_scores(model), expected, rtol=1e-6)
    # an image of half the side has gradients twice as large, which are scaled down
    shrunk = SimpleNamespace(grad2d=torch.tensor([[0.0, 2e-3]] * 3), radii=torch.tensor([1.0] * 3))
    model.accumulate_stats(shrunk, shrink=2)
    np.testing.assert_allclose(model.stats["gradient_max"], [1e-3] * 3, rtol=1e-6)
    model.reset_stats()
    assert not peak_scores(model).any()


def test_constrained_log_scales_invert_the_constraint_above_a_floor():
    scales = torch.tensor([0.5, 0.2])
    torch.testing.assert_close(constrained_log_scales(scales, 0.1).exp() + 0.1, scales)
    assert constrained_log_scales(torch.tensor([0.05]), 0.1).exp().item() == pytest.approx(0.005)


def test_pruning_removes_splats_below_the_opacity(model):
    model.assign("opacity_logits", torch.logit(torch.linspace(0.01, 0.99, 50)))
    prune(model, 0.5)
    assert model["decay"].tolist() == [*range(35, 60)]


def test_opacity_reset_limits_opacity_and_clears_moments(model, moments):
    model.assign("opacity_logits", torch.logit(torch.linspace(0.001, 0.9, 50)))
    model.adam.state["opacity_logits"][0][:] = 1
    reset_opacities(model)
    opacity = model["opacity_logits"].detach().sigmoid()
    assert opacity.max().item() == pytest.approx(0.01) and opacity.min().item() == pytest.approx(0.001)
    assert not moments(model, "opacity_logits", 0).any()
    assert moments(model, "means", 0)[0] == 1


def test_oversized_splats_are_removed(model):
    """Radii are in pixels, scales in scene units."""
    model.stats |= {"gradient_max": torch.zeros(50), "radius_max": torch.linspace(1, 50, 50)}
    scales = np.full((50, 3), 0.01, np.float32)
    scales[3, 1], scales[4, 2] = 0.29, 0.31
    model.assign("log_scales", torch.from_numpy(np.log(scales)))
    prune_oversized(model, 0.3)
    assert model.columns["level"].tolist() == [row for row in range(20) if row != 4]
