"""Test validation and conversion of Gaussians."""

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


def same(a: Gaussians, b: Gaussians | Splats) -> bool:
    """Compare two sets of splats field by field."""
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Gaussians))


def test_splats_survive_conversion_to_model_and_back():
    plain = splats()
    tensors = vars(Gaussians.of(plain)).copy()
    model = Model(tensors, dict.fromkeys(tensors, 0.0))
    assert same(model.gaussians.detach(), plain) and same(Gaussians.of(model.splats()), plain)
    assert model.gaussians.means is model["means"], "the model draws its trained tensors"


def test_any_array_layout_and_type_is_accepted():
    plain = splats()
    odd = replace(plain, means=np.asfortranarray(plain.means, np.float64), sh=plain.sh[:, ::-1])
    converted = Gaussians.of(odd)
    assert same(converted, odd)
    assert all(x.dtype == torch.float32 and x.is_contiguous() for x in vars(converted).values())


def test_select_applies_to_every_tensor():
    plain = splats()
    gaussians = Gaussians.of(plain)
    mask = np.arange(7) % 2 == 0
    assert len(gaussians) == 7 and len(gaussians.select(slice(2, 5))) == 3
    assert same(gaussians.select(torch.from_numpy(mask)), plain.select(mask))
    assert same(gaussians.select(torch.tensor([5, 1])), plain.select([5, 1]))
    halves = [gaussians.select(slice(3)), gaussians.select(slice(3, None))]
    assert same(Gaussians.concatenated(halves), plain)


def test_detach_shares_values_but_not_graph():
    leaves = Gaussians.of(splats()).map(torch.Tensor.requires_grad_)
    detached = leaves.detach()
    assert not any(x.requires_grad for x in vars(detached).values()) and same(detached, detached)
    assert detached.means.data_ptr() == leaves.means.data_ptr() and leaves.means.requires_grad
    assert leaves.to(dtype=torch.float64).sh.dtype == torch.float64


@pytest.mark.parametrize("name", ["quats", "log_scales", "opacity_logits", "sh"])
def test_mismatched_shapes_raise(name):
    gaussians = Gaussians.of(splats())
    with pytest.raises(ValueError, match=name):
        replace(gaussians, **{name: getattr(gaussians, name)[:3]})
    with pytest.raises(ValueError, match=name):
        replace(gaussians, **{name: torch.zeros(7, 5)})
