"""Tests of the learned gain and offset of each photo."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.methods import METHODS, create
from training.optimize.exposure import Exposure
from training.rasterize import Target


def set_exposure(exposure: Exposure, view: int, values: list) -> None:
    """Set the gain and offset of a photo, [red, green, blue] each."""
    state = exposure.state_dict()
    state["tensors"][list(state["tensors"])[view]] = torch.tensor(values)
    exposure.load_state_dict(state)


def test_zero_rate_disables_exposure():
    exposure, image = Exposure("abc", 0.0), torch.rand(4, 5, 3)
    assert exposure(image, 1) is image and list(exposure.optimizers(0)) == []


def test_exposure_applies_gain_and_offset_and_clips_at_white():
    exposure = Exposure("ab", 0.1)
    set_exposure(exposure, 1, [[2.0, 1.0, 0.5], [0.0, 0.1, 0.0]])
    result = exposure(torch.tensor([[[0.2, 0.5, 0.8], [0.6, 0.95, 1.0]]]), 1).detach()
    torch.testing.assert_close(result, torch.tensor([[[0.4, 0.6, 0.4], [1.0, 1.0, 0.5]]]))


def test_training_recovers_gains_and_offsets_with_constant_mean():
    """Two photos of one image, a brighter and a darker one."""
    image = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.1
    photos = [image * 1.2 + 0.05, image * 0.8 - 0.05]
    exposure = Exposure("ab", 0.01)
    for step in range(600):
        view = step % 2
        ((exposure(image, view) - photos[view]) ** 2).mean().backward()
        for optimizer in exposure.optimizers(step / 600):
            optimizer.step()
            optimizer.zero_grad()
        exposure.center()
        assert exposure.table.mean(0) == pytest.approx(np.array([[1.0] * 3, [0.0] * 3]), abs=1e-5)
    expected = torch.tensor([[1.2, 0.05], [0.8, -0.05]])[:, :, None].expand(2, 2, 3)
    torch.testing.assert_close(exposure.table, expected, atol=0.02, rtol=0)


def test_state_is_restored_by_photo_name():
    saved, restored = Exposure("abc", 0.1), Exposure("xcb", 0.1)
    for view in range(3):
        saved(torch.rand(2, 2, 3), view).sum().backward()
    [adam] = saved.optimizers(0.0)
    adam.step()
    set_exposure(saved, 1, [[2.0] * 3, [0.1] * 3])
    restored.load_state_dict(deepcopy(saved.state_dict()))
    new = torch.tensor([[1.0] * 3, [0.0] * 3])
    torch.testing.assert_close(restored.table, torch.stack([new, saved.table[2], saved.table[1]]))
    assert restored.state_dict()["adam"]["steps"] == {"x": 0, "c": 1, "b": 1}


@pytest.mark.parametrize("name", ["3dgs", "flod", "octree", "octree_neural", "clod"])
def test_every_method_trains_and_resumes_exposure(data, name):
    parameters = replace(METHODS[name].presets["draft"], lr_exposure=0.01)
    method, resumed = (create(name, data, parameters, 0, "cpu") for _ in range(2))
    for step in range(2):
        method.train_step(step)
    learned = (method.exposure.table - torch.tensor([[1.0], [0.0]])).abs().amax((1, 2))
    assert (learned > 0).sum() == 2  # only of the two photos used
    resumed.load_state_dict(deepcopy(method.state_dict()))
    assert torch.equal(resumed.exposure.table, method.exposure.table)
    losses = [m.train_step(2).loss() for m in (method, resumed)]
    assert losses[0] == losses[1] and torch.equal(resumed.exposure.table, method.exposure.table)


def test_rendered_images_exclude_exposure(data):
    """Only the loss uses a photo's exposure."""
    parameters = replace(METHODS["3dgs"].presets["draft"], lr_exposure=0.01, first_resolution=1.0)
    method = create("3dgs", data, parameters, 0, "cpu")
    view = method.choose_view(0)
    drawings = method.draw(view, 0)
    image = drawings[0].rendering.image.detach()
    set_exposure(method.exposure, view.index, [[0.5] * 3, [0.0] * 3])
    halved = replace(view, target=Target(image * 0.5))
    assert float(method.loss(drawings, halved, 0).detach()) == pytest.approx(0, abs=1e-5)
