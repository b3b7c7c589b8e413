"""Steps that a graphics device makes by itself are those that go through torch, whatever the method."""

import io

import pytest
import torch

from training.methods import METHODS, create
from training.methods.model import Model
from training.methods.parameters import override

COMMON = {"margin": 0.0, "grad_threshold": 1e-6, "max_splats": 90}
CASES = {
    "3dgs": {"steps": 14, "densify_interval": 5, "densify_from": 0},
    "flod": {"levels": 2, "steps": [6, 6], "densify_interval": [4, 4], "finish_share": 0.25},
    "octree": {"steps": 14, "grow_interval": 6, "full_share": 0.0},
    "clod": {"steps": 12, "begin": 0.5},
    "lodge": {"steps": 8, "tune_steps": 2},
    "tree": {"steps": 8, "tune_steps": 4},
}
THERE = {"3dgs": 14, "flod": 15, "octree": 14, "clod": 6, "lodge": 8, "tree": 8}
"""How many steps of each are plain."""


def make(name, data, backend="gpu"):
    parameters = override(METHODS[name].preset("draft"), COMMON | CASES[name])
    return create(name, data, parameters, 0, backend)


def steps(method, begin: int, end: int) -> list[float]:
    """The losses of these steps."""
    losses = []
    for step in range(begin, end):
        losses.append(method.train_step(step).loss)
        method.levels_after(step)
    return losses


@pytest.fixture
def there(graphics, monkeypatch) -> list:
    """Grows by one with each step that a device makes."""
    found, twin = [], Model.twin

    def noted(model, *arguments):
        made = twin(model, *arguments)
        found.append(made is not None)
        return made

    monkeypatch.setattr(Model, "twin", noted)
    return found


@pytest.mark.parametrize("name", CASES)
def test_methods_do_there_what_they_do_here(name, data, there):
    method, other = make(name, data), make(name, data, "cpu")
    count = THERE[name]
    losses, expected = steps(method, 0, count), steps(other, 0, count)
    assert there == [True] * count + [False] * count
    assert losses == pytest.approx(expected, rel=2e-2)
    assert losses[0] == pytest.approx(expected[0], rel=5e-4)  # photographs there have eight bits
    assert len(method.model) == pytest.approx(len(other.model), rel=0.05)


def test_a_run_goes_on_elsewhere(data, there):
    """From here to there and back, by checkpoints: what was there is in them."""
    whole, parts, at = make("flod", data, "cpu"), [], 0
    expected = steps(whole, 0, 15)
    file = io.BytesIO()
    for backend, end in (("cpu", 4), ("gpu", 9), ("cpu", 15)):
        method = make("flod", data, backend)
        if at:
            file.seek(0)
            method.load_state_dict(torch.load(file, weights_only=True))
        parts += steps(method, at, end)
        file, at = io.BytesIO(), end
        torch.save(method.state_dict(), file)
    assert parts == pytest.approx(expected, rel=2e-2)
    assert there.count(True) == 5


def test_a_run_there_resumes_to_the_bit(data, graphics, check_resumed):
    check_resumed(lambda: make("flod", data), 7)


def test_a_picture_there_is_read_when_it_is_asked_for(data, graphics):
    method, other = make("3dgs", data), make("3dgs", data, "cpu")
    made, expected = method.train_step(0), other.train_step(0)
    torch.testing.assert_close(made.image(), expected.image(), atol=2e-3, rtol=0)
    before = graphics.moved
    made.image()
    assert graphics.moved - before == 16 * made.target.image.shape[0] * made.target.image.shape[1]
