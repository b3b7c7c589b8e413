"""Image quality, through torchmetrics, on images rounded to 8 bits as published numbers are."""

from __future__ import annotations

import torch

MAX_PSNR = 100.0
"""What equal images count as, in dB, so that means over views stay numbers."""


MASK_THRESHOLD = 0.5
"""Pixels whose mask is above this count."""


def to_8_bit(image: torch.Tensor) -> torch.Tensor:
    """Clamped to [0, 1] and rounded to the 256 values that a file holds, still float32."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def psnr(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two images (H, W, 3), display-coded; MOST_PSNR at most.

    Args:
        mask: (H, W), only pixels where it is above a half count, if there are such.
    """
    from torchmetrics.functional.image import peak_signal_noise_ratio

    image, target = map(to_8_bit, _counted(image, target, mask))
    return min(float(peak_signal_noise_ratio(image, target, data_range=1.0)), MAX_PSNR)


def fit_exposure(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """An image (H, W, 3) with the gain and offset of each channel that bring it closest to a target.

    Least squares; what ``optimize.exposure`` learns of a training view, found for one that was held out.

    Args:
        mask: as of :func:`psnr`.
    """
    pixels, wanted = _counted(image, target, mask)
    mean, goal = pixels.mean(0), wanted.mean(0)
    around = pixels - mean
    gain = (around * (wanted - goal)).sum(0) / (around**2).sum(0).clamp_min(1e-12)
    return (image - mean) * gain + goal


def ssim(image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Structural similarity of (H, W, 3) images, 11x11 Gaussian window of sigma 1.5 (Wang et al. 2004).

    Args:
        mask: (H, W), where it is not above a half the target stands for the image.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure

    if mask is not None:
        image = torch.where((mask > MASK_THRESHOLD)[..., None], image, target)
    pair = [to_8_bit(each).permute(2, 0, 1)[None] for each in (image, target)]
    return float(structural_similarity_index_measure(*pair, data_range=1.0))  # type: ignore[arg-type]


def _counted(
    image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of two images (H, W, 3) the pixels that count, (P, 3)."""
    if mask is not None and bool((mask > MASK_THRESHOLD).any()):
        return image[mask > MASK_THRESHOLD], target[mask > MASK_THRESHOLD]
    return image.reshape(-1, 3), target.reshape(-1, 3)
