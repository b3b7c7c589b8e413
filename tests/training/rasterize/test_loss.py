"""Compare the photometric loss with scipy, and its gradient with autograd in float64."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from training.rasterize import Target, photometric_loss
from training.rasterize.cpu.loss import loss_and_gradient


def scipy_loss(image, truth, ssim_weight):
    """Compute the loss in float64 with scipy's filter and the formula of Wang et al. 2004, Eq. 13."""
    line = np.exp(-(np.arange(-5.0, 6) ** 2) / 4.5)
    line /= line.sum()

    def window(planes):
        return correlate1d(correlate1d(planes, line, 0, mode="constant"), line, 1, mode="constant")

    mx, my = window(image), window(truth)
    vx, vy = window(image**2) - mx**2, window(truth**2) - my**2
    vxy = window(image * truth) - mx * my
    c1, c2 = 1e-4, 9e-4
    ssim = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return (1 - ssim_weight) * np.abs(image - truth).mean() + ssim_weight * (1 - ssim.mean())


@pytest.mark.parametrize("size", [(50, 75), (90, 108), (3, 5), (1, 230)])
def test_loss_matches_scipy(backend, size):
    random = np.random.default_rng(0)
    truth = random.random((*size, 3)).astype(np.float32)
    image = np.clip(truth + random.normal(0, 0.2, truth.shape), 0, 1).astype(np.float32)
    for ssim_weight in (0.0, 0.2, 1.0):
        loss = photometric_loss(torch.tensor(image), Target(truth), ssim_weight, backend=backend)
        expected = scipy_loss(image.astype(np.float64), truth.astype(np.float64), ssim_weight)
        assert loss.item() == pytest.approx(expected, rel=2e-5)


@pytest.mark.parametrize("size", [(50, 75), (90, 108), (3, 5), (1, 230)])
def test_fused_gradient_matches_autograd(kernels, size):
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(*size, 3, generator=random)
    start = (truth + 0.1 * torch.randn(*size, 3, generator=random)).clamp(0, 1)
    gradients = []
    for backend, kind in ((kernels, torch.float32), ("reference", torch.float64)):
        image = start.to(kind).clone().requires_grad_()
        (3 * photometric_loss(image, Target(truth.to(kind)), backend=backend)).backward()
        gradients.append(image.grad.double())
    assert (gradients[0] - gradients[1]).norm() <= 1e-4 * gradients[1].norm()


@pytest.mark.parametrize("size", [(48, 64), (37, 53)])
def test_loss_is_bit_identical_for_any_array_address(size):
    """Loops that sum and write may be compiled in two versions, for overlapping and separate arrays."""
    random = np.random.default_rng(0)
    truth, image = random.random((2, 3, *size), dtype=np.float32)
    results = set()
    fillers = []
    for _ in range(400):
        arrays = []
        for array in (image, truth):
            fillers[:] = [
                np.empty(length, np.uint8) for length in random.integers(100, 20_000, random.integers(30))
            ]
            arrays.append(array.copy())
        loss, gradient = loss_and_gradient(*arrays, 0.2)
        results.add((loss, gradient.tobytes()))
    assert len(results) == 1


def test_masked_pixels_do_not_affect_loss(backend):
    """Masked pixels act as if photo and image were equal; a mask of 0.5 halves the difference."""
    random = torch.Generator().manual_seed(0)
    truth, image = torch.rand(2, 40, 60, 3, generator=random)
    mask = torch.ones(40, 60)
    mask[:, 30:], mask[:, 10:20] = 0, 0.5
    leaf = image.clone().requires_grad_()
    loss = photometric_loss(leaf, Target(truth, mask), backend=backend)
    loss.backward()
    masked = truth.clone()
    masked[:, :30] = image[:, :30]
    masked[:, 10:20] = (image[:, 10:20] + truth[:, 10:20]) / 2
    expected = scipy_loss(masked.double().numpy(), truth.double().numpy(), 0.2)
    assert loss.item() == pytest.approx(expected, rel=2e-5)
    assert leaf.grad is not None and leaf.grad[:, 30:].abs().max() == 0 and leaf.grad[:, :30].abs().min() > 0
    with pytest.raises(ValueError, match="mask must have shape"):
        Target(truth, mask[:5])


def test_equal_images_have_zero_loss(backend):
    image = torch.rand(20, 30, 3, requires_grad=True)
    loss = photometric_loss(image, Target(image.detach().clone()), backend=backend)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-6)
    assert image.grad.abs().max() < 1e-6
