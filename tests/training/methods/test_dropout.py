"""Tests of splat dropout for few photos (DropGaussian) in all methods."""

import pytest
import torch

from training.methods import METHODS, create
from training.methods.flod import finish
from training.optimize.dropout import END, Dropout
from training.optimize.parameters import override
from training.optimize.schedules import MANY_PHOTOS

PLAIN = ("3dgs", "flod", "octree", "clod", "lodge", "tree", "matryoshka")


def make(data, name="3dgs", **values):
    return create(name, data, override(METHODS[name].preset("draft"), values), 0, "cpu")


def weights(method, step: int = 0) -> torch.Tensor:
    """Return the dropout weights of a step at the start of the schedule."""
    return method.dropout.weights(len(method.model), step, 0.0)


def test_dropout_rate(data):
    """Six training views: 0.4 (1 - 6 / 40) = 0.34 are dropped, the others are 1 / 0.66 times as opaque."""
    assert len(data.train) == 6 and MANY_PHOTOS == 40
    method = make(data, dropout=0.4)
    actual = torch.cat([weights(method, step) for step in range(200)])
    assert sorted(actual.unique().tolist()) == pytest.approx([0, 1 / 0.66])
    assert float((actual == 0).double().mean()) == pytest.approx(0.34, abs=0.015)
    assert float(actual.mean()) == pytest.approx(1, abs=0.03)


def test_dropout_is_random_per_step_and_repeatable(data):
    first, repeated, second = make(data), make(data), create("3dgs", data, make(data).parameters, 1, "cpu")
    assert torch.equal(weights(first, 3), weights(repeated, 3))
    assert not torch.equal(weights(first, 3), weights(first, 4))
    assert not torch.equal(weights(first, 3), weights(second, 3))


def test_dropout_is_off_with_many_views_and_at_the_end():
    few = Dropout(0.2, 6, seed=0)
    assert few.weights(9, 0, END - 0.01) is not None and few.weights(9, 0, END) is None
    assert Dropout(0.0, 6, seed=0).weights(9, 0, 0.0) is None
    for views, drops in ((39, True), (40, False), (400, False)):
        assert (Dropout(0.2, views, seed=0).weights(9, 0, 0.0) is not None) == drops


@pytest.mark.parametrize("name", METHODS)
def test_dropout_of_presets(name):
    for preset in ("draft", "standard", "paper"):
        expected = 0.2 if name in PLAIN and preset != "paper" else 0.0
        assert METHODS[name].preset(preset).dropout == expected


@pytest.mark.parametrize("name", PLAIN)
def test_dropped_splats_get_no_update(data, name):
    """Some of the remaining splats are updated."""
    method = make(data, name, dropout=0.5, margin=0.0)
    initial = method.model["means"].detach().clone()
    remaining = weights(method)
    method.train_step(0)
    moved = (method.model["means"].detach() != initial).any(1)
    assert not moved[remaining == 0].any() and moved[remaining > 0].any()


def test_finishing_has_no_dropout(data):
    """Finishing starts before the last eighth of the steps; levels have to match their rendering."""
    flod = make(data, "flod", levels=2, levels_from="trained", steps=[4, 4], finish_share=1.0, dropout=0.5)
    view = flod.data.view(0)
    assert (flod.render_weights(view, 0)[0] == 0).any()
    for step in range(8):
        flod.train_step(step)
        flod.levels_after(step)
    assert END > 8 / 16
    for step in range(8, 12):
        chosen = finish.weights(flod.model, flod.s_min, view.camera, flod._finishing_values(step))
        assert torch.equal(flod.render_weights(view, step)[0], chosen)
