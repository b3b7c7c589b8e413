"""The 3D filter against what convolution does to a Gaussian, worked by hand."""

import math

import numpy as np
import pytest
import torch

from training.rasterize.filter3d import pixel_spacing, smoothed
from training.scenes.cameras import Camera


def test_a_filtered_splat_is_wider_and_keeps_its_mass():
    scales = torch.tensor([[0.3, 0.4, 1.2], [2.0, 1e-6, 1.0]], dtype=torch.float64)
    opacities = torch.tensor([0.9, 0.2], dtype=torch.float64)
    wider, logits = smoothed(scales.log(), opacities.logit(), torch.tensor([0.4, 1.0]))
    torch.testing.assert_close(
        wider.exp()[0], torch.tensor([0.5, math.sqrt(0.32), math.sqrt(1.6)]).double(), rtol=1e-6, atol=0
    )
    mass = opacities * scales.prod(1)
    torch.testing.assert_close(logits.sigmoid() * wider.exp().prod(1), mass, rtol=1e-6, atol=0)


def test_no_filter_changes_nothing():
    log_scales, logits = torch.randn(5, 3), torch.randn(5)
    wider, faded = smoothed(log_scales, logits, 0.0)
    torch.testing.assert_close(wider, log_scales)
    torch.testing.assert_close(faded, logits)


def test_the_filters_gradients_are_finite_differences():
    tensors = [torch.randn(4, 3).double().requires_grad_(), torch.randn(4).double().requires_grad_()]
    assert torch.autograd.gradcheck(lambda a, b: smoothed(a, b, 0.7), tensors)


def test_the_spacing_is_the_finest_of_the_cameras_that_see_a_splat():
    near = Camera("near", 100, 80, 50.0, 40.0, 50.0, 40.0, np.eye(4))
    back = np.eye(4)
    back[2, 3] = 6.0  # six units behind the first
    far = Camera("far", 400, 320, 200.0, 160.0, 200.0, 160.0, back)
    means = torch.tensor([[0.0, 0, 1], [0, 0, 4], [0, 0, -3], [1.25, 0, 1], [0, 0, -20]])
    spacing = pixel_spacing(means, [near, far])
    # seen by both: the finer; the third by the far one only; the fourth lies beside near's image,
    # within the margin; the last behind both
    expected = [min(1 / 50, 7 / 200), min(4 / 50, 10 / 200), 3 / 200, min(1 / 50, 7 / 200), 10 / 200]
    np.testing.assert_allclose(spacing, expected, rtol=1e-6)
    assert pixel_spacing(means, []).tolist() == [0.0] * 5


@pytest.mark.parametrize("shape", [(0, 3)])
def test_no_splats_are_no_trouble(shape):
    assert pixel_spacing(torch.zeros(shape), []).shape == (0,)
    wider, logits = smoothed(torch.zeros(shape), torch.zeros(0), 1.0)
    assert wider.shape == shape and logits.shape == (0,)
