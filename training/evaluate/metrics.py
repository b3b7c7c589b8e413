"""Image quality, through torchmetrics, on images rounded to 8 bits as published numbers are."""

from __future__ import annotations

import torch

MOST_PSNR = 100.0
"""What equal images count as, in dB, so that means over views stay numbers."""


def to_8_bit(image: torch.Tensor) -> torch.Tensor:
    """Clamped to [0, 1] and rounded to the 256 values that a file holds, still float32."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    """Peak signal-to-noise ratio in dB of two images (H, W, 3), display-coded; MOST_PSNR at most."""
    from torchmetrics.functional.image import peak_signal_noise_ratio

    return min(float(peak_signal_noise_ratio(to_8_bit(image), to_8_bit(target), data_range=1.0)), MOST_PSNR)


def exposed_as(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """An image (H, W, 3) with the gain and offset of each channel that bring it closest to a target.

    Least squares; what ``methods.exposure`` learns of a training view, found for one that was held out.
    """
    mean, goal = image.mean((0, 1)), target.mean((0, 1))
    around = image - mean
    gain = (around * (target - goal)).sum((0, 1)) / (around**2).sum((0, 1)).clamp_min(1e-12)
    return around * gain + goal


def ssim(image: torch.Tensor, target: torch.Tensor) -> float:
    """Structural similarity of (H, W, 3) images, 11x11 Gaussian window of sigma 1.5 (Wang et al. 2004)."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    pair = [to_8_bit(each).permute(2, 0, 1)[None] for each in (image, target)]
    return float(structural_similarity_index_measure(*pair, data_range=1.0))  # type: ignore[arg-type]
