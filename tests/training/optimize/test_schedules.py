"""Tests of image size schedules."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from training.methods import METHODS, create
from training.optimize.schedules import LevelStages, shrink_at


def test_stages_train_one_level_each():
    """A stage without steps is left out, as that of a finest level that is a base."""
    stages = LevelStages([(3, 0), (2, 4), (1, 2)])
    assert stages.ends == [0, 4, 6]
    assert [stages.level_at(step) for step in range(8)] == [2, 2, 2, 2, 1, 1, 1, 1], "the last one remains"
    assert [stages.local_step(step) for step in range(6)] == [0, 1, 2, 3, 0, 1]
    assert [stages.share(step) for step in range(6)] == [0, 0.25, 0.5, 0.75, 0, 0.5]


def test_pixel_count_grows_linearly():
    """Sides grow from 0.3 to 1 over half of the run, pixels from 9 to 100 percent."""
    assert shrink_at(0.0, 0.3, 0.5) == pytest.approx(10 / 3)
    assert shrink_at(0.25, 0.3, 0.5) == pytest.approx(10 / 8)  # 0.738, rounded up to a tenth
    assert shrink_at(0.4999, 0.3, 0.5) == shrink_at(0.5, 0.3, 0.5) == shrink_at(1.0, 0.3, 0.5) == 1
    assert shrink_at(0.0, 1.0, 0.5) == shrink_at(0.0, 0.3, 0.0) == 1


@pytest.mark.parametrize("name", ["3dgs", "flod", "clod"])
def test_first_steps_use_reduced_images_and_last_steps_full_ones(data, name):
    parameters = replace(
        METHODS[name].presets["draft"], first_resolution=0.5, full_resolution=0.5, far_share=0.0
    )
    method = create(name, data, parameters, 0, "cpu")
    first, last = method.choose_view(0), method.choose_view(method.steps - 1)
    assert first.shrink == 2 and first.camera.width == data.train[0].width // 2
    assert tuple(first.target.image.shape[:2]) == (first.camera.height, first.camera.width)
    assert last.shrink == 1 and last.camera is data.train[last.index]


@pytest.mark.parametrize("name", ["3dgs", "flod", "matryoshka"])
def test_some_steps_see_the_scene_from_farther_away(data, name):
    """A quarter of the steps after density control have half or a quarter of the size, but not the last."""
    parameters = replace(METHODS[name].presets["draft"], full_resolution=0.5, far_share=0.25)
    method = create(name, data, parameters, 0, "cpu")
    steps = method.stages.ends[0] if name == "flod" else method.steps
    factors = [method.shrink(step) for step in range(steps // 2 + 1, int(0.9 * steps))]
    assert set(factors) == {1, 2, 4}
    assert {method.shrink(step) for step in (*range(steps // 2 - 9, steps // 2 - 1), steps - 1)} == {1}
    assert np.mean(np.array(factors) > 1) == pytest.approx(0.25, abs=0.05)
    view = method.choose_view(steps // 2 + 1 + factors.index(4))
    assert view.camera.width == data.train[0].width // 4
    assert view.target.image.shape[1] == view.camera.width


def test_gradients_of_reduced_images_are_scaled_down(data):
    method = create("3dgs", data, METHODS["3dgs"].presets["draft"], 0, "cpu")
    view = data.view(0, 2)
    drawings = method.draw(view, 0)
    method.loss(drawings, view, 0).backward()
    method.model.accumulate_stats(drawings[0].rendering, shrink=2)
    halved = method.model.stats["gradient_sum"].clone()
    method.model.reset_stats()
    method.model.accumulate_stats(drawings[0].rendering)
    assert halved.any()
    torch.testing.assert_close(2 * halved, method.model.stats["gradient_sum"])
