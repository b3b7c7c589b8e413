"""Gaussians hold together, and come from plain splats without loss."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from training.optimize.model import Model
from training.rasterize import Gaussians
from training.splats.gaussians import Splats


def splats(count: int = 7, columns: int = 4) -> Splats:
    random = np.random.default_rng(0)
    shapes = (count, 3), (count, 4), (count, 3), (count,), (count, columns, 3)
    return Splats(*(random.normal(size=shape).astype(np.float32) for shape in shapes))


def same(one: Gaussians, other) -> bool:
    """Name by name: a column in the wrong place is found."""
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Gaussians))


def test_splats_come_back_from_a_model_of_their_gaussians_to_the_bit():
    plain = splats()
    tensors = vars(Gaussians.of(plain)).copy()
    model = Model(tensors, dict.fromkeys(tensors, 0.0))
    assert same(model.gaussians.detach(), plain) and same(Gaussians.of(model.splats()), plain)
    assert model.gaussians.means is model["means"], "what is trained is what is drawn"


def test_any_layout_and_type_of_arrays_is_taken():
    plain = splats()
    odd = replace(plain, means=np.asfortranarray(plain.means, np.float64), sh=plain.sh[:, ::-1])
    found = Gaussians.of(odd)
    assert same(found, odd)
    assert all(x.dtype == torch.float32 and x.is_contiguous() for x in vars(found).values())


def test_a_selection_is_of_every_tensor():
    plain = splats()
    gaussians = Gaussians.of(plain)
    mask = np.arange(7) % 2 == 0
    assert len(gaussians) == 7 and len(gaussians.select(slice(2, 5))) == 3
    assert same(gaussians.select(torch.from_numpy(mask)), plain.select(mask))
    assert same(gaussians.select(torch.tensor([5, 1])), plain.select([5, 1]))
    halves = [gaussians.select(slice(3)), gaussians.select(slice(3, None))]
    assert same(Gaussians.concatenated(halves), plain)


def test_detached_ones_share_their_values_and_not_their_graph():
    leaves = Gaussians.of(splats()).map(torch.Tensor.requires_grad_)
    detached = leaves.detach()
    assert not any(x.requires_grad for x in vars(detached).values()) and same(detached, detached)
    assert detached.means.data_ptr() == leaves.means.data_ptr() and leaves.means.requires_grad
    assert leaves.to(dtype=torch.float64).sh.dtype == torch.float64


@pytest.mark.parametrize("name", ["quats", "log_scales", "opacity_logits", "sh"])
def test_tensors_of_other_numbers_are_refused(name):
    gaussians = Gaussians.of(splats())
    with pytest.raises(ValueError, match=name):
        replace(gaussians, **{name: getattr(gaussians, name)[:3]})
    with pytest.raises(ValueError, match=name):
        replace(gaussians, **{name: torch.zeros(7, 5)})
