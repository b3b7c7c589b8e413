"""Tests of initial splats."""

import numpy as np
import pytest
import torch

from training.optimize.initialize import from_points, neighbor_distances


def test_neighbour_distances_equal_brute_force():
    points = np.random.default_rng(1).normal(size=(200, 3))
    full = np.linalg.norm(points[:, None] - points[None], axis=2)
    expected = np.sort(full, axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbor_distances(points), expected, rtol=1e-12)


def test_initial_scale_is_the_rms_neighbour_distance_and_colours_are_preserved():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]], float)
    colors = np.array([[255, 0, 51]] * 5, np.uint8)
    tensors = from_points(points, colors, sh_degree=1)
    assert tensors["log_scales"][0].exp().tolist() == pytest.approx([np.sqrt((1 + 4 + 9) / 3)] * 3)
    color = 0.5 + 0.28209479177387814 * tensors["sh"][0, 0]
    assert color.tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)
    assert torch.sigmoid(tensors["opacity_logits"]).tolist() == pytest.approx([0.1] * 5)
    assert not tensors["sh"][:, 1:].any()


def test_training_does_not_change_the_scene_points():
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    original = points.copy()
    tensors = from_points(points, np.zeros((10, 3), np.uint8), sh_degree=0)
    tensors["means"] += 1
    np.testing.assert_array_equal(points, original)
