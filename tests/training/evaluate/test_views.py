"""Measures of levels that a training finishes repeatedly."""

from dataclasses import replace

import numpy as np

from training.evaluate.views import Evaluation
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level


def bundle_of(splats: Splats, s_min: float) -> Bundle:
    return Bundle("flod", [Level(1, splats, {"s_min": s_min})], "bands")


def test_level_with_the_same_splats_is_measured_once(data, monkeypatch):
    evaluation, images = Evaluation(data, "cpu"), []
    measure_images = evaluation.measure_images

    def count_images(draw_image):
        images.append(draw_image)
        return measure_images(draw_image)

    monkeypatch.setattr(evaluation, "measure_images", count_images)
    means = np.random.default_rng(0).normal(0, 0.3, (50, 3)).astype(np.float32)
    splats = Splats(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (50, 1)),
        np.full((50, 3), -2, np.float32),
        np.zeros(50, np.float32),
        np.zeros((50, 1, 3), np.float32),
    )
    for s_min in (0.0, 0.1):  # another distance for the same splats
        bundle = bundle_of(replace(splats, means=means.copy()), s_min)
        first = evaluation.measure_level(bundle, bundle.levels[0])
    assert len(images) == 1
    bundle = bundle_of(replace(splats, opacity_logits=np.full(50, 2, np.float32)), 0.1)
    second = evaluation.measure_level(bundle, bundle.levels[0])
    assert len(images) == 2
    assert first["splats"] == second["splats"] and first["psnr"] != second["psnr"]
