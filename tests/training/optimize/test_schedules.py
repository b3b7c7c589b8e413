"""Photographs begin small, and gradients count as if they did not."""

from dataclasses import replace

import pytest
import torch

from training.methods import METHODS, create
from training.optimize.schedules import shrink_at


def test_pixels_grow_evenly_from_the_first_to_all():
    """Sides 0.3 to 1 over half of the run: after a quarter half of the pixels between 9 and 100 percent."""
    assert shrink_at(0.0, 0.3, 0.5) == pytest.approx(10 / 3)
    assert shrink_at(0.25, 0.3, 0.5) == pytest.approx(10 / 8)  # 0.738, to the tenth above
    assert shrink_at(0.4999, 0.3, 0.5) == shrink_at(0.5, 0.3, 0.5) == shrink_at(1.0, 0.3, 0.5) == 1
    assert shrink_at(0.0, 1.0, 0.5) == shrink_at(0.0, 0.3, 0.0) == 1


@pytest.mark.parametrize("name", ["3dgs", "flod", "clod"])
def test_first_steps_see_small_photographs_and_the_last_whole_ones(data, name):
    parameters = replace(METHODS[name].presets["draft"], first_resolution=0.5, full_resolution=0.5)
    method = create(name, data, parameters, 0, "cpu")
    first, last = method.choose_view(0), method.choose_view(method.steps - 1)
    assert first.shrink == 2 and first.camera.width == data.train[0].width // 2
    assert tuple(first.target.image.shape[:2]) == (first.camera.height, first.camera.width)
    assert last.shrink == 1 and last.camera is data.train[last.index]


def test_gradients_of_small_photographs_count_as_much_smaller(data):
    method = create("3dgs", data, METHODS["3dgs"].presets["draft"], 0, "cpu")
    view = data.view(0, 2)
    drawn = method.draw(view, 0)
    method.loss(drawn, view, 0).backward()
    method.model.accumulate_stats(drawn[0].rendering, shrink=2)
    halved = method.model.stats["gradient_sum"].clone()
    method.model.reset_stats()
    method.model.accumulate_stats(drawn[0].rendering)
    assert halved.any()
    torch.testing.assert_close(2 * halved, method.model.stats["gradient_sum"])
