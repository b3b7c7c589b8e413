"""Image metrics compared with hand calculations, and FLoD's selection with the paper's inequality."""

import math

import numpy as np
import pytest
import torch

from training.evaluate.metrics import MAX_PSNR, fit_exposure, psnr, ssim, to_8_bit
from training.lod.selection import resolve_controls, select
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level


def test_psnr_of_a_known_difference():
    target = torch.full((8, 8, 3), 100 / 255)
    # every value 10 of 255 off: 20 log10(255 / 10) dB
    assert psnr(target + 10 / 255, target) == pytest.approx(20 * math.log10(25.5), abs=1e-3)


def test_images_are_clamped_and_rounded_to_8_bits():
    image = torch.tensor([[[-0.2, 0.5003, 1.7]]])
    assert (to_8_bit(image) * 255).tolist() == [[[0, 128, 255]]]
    similar = torch.full((8, 8, 3), 0.5) + 0.0004  # rounds to the same byte as 0.5
    assert psnr(similar, torch.full((8, 8, 3), 0.5)) == MAX_PSNR == 100


def test_fitted_exposure_matches_least_squares():
    rng = np.random.default_rng(1)
    image, noise = (torch.from_numpy(rng.uniform(size=(9, 7, 3)).astype(np.float32)) for _ in range(2))
    gains, offsets = torch.tensor([0.5, 1.3, 0.9]), torch.tensor([0.1, -0.05, 0.0])
    torch.testing.assert_close(fit_exposure(image, image * gains + offsets), image * gains + offsets)
    target = image * gains + offsets + 0.1 * noise
    expected = np.empty((9, 7, 3))
    for channel in range(3):
        x, y = (values[..., channel].numpy().ravel() for values in (image, target))
        expected[..., channel] = np.polyval(np.polyfit(x, y, 1), x).reshape(9, 7)
    np.testing.assert_allclose(fit_exposure(image, target), expected, atol=1e-5)
    mask = torch.zeros(9, 7)
    mask[:5] = 1
    target[5:] = 0  # masked
    upper = np.polyfit(image[:5, :, 1].numpy().ravel(), target[:5, :, 1].numpy().ravel(), 1)
    fitted = fit_exposure(image, target, mask)[..., 1]
    np.testing.assert_allclose(fitted, np.polyval(upper, image[..., 1].numpy()), atol=1e-5)
    flat = torch.full((9, 7, 3), 0.25)  # a gain cannot vary one colour
    torch.testing.assert_close(fit_exposure(flat, target), target.mean((0, 1)).expand(9, 7, 3))


def test_ssim_is_one_for_equal_images_and_decreases_with_noise():
    rng = np.random.default_rng(0)
    image = torch.from_numpy(rng.uniform(size=(32, 40, 3)).astype(np.float32))
    assert ssim(image, image) == pytest.approx(1.0)
    little, much = (image + s * torch.randn(image.shape, generator=torch.manual_seed(0)) for s in (0.05, 0.3))
    assert 1 > ssim(little, image) > ssim(much, image)


def random_splats(count: int, seed: int) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 10, (count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.zeros((count, 3), np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("start, end", [(3, 5), (2, 3), (4, 4), (1, 5)])
def test_selection_matches_the_papers_inequality(start, end):
    s_min = [0.4, 0.1, 0.025, 0.00625, 0.0]
    levels = [Level(n, random_splats(200, n), {"s_min": s_min[n - 1]}) for n in range(1, 6)]
    bundle = Bundle("flod", levels, "bands")
    center, focal, gamma = np.array([1.0, 2, 3]), 900.0, 1.5
    expected = []
    for number in range(start, end + 1):  # Eq. 7, per splat
        for mean in bundle.levels[number - 1].splats.means:
            distance = math.dist(mean, center)
            near = 0 if number == end else s_min[number - 1] / gamma * focal
            far = math.inf if number == start else s_min[number - 2] / gamma * focal
            if near <= distance < far:
                expected.append(mean)
    values = resolve_controls(bundle, {"gamma": gamma, "first": start, "last": end})
    chosen, weights = select(bundle, center, focal, values)
    assert weights is None
    np.testing.assert_array_equal(chosen.means, np.array(expected, np.float32).reshape(-1, 3))
    assert len(chosen.sh) == len(chosen.means)


def test_only_unmasked_pixels_count():
    """Errors are 0.1 inside the mask and 0.9 outside."""
    target = torch.full((20, 20, 3), 0.05)
    image, mask = target + 0.9, torch.zeros(20, 20)
    image[:, :10], mask[:, :10] = target[:, :10] + 0.1, 1.0
    off = to_8_bit(target + 0.1)[0, 0, 0] - to_8_bit(target)[0, 0, 0]
    assert psnr(image, target, mask) == pytest.approx(-20 * np.log10(float(off)), abs=1e-3)
    assert psnr(image, target) < psnr(image, target, mask)
    clean = torch.where(mask[..., None] > 0, image, target)
    assert ssim(image, target, mask) == pytest.approx(ssim(clean, target))
