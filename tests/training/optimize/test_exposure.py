"""Each photograph's own gain and offset: learned, kept in balance, and left out of pictures."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.methods import METHODS, create
from training.optimize.exposure import Exposure
from training.rasterize import Target


def set_to(exposure: Exposure, view: int, values: list) -> None:
    """Gives a photograph a gain and an offset, [red, green, blue] each."""
    state = exposure.state_dict()
    state["tensors"][list(state["tensors"])[view]] = torch.tensor(values)
    exposure.load_state_dict(state)


def test_nothing_is_learned_and_nothing_changes_without_a_rate():
    exposure, image = Exposure("abc", 0.0), torch.rand(4, 5, 3)
    assert exposure(image, 1) is image and list(exposure.optimizers(0)) == []


def test_a_photograph_is_gain_times_picture_plus_offset_and_at_most_white():
    exposure = Exposure("ab", 0.1)
    set_to(exposure, 1, [[2.0, 1.0, 0.5], [0.0, 0.1, 0.0]])
    found = exposure(torch.tensor([[[0.2, 0.5, 0.8], [0.6, 0.95, 1.0]]]), 1).detach()
    torch.testing.assert_close(found, torch.tensor([[[0.4, 0.6, 0.4], [1.0, 1.0, 0.5]]]))


def test_gains_and_offsets_are_found_and_stay_in_balance():
    """Two photographs of one picture, a brighter and a darker: least squares knows the answer."""
    picture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.1
    photographs = [picture * 1.2 + 0.05, picture * 0.8 - 0.05]
    exposure = Exposure("ab", 0.01)
    for step in range(600):
        view = step % 2
        ((exposure(picture, view) - photographs[view]) ** 2).mean().backward()
        for optimizer in exposure.optimizers(step / 600):
            optimizer.step()
            optimizer.zero_grad()
        exposure.center()
        assert exposure.table.mean(0) == pytest.approx(np.array([[1.0] * 3, [0.0] * 3]), abs=1e-5)
    expected = torch.tensor([[1.2, 0.05], [0.8, -0.05]])[:, :, None].expand(2, 2, 3)
    torch.testing.assert_close(exposure.table, expected, atol=0.02, rtol=0)


def test_they_stay_with_their_photographs_whichever_are_here():
    before, after = Exposure("abc", 0.1), Exposure("xcb", 0.1)
    for view in range(3):
        before(torch.rand(2, 2, 3), view).sum().backward()
    [adam] = before.optimizers(0.0)
    adam.step()
    set_to(before, 1, [[2.0] * 3, [0.1] * 3])
    after.load_state_dict(deepcopy(before.state_dict()))
    new = torch.tensor([[1.0] * 3, [0.0] * 3])
    torch.testing.assert_close(after.table, torch.stack([new, before.table[2], before.table[1]]))
    assert after.state_dict()["adam"]["steps"] == {"x": 0, "c": 1, "b": 1}


@pytest.mark.parametrize("name", ["3dgs", "flod", "octree", "octree_neural", "clod"])
def test_every_method_learns_them_and_goes_on_with_them(data, name):
    parameters = replace(METHODS[name].presets["draft"], lr_exposure=0.01)
    method, again = (create(name, data, parameters, 0, "cpu") for _ in range(2))
    for step in range(2):
        method.train_step(step)
    learned = (method.exposure.table - torch.tensor([[1.0], [0.0]])).abs().amax((1, 2))
    assert (learned > 0).sum() == 2  # of the two photographs that were seen, and of no others
    again.load_state_dict(deepcopy(method.state_dict()))
    assert torch.equal(again.exposure.table, method.exposure.table)
    losses = [each.train_step(2)[0] for each in (method, again)]
    assert losses[0] == losses[1] and torch.equal(again.exposure.table, method.exposure.table)


def test_pictures_do_not_have_them(data):
    """The loss sees a photograph's own exposure; what is shown, measured and handed over does not."""
    parameters = replace(METHODS["3dgs"].presets["draft"], lr_exposure=0.01, first_resolution=1.0)
    method = create("3dgs", data, parameters, 0, "cpu")
    view = method.choose_view(0)
    drawn = method.draw(view, 0)
    image = drawn[0].rendering.image.detach()
    set_to(method.exposure, view.index, [[0.5] * 3, [0.0] * 3])
    halved = replace(view, target=Target(image * 0.5))
    assert float(method.loss(drawn, halved, 0).detach()) == pytest.approx(0, abs=1e-5)
