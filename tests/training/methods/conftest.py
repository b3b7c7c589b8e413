"""The tiny scene as methods take it, and splats to add to and to remove from."""

import io
from collections.abc import Callable

import numpy as np
import pytest
import torch

from training.methods.data import TrainingData
from training.methods.method import Method
from training.methods.model import Model
from training.methods.start import from_points
from training.scenes.colmap import read_scene
from training.splats.bundle import Level
from training.splats.ply import columns_of, columns_of_extras

RATES = {"means": 1e-3, "quats": 1e-3, "log_scales": 1e-2, "opacity_logits": 5e-2, "sh": 1e-3, "decay": 0.5}


@pytest.fixture(scope="module")
def data(tiny_scene) -> TrainingData:
    return TrainingData(read_scene(tiny_scene), test_every=4)


@pytest.fixture
def model() -> Model:
    """50 splats that train a column of their own, ``decay``; row i is 10 + i there."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    tensors = from_points(points, rng.integers(0, 255, (50, 3)), sh_degree=2)
    made = Model(tensors | {"decay": 10 + torch.arange(50.0)}, RATES, columns={"level": torch.arange(50.0)})
    for first, second in made.adam.state.values():  # moments that can be recognised: row i holds i + 1
        rows = torch.arange(1.0, 51.0).view(-1, *(1,) * (first.dim() - 1))
        first += rows
        second += 10 * rows
    return made


@pytest.fixture
def moments() -> Callable[[Model, str, int], torch.Tensor]:
    """The first number of every row of a tensor's first (0) or second (1) moments."""
    return lambda model, name, which: model.adam.state[name][which].reshape(len(model), -1)[:, 0]


@pytest.fixture
def check_resumed() -> Callable[[Callable[[], Method], int], None]:
    """check_resumed(make, stop): a method that goes on with the state of one that was stopped after ``stop``
    steps, as it stands in a file, hands over the same levels to the bit as one that was not."""

    def check(make: Callable[[], Method], stop: int) -> None:
        whole, first, second, file = make(), make(), make(), io.BytesIO()
        levels, before = _train(whole, 0), _train(first, 0, stop)
        torch.save(first.state_dict(), file)
        file.seek(0)
        second.load_state_dict(torch.load(file, weights_only=True))
        after = before + _train(second, stop)
        assert [level.number for level in after] == [level.number for level in levels] != []
        for one, other in zip(levels, after, strict=True):
            columns, theirs = (columns_of(x.splats) | columns_of_extras(x.splats) for x in (one, other))
            assert one.facts == other.facts and columns.keys() == theirs.keys()
            for name, column in columns.items():
                np.testing.assert_array_equal(column, theirs[name])
        assert second.meta() == whole.meta()

    return check


def _train(method: Method, step: int, until: int | None = None) -> list[Level]:
    levels = []
    while step < (until or method.steps):  # which some learn on the way
        method.train_step(step)
        levels += method.levels_after(step)
        step += 1
    return levels
