"""Tests that training steps on a graphics device equal those on the host, for all methods."""

import io

import numpy as np
import pytest
import torch

from training.errors import LodgsError
from training.methods import METHODS, create
from training.optimize.density_control import densify, prune, reset_opacities
from training.optimize.initialize import from_points
from training.optimize.method import require_finite
from training.optimize.model import Model
from training.optimize.parameters import override
from training.optimize.support import SupportPruning
from training.rasterize import StepOptions, Target
from training.scenes.cameras import Camera

COMMON = {"margin": 0.0, "grad_threshold": 1e-6, "max_splats": 90}
CASES = {
    "3dgs": {"steps": 14, "densify_interval": 5, "densify_from": 0},
    "flod": {"levels": 2, "steps": [6, 6], "densify_interval": [4, 4], "finish_share": 0.25},
    "octree": {"steps": 14, "grow_interval": 6, "full_share": 0.0},
    "clod": {"steps": 12, "begin": 0.5},
    "matryoshka": {"steps": 12, "begin": 0.5},
    "lodge": {"steps": 8, "tune_steps": 2},
    "tree": {"steps": 8, "tune_steps": 4},
}
DEVICE_STEPS = {"3dgs": 14, "flod": 13, "octree": 14, "clod": 6, "matryoshka": 6, "lodge": 8, "tree": 8}
"""Number of steps on the device for each method."""


def make(name, data, backend="gpu"):
    parameters = override(METHODS[name].preset("draft"), COMMON | CASES[name])
    return create(name, data, parameters, 0, backend)


def steps(method, begin: int, end: int) -> list[float]:
    """Return the losses of these steps."""
    losses = []
    for step in range(begin, end):
        losses.append(method.train_step(step).loss())
        method.levels_after(step)
    return losses


@pytest.fixture
def device_steps(graphics, monkeypatch) -> list:
    """Return a list that gains an entry for each step on the device."""
    actual, step_model = [], Model.step_model

    def count_step(model, *arguments):
        result = step_model(model, *arguments)
        actual.append(hasattr(result, "copy_to_host"))
        return result

    monkeypatch.setattr(Model, "step_model", count_step)
    return actual


@pytest.mark.parametrize("name", CASES)
def test_device_steps_equal_host_steps(name, data, device_steps):
    method, second = make(name, data), make(name, data, "cpu")
    count = DEVICE_STEPS[name]
    losses, expected = steps(method, 0, count), steps(second, 0, count)
    assert device_steps == [True] * count + [False] * count
    assert losses == pytest.approx(expected, rel=2e-2)
    assert losses[0] == pytest.approx(expected[0], rel=5e-4)  # the device stores photos with 8 bits
    assert len(method.model) == pytest.approx(len(second.model), rel=0.05)


def trained(count: int) -> Model:
    """Return splats after two steps on the device, with host columns, one of them trained."""
    rng = np.random.default_rng(0)
    points, colors = rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3)), rng.integers(0, 255, (count, 3))
    tensors = from_points(points, colors, sh_degree=3) | {"decay": torch.arange(float(count))}
    tensors["opacity_logits"] = torch.linspace(-8, 4, count)
    rates = dict.fromkeys(tensors, 1e-3)
    model = Model(tensors, rates, columns={"level": torch.arange(float(count))}, peaks=True)
    device_model, camera = (
        model.step_model("gpu", False),
        Camera("", 75, 50, 60.0, 60.0, 37.5, 25.0, np.eye(4)),
    )
    assert device_model is not None
    target = Target(rng.integers(0, 256, (50, 75, 3)) / np.float32(255))
    for _ in range(2):
        device_model.step(camera, target, StepOptions(0.2, 3, (0.0, 0.0, 0.0), shrink=1))
    return model


def control_density(model: Model) -> None:
    """Imitate 3DGS: split a tenth of the splats, remove faint ones, lower opacities."""
    gradients, rng = model.mean_gradient(), np.random.default_rng(0)
    threshold = float(gradients.quantile(0.9))
    assert densify(model, gradients, threshold=threshold, clone_below=0.1, max_splats=10**6, rng=rng) > 50
    prune(model, 0.005)
    model.reset_stats()
    reset_opacities(model)


@pytest.mark.parametrize("max_bytes", [1 << 27, 200 << 10])
def test_density_control_on_device_equals_host(graphics, monkeypatch, max_bytes):
    """Bit-identical, also on a device that processes the moments of 512 splats at a time."""
    monkeypatch.setattr(graphics, "binding_bytes", max_bytes)
    first, second = trained(1000), trained(1000)
    second.adam.zero_grad()  # copies it to the host
    for model in (first, second):
        control_density(model)
        model.append({name: row[:0] for name, row in model.read_rows(torch.arange(3)).items()})
        model.append(model.read_rows(torch.tensor([7, 7, 3])) | {"level": torch.ones(3)})
        model.keep(torch.arange(len(model)) != 5)
        model.assign("sh", 2 * model.read("sh"))
    assert first._device_model is not None and second._device_model is None
    for first_tensor, second_tensor in zip(
        _flat(first.state_dict()), _flat(second.state_dict()), strict=True
    ):
        assert torch.equal(first_tensor, second_tensor)
    first.keep(torch.zeros(len(first), dtype=torch.bool))
    assert len(first) == 0 and first._device_model is None


def test_support_pruning_on_device_equals_host(graphics, data):
    first, second = trained(1000), trained(1000)
    second.adam.zero_grad()  # copies it to the host
    for model in (first, second):
        SupportPruning(data.scene, data.train, free_depth=0.5, largest=0.01).prune(model, 0, 0)
    assert first._device_model is not None and second._device_model is None and 0 < len(first) < 1000
    for tensors in zip(_flat(first.state_dict()), _flat(second.state_dict()), strict=True):
        assert torch.equal(*tensors)


def test_density_control_transfers_little(graphics):
    """Of 750 bytes per splat only the criteria and the new rows are transferred."""
    model, initial = trained(4000), graphics.transferred
    control_density(model)
    assert model.step_model("gpu", False) is not None and graphics.transferred - initial < 100 * 4000


def _flat(state) -> list[torch.Tensor]:
    if not isinstance(state, dict):
        return [torch.as_tensor(state)]
    return [tensor for name in sorted(state) for tensor in _flat(state[name])]


def test_checkpoint_moves_between_host_and_device(data, device_steps):
    """Checkpoints contain the state on the device, in both directions."""
    full_run, losses, begin = make("flod", data, "cpu"), [], 0
    expected = steps(full_run, 0, 13)
    file = io.BytesIO()
    for backend, end in (("cpu", 4), ("gpu", 9), ("cpu", 13)):
        method = make("flod", data, backend)
        if begin:
            file.seek(0)
            method.load_state_dict(torch.load(file, weights_only=True))
        losses += steps(method, begin, end)
        file, begin = io.BytesIO(), end
        torch.save(method.state_dict(), file)
    assert losses == pytest.approx(expected, rel=2e-2)
    assert device_steps.count(True) == 5


def test_resume_on_device_is_bit_identical(data, graphics, check_resumed):
    check_resumed(lambda: make("flod", data), 7)


def test_device_image_is_read_lazily(data, graphics):
    method, second = make("3dgs", data), make("3dgs", data, "cpu")
    result, expected = method.train_step(0), second.train_step(0)
    torch.testing.assert_close(result.image(), expected.image(), atol=2e-3, rtol=0)
    initial = graphics.transferred
    result.image()
    assert graphics.transferred - initial == 16 * result.target.image.shape[0] * result.target.image.shape[1]


def test_loss_that_is_not_finite_ends_the_training():
    require_finite(lambda: 0.1, 7)
    with pytest.raises(LodgsError, match="diverged by step 7: the loss is nan"):
        require_finite(lambda: float("nan"), 7)
