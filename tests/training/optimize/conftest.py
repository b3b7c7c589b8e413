"""Fixtures: a small trainable model and its moments."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from training.optimize.initialize import from_points
from training.optimize.model import Model

RATES = {"means": 1e-3, "quats": 1e-3, "log_scales": 1e-2, "opacity_logits": 5e-2, "sh": 1e-3, "decay": 0.5}


@pytest.fixture
def model() -> Model:
    """Return 50 splats with a trained tensor ``decay``, whose row i is 10 + i."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    tensors = from_points(points, rng.integers(0, 255, (50, 3)), sh_degree=2)
    model = Model(tensors | {"decay": 10 + torch.arange(50.0)}, RATES, columns={"level": torch.arange(50.0)})
    for first, second in model.adam.state.values():  # recognisable moments: row i is i + 1
        rows = torch.arange(1.0, 51.0).view(-1, *(1,) * (first.dim() - 1))
        first += rows
        second += 10 * rows
    return model


@pytest.fixture
def moments() -> Callable[[Model, str, int], torch.Tensor]:
    """Return a function for the first value in each row of a tensor's first (0) or second (1) moments."""
    return lambda model, name, order: model.adam.state[name][order].reshape(len(model), -1)[:, 0]
