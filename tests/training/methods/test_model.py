"""Splats that come and go, with Adam's state in step."""

import numpy as np
import pytest
import torch

from training.methods.model import NAMES, Model, constrained_log, densify, from_points, neighbour_distances

LR = {"means": 1e-3, "quats": 1e-3, "log_scales": 1e-2, "opacity_logits": 5e-2, "sh": 1e-3}


@pytest.fixture
def model() -> Model:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    made = Model(from_points(points, rng.integers(0, 255, (50, 3)), sh_degree=2), LR)
    for name in NAMES:  # moments that can be recognised: row i holds i + 1
        first, second = made.adam.state[name]
        rows = torch.arange(1.0, 51.0).view(-1, *(1,) * (first.dim() - 1))
        first += rows
        second += 10 * rows
    return made


def moments(model: Model, name: str, which: int) -> torch.Tensor:
    return model.adam.state[name][which].reshape(len(model), -1)[:, 0]


def test_neighbour_distances_equal_brute_force():
    points = np.random.default_rng(1).normal(size=(200, 3))
    full = np.linalg.norm(points[:, None] - points[None], axis=2)
    expected = np.sort(full, axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbour_distances(points), expected, rtol=1e-12)


def test_initial_scale_is_the_rms_distance_of_three_neighbours_and_colour_shows_as_given():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]], float)
    colors = np.array([[255, 0, 51]] * 5, np.uint8)
    tensors = from_points(points, colors, sh_degree=1)
    assert tensors["log_scales"][0].exp().tolist() == pytest.approx([np.sqrt((1 + 4 + 9) / 3)] * 3)
    shown = 0.5 + 0.28209479177387814 * tensors["sh"][0, 0]
    assert shown.tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert torch.sigmoid(tensors["opacity_logits"]).tolist() == pytest.approx([0.1] * 5)
    assert not tensors["sh"][:, 1:].any()


def test_training_does_not_move_the_points_it_began_with():
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    before = points.copy()
    tensors = from_points(points, np.zeros((10, 3), np.uint8), sh_degree=0)
    tensors["means"] += 1
    np.testing.assert_array_equal(points, before)


def test_keep_drops_rows_and_their_moments(model):
    means = model["means"].detach().clone()
    mask = torch.arange(50) % 3 == 0
    model.keep(mask)
    assert torch.equal(model["means"], means[mask])
    for name in NAMES:
        assert torch.equal(moments(model, name, 0), torch.arange(1.0, 51.0)[mask])
        assert torch.equal(moments(model, name, 1), 10 * torch.arange(1.0, 51.0)[mask])
        assert model[name].requires_grad and model[name].is_leaf


def test_small_splats_are_cloned_in_place(model):
    before = {name: model[name].detach().clone() for name in NAMES}
    gradients = torch.zeros(50)
    gradients[[4, 7]] = 1.0
    added = densify(
        model, gradients, threshold=0.5, clone_below=1e9, max_splats=1000, min_scale=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert added == 2 and len(model) == 52
    for name in NAMES:
        assert torch.equal(model[name][:50], before[name])
        assert torch.equal(model[name][50:], before[name][[4, 7]])
        assert moments(model, name, 0)[50:].tolist() == [0, 0]
        assert torch.equal(moments(model, name, 0)[:50], torch.arange(1.0, 51.0))


def test_large_splats_are_split_into_two_smaller_ones_drawn_from_them(model):
    model.assign("log_scales", torch.log(torch.tensor([[0.5, 1.0, 2.0]])).repeat(50, 1))
    # a quarter turn about z: the splat's x axis lies along the world's y
    model.assign(
        "quats", torch.tensor([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], dtype=torch.float32).repeat(50, 1)
    )
    parents = model["means"].detach().clone()
    gradients = torch.ones(50)
    offsets = []
    for seed in range(40):
        copy = Model({name: model[name].detach().clone() for name in NAMES}, LR)
        densify(
            copy, gradients, threshold=0.5, clone_below=0.0, max_splats=1000, min_scale=0.1,
            rng=np.random.default_rng(seed),
        )  # fmt: skip
        assert len(copy) == 100
        # FLoD: child scale + s_min = parent scale / 1.6, with the constrained scale
        expected = (torch.tensor([0.5, 1.0, 2.0]) + 0.1) / 1.6
        torch.testing.assert_close(copy["log_scales"].exp() + 0.1, expected.repeat(100, 1))
        offsets.append((copy["means"].detach() - parents.repeat(2, 1)).numpy())
    spread = np.concatenate(offsets).std(0)
    np.testing.assert_allclose(spread, [1.1, 0.6, 2.1], rtol=0.05)


def test_the_budget_goes_to_the_largest_gradients(model):
    gradients = torch.linspace(0, 1, 50)
    before = model["means"].detach().clone()
    added = densify(
        model, gradients, threshold=0.1, clone_below=1e9, max_splats=53, min_scale=0.0,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert added == 3
    assert torch.equal(model["means"][50:], before[[47, 48, 49]])


def test_constrained_log_undoes_the_constraint_and_stays_free_below_it():
    scales = torch.tensor([0.5, 0.2])
    torch.testing.assert_close(constrained_log(scales, 0.1).exp() + 0.1, scales)
    assert constrained_log(torch.tensor([0.05]), 0.1).exp().item() == pytest.approx(0.005)
