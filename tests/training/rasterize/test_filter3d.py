"""Compare the 3D filter with the analytic convolution of Gaussians."""

import math

import torch

from training.rasterize.filter3d import apply_filter3d


def test_filtered_splat_is_wider_and_preserves_mass():
    scales = torch.tensor([[0.3, 0.4, 1.2], [2.0, 1e-6, 1.0]], dtype=torch.float64)
    opacities = torch.tensor([0.9, 0.2], dtype=torch.float64)
    wider, logits = apply_filter3d(scales.log(), opacities.logit(), torch.tensor([0.4, 1.0]))
    torch.testing.assert_close(
        wider.exp()[0], torch.tensor([0.5, math.sqrt(0.32), math.sqrt(1.6)]).double(), rtol=1e-6, atol=0
    )
    mass = opacities * scales.prod(1)
    torch.testing.assert_close(logits.sigmoid() * wider.exp().prod(1), mass, rtol=1e-6, atol=0)


def test_zero_filter_changes_nothing():
    log_scales, logits = torch.randn(5, 3), torch.randn(5)
    wider, faded = apply_filter3d(log_scales, logits, 0.0)
    torch.testing.assert_close(wider, log_scales)
    torch.testing.assert_close(faded, logits)


def test_gradients_match_finite_differences():
    tensors = [torch.randn(4, 3).double().requires_grad_(), torch.randn(4).double().requires_grad_()]
    assert torch.autograd.gradcheck(lambda a, b: apply_filter3d(a, b, 0.7), tensors)


def test_empty_input():
    wider, logits = apply_filter3d(torch.zeros(0, 3), torch.zeros(0), 1.0)
    assert wider.shape == (0, 3) and logits.shape == (0,)
