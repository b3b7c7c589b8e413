"""L1 and structural similarity with their gradient on a device; formulas are in ``shaders/loss.wgsl``."""

from __future__ import annotations

import numpy as np

from .bin import TILE, group_count
from .device import Buffer, Device


def loss_and_gradient(
    device: Device, drawn: Buffer, photo: Buffer, ssim_weight: float
) -> tuple[float, np.ndarray]:
    """Compute (1 − ssim_weight) L1 + ssim_weight (1 − SSIM) of an image, and its gradient (H, W, 4).

    Args:
        drawn: (H, W, 4); the first three channels are used.
        photo: (H, W, 3).
    """
    parts, gradient = record_loss(device, drawn, photo, ssim_weight)
    height, width, _ = drawn.shape
    l1, ssim = device.read(parts).sum(0, dtype=np.float64)
    return combine_loss(l1, ssim, 3 * height * width, ssim_weight), device.read(gradient)


def combine_loss(l1: float, ssim: float, size: int, ssim_weight: float) -> float:
    """Compute the loss from the sums of L1 and SSIM over ``size`` values."""
    return (1 - ssim_weight) * float(l1) / size + ssim_weight * (1 - float(ssim) / size)


def record_loss(device: Device, drawn: Buffer, photo: Buffer, ssim_weight: float) -> tuple[Buffer, Buffer]:
    """Record the loss of an image (H, W, 4).

    Args:
        photo: (H, W) with one byte per colour, or (H, W, 3).

    Returns:
        Parts (G, 2) of the sums of L1 and SSIM, and the gradient (H, W, 4).
    """
    height, width, _ = drawn.shape
    count = 3 * height * width
    groups = group_count(width, TILE) * group_count(height, TILE)
    weights = (1 - ssim_weight) / count, ssim_weight / count
    numbers = *weights, width, height, int(len(photo.shape) == 3)
    slopes = device.scratch(np.float32, 9, height, width)
    parts = device.scratch(np.float32, groups, 2)
    gradient = device.scratch(np.float32, height, width, 4)
    device.run("loss", "compare", groups, numbers, drawn=drawn, photo=photo, slopes=slopes, parts=parts)
    device.run(
        "loss", "differentiate", groups, numbers, drawn=drawn, photo=photo, slopes_of=slopes,
        by_image=gradient,
    )  # fmt: skip
    return parts, gradient
