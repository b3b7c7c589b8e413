"""Tests of training a region in detail, for all methods."""

from __future__ import annotations

import pytest

from training.lod.crop import Crop
from training.methods import METHODS, create, resolve_parameters
from training.optimize.training_data import TrainingData
from training.scenes.colmap import read_scene

HALF = "box -9 -9 -1.5 0 9 9"
"""The half of the tiny scene with x < 0, as its splats are around the origin."""


@pytest.mark.parametrize("name", METHODS)
def test_no_growth_outside_region(name, tiny_scene):
    """Gradients outside the region are zero from the first step on; inside they are not."""
    region = Crop.from_text(HALF)
    data = TrainingData(read_scene(tiny_scene), test_every=4, region=region)
    method = create(name, data, resolve_parameters(name, "draft", {"free_depth": 0.0}), 0, "cpu")
    for step in range(30):
        method.train_step(step)
        gradients = method.model.stats["gradient_sum"].reshape(len(method.model), -1).sum(1).numpy()
        outside = ~region.contains(method.model["means"].detach().numpy() - [0.3, 0, 0])  # splats may move
        assert outside.any() and not gradients[outside].any()
    assert gradients.any()


@pytest.mark.parametrize("name", ["3dgs", "octree"])
def test_resume_is_bit_identical(name, tiny_scene, check_resumed):
    data = TrainingData(read_scene(tiny_scene), test_every=4, region=Crop.from_text(HALF))
    values = {"levels_from": "anchors"} if name == "octree" else {}
    parameters = resolve_parameters(name, "draft", {"steps": 120, "max_splats": 200, **values})
    check_resumed(lambda: create(name, data, parameters, 0, "cpu"), 77)
