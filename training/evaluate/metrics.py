"""Image metrics, on images rounded to 8 bits as in publications."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import conv2d, pad

MAX_PSNR = 100.0
"""PSNR of equal images in dB, which keeps means over views finite."""
MASK_THRESHOLD = 0.5
"""Pixels count if their mask exceeds this value."""
WINDOW, SIGMA = 11, 1.5
"""Side and standard deviation of the windows of SSIM, in pixels."""
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM that keep its fractions finite."""


def to_8_bit(image: torch.Tensor) -> torch.Tensor:
    """Clamp to [0, 1] and round to the 256 values of 8-bit files, as float32."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, at most MAX_PSNR, of display-coded images (H, W, 3).

    Args:
        mask: (H, W); only pixels above MASK_THRESHOLD count, or all if there are none.
    """
    image, target = map(to_8_bit, _masked_pixels(image, target, mask))
    error = float(((image - target) ** 2).mean())
    return min(-10 * math.log10(error), MAX_PSNR) if error else MAX_PSNR


def fit_exposure(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """Fit an image (H, W, 3) to a target by a gain and an offset per channel, with least squares.

    ``optimize.exposure`` learns the same model for training views; this fits it for held-out ones.

    Args:
        mask: as for :func:`psnr`.
    """
    pixels, goal = _masked_pixels(image, target, mask)
    mean, goal_mean = pixels.mean(0), goal.mean(0)
    centered = pixels - mean
    gain = (centered * (goal - goal_mean)).sum(0) / (centered**2).sum(0).clamp_min(1e-12)
    return (image - mean) * gain + goal_mean


def ssim(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Return the structural similarity (Wang et al. 2004) of (H, W, 3) images.

    The Gaussian windows have 11x11 pixels and sigma 1.5. Images are reflected at their edges, as in
    torchmetrics.

    Args:
        mask: (H, W); pixels up to MASK_THRESHOLD are replaced with the target.
    """
    x, y = (to_8_bit(i).permute(2, 0, 1) for i in (replace_masked(image, target, mask), target))
    window = torch.exp(-((torch.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2)).to(x)
    window /= window.sum()
    x, y = (pad(i, 4 * [WINDOW // 2], mode="reflect") for i in (x, y))
    moments = torch.stack([x, y, x * x, y * y, x * y])[:, :, None].flatten(0, 1)
    moments = conv2d(conv2d(moments, window[None, None, :, None]), window[None, None, None])
    mean_x, mean_y, xx, yy, xy = moments.unflatten(0, (5, 3))
    variances = (xx - mean_x**2).clamp_min(0) + (yy - mean_y**2).clamp_min(0)
    means = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return float((means * (2 * (xy - mean_x * mean_y) + C2) / (variances + C2)).mean())


def replace_masked(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Replace the pixels of an image (H, W, 3) that do not count with the target."""
    return image if mask is None else torch.where((mask > MASK_THRESHOLD)[..., None], image, target)


def _masked_pixels(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pixels (P, 3) of two images (H, W, 3) that count."""
    if mask is not None and bool((mask > MASK_THRESHOLD).any()):
        return image[mask > MASK_THRESHOLD], target[mask > MASK_THRESHOLD]
    return image.reshape(-1, 3), target.reshape(-1, 3)
