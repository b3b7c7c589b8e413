"""Image metrics, on images rounded to 8 bits as in publications."""

from __future__ import annotations

import math

import torch

MAX_PSNR = 100.0
"""PSNR of equal images in dB, which keeps means over views finite."""
MASK_THRESHOLD = 0.5
"""Pixels count if their mask exceeds this value."""


def to_8_bit(image: torch.Tensor) -> torch.Tensor:
    """Clamp values of any shape to [0, 1] and round them to the 256 values of 8-bit files, as float32."""
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
    """Return the structural similarity of (H, W, 3) images, 11x11 Gaussian window of sigma 1.5.

    Wang et al. 2004.

    Args:
        mask: (H, W); pixels up to MASK_THRESHOLD are replaced with the target.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure

    pair = [  # interleaved channels take half the time
        to_8_bit(x).permute(2, 0, 1)[None].contiguous(memory_format=torch.channels_last)
        for x in (replace_masked(image, target, mask), target)
    ]
    return float(structural_similarity_index_measure(*pair, data_range=1.0))  # type: ignore[arg-type]


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
