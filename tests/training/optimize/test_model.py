"""Tests of models whose rows are added and removed with Adam's state."""

import io

import numpy as np
import pytest
import torch

from training.optimize.model import NAMES, Model

ALL = (*NAMES, "decay")


def test_keep_drops_rows_and_their_moments(model, moments):
    means = model["means"].detach().clone()
    mask = torch.arange(50) % 3 == 0
    model.keep(mask)
    assert torch.equal(model["means"], means[mask])
    assert torch.equal(model["decay"], 10 + torch.arange(50.0)[mask])
    assert torch.equal(model.columns["level"], torch.arange(50.0)[mask])
    for name in ALL:
        assert torch.equal(moments(model, name, 0), torch.arange(1.0, 51.0)[mask])
        assert torch.equal(moments(model, name, 1), 10 * torch.arange(1.0, 51.0)[mask])
        assert model[name].requires_grad and model[name].is_leaf


def test_sorted_rows_follow_a_curve_with_their_moments(model, moments):
    """Along the diagonal, a Z-order curve has the order of the coordinates."""
    places = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    model.assign("means", places.float()[:, None].repeat(1, 3))
    level, decay = model.columns["level"].clone(), model["decay"].detach().clone()
    model.sort()
    rows = torch.argsort(places)
    assert model["means"][:, 0].tolist() == list(range(50))
    assert torch.equal(model.columns["level"], level[rows])
    assert torch.equal(model["decay"], decay[rows])
    for order in (0, 1):
        assert torch.equal(moments(model, "decay", order), 10**order * (rows + 1.0))


def test_append_adds_trained_tensors_and_zeros_for_missing_columns(model, moments):
    rows = model.read_rows(torch.tensor([3, 3, 7]))
    model.stats["seen"] += 5
    model.append(rows | {"level": torch.tensor([9.0, 9.0, 9.0])})
    assert model["decay"].tolist()[50:] == [13, 13, 17]
    assert model.columns["level"].tolist()[49:] == [49, 9, 9, 9]
    assert model.stats["seen"].tolist()[49:] == [5, 0, 0, 0]
    for name in ALL:
        assert torch.equal(model[name][50:], rows[name])
        assert moments(model, name, 0).tolist() == [*range(1, 51), 0, 0, 0]


def test_tensors_have_separate_learning_rates(model):
    """Adam's first step equals the rate for any gradient."""
    fresh = Model(model.read_rows(torch.arange(50)), model.adam.lr)
    (fresh["decay"].sum() * 7 + fresh["means"].sum()).backward()
    initial = fresh.read_rows(torch.arange(50))
    fresh.adam.step()
    torch.testing.assert_close(initial["decay"] - fresh["decay"], torch.full((50,), 0.5))
    torch.testing.assert_close(
        initial["means"] - fresh["means"], torch.full((50, 3), 1e-3), rtol=1e-3, atol=0
    )


def test_checkpoint_restores_all_columns(model):
    model.stats["seen"] += 2
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    restored = Model({name: torch.zeros_like(model[name]) for name in ALL}, model.adam.lr)
    restored.load_state_dict(torch.load(file, weights_only=True))
    for name in ALL:
        assert torch.equal(restored[name], model[name])
        assert all(map(torch.equal, restored.adam.state[name], model.adam.state[name]))
    assert torch.equal(restored.columns["level"], model.columns["level"])
    assert torch.equal(restored.stats["seen"], model.stats["seen"])


def test_splats_are_a_copy_with_extras(model):
    splats = model.splats(min_scale=0.5)
    assert list(splats.extras) == ["decay"]
    np.testing.assert_array_equal(splats.extras["decay"], np.arange(10, 60, dtype=np.float32))
    assert splats.extras["decay"].dtype == np.float32
    np.testing.assert_allclose(
        np.exp(splats.log_scales), model["log_scales"].detach().exp().numpy() + 0.5, rtol=1e-6
    )
    splats.means += 1
    splats.extras["decay"] += 1
    assert model["decay"][0] == 10 and not np.array_equal(splats.means, model["means"].detach().numpy())


def test_fading_scales_opacities_and_keeps_moments(model, moments):
    logits = torch.linspace(-120, 30, 50)
    model.assign("opacity_logits", logits.clone())
    before = [moments(model, name, k) for name in ALL for k in range(2)]
    model.fade(0.1)
    exact = logits.double()
    expected = (0.9 * exact.sigmoid()).log() - (1 - 0.9 * exact.sigmoid()).log()
    assert torch.allclose(model["opacity_logits"].double(), expected, rtol=1e-5, atol=1e-5)
    assert model["opacity_logits"].is_leaf and model["opacity_logits"].requires_grad
    after = [moments(model, name, k) for name in ALL for k in range(2)]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_reset_stats_keeps_shapes():
    stats = {"seen": torch.ones(2, 4), "opacity_sum": torch.ones(2)}
    model = Model({"means": torch.zeros(2, 3)}, {"means": 0.0}, stats=stats)
    model.reset_stats()
    assert {name: tuple(stat.shape) for name, stat in model.stats.items()} == {
        "gradient_sum": (2,), "seen": (2, 4), "opacity_sum": (2,)
    }  # fmt: skip
    assert not any(stat.any() for stat in model.stats.values())


def test_state_without_a_column_is_rejected_and_changes_nothing(model):
    state, means = model.state_dict(), model["means"].detach().clone()
    incomplete = {
        **state,
        "columns": {},
        "tensors": {name: tensor + 1 for name, tensor in state["tensors"].items()},
    }
    with pytest.raises(ValueError, match=r"\['level'\] are missing"):
        model.load_state_dict(incomplete)
    assert torch.equal(model["means"], means)
