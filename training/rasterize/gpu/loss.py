"""L1 and structural similarity with their gradient on a device; formulas are in ``shaders/loss.wgsl``."""

from __future__ import annotations

import numpy as np

from .bin import group_count
from .device import Buffer, Device

SUM_LENGTH = 256
"""Values that one invocation sums."""


def loss_and_gradient(
    device: Device, image: Buffer, truth: Buffer, ssim_weight: float
) -> tuple[float, Buffer]:
    """Compute (1 − ssim_weight) L1 + ssim_weight (1 − SSIM) of images (3, H, W), and its gradient."""
    *sums, gradient = sums_and_gradient(device, image, truth, ssim_weight)
    l1, ssim = (device.read(parts).sum(dtype=np.float64) for parts in sums)
    return combine_loss(l1, ssim, int(np.prod(image.shape)), ssim_weight), gradient


def combine_loss(l1: float, ssim: float, size: int, ssim_weight: float) -> float:
    """Compute the loss from the sums of L1 and SSIM over ``size`` values."""
    return (1 - ssim_weight) * float(l1) / size + ssim_weight * (1 - float(ssim) / size)


def sums_and_gradient(
    device: Device, image: Buffer, truth: Buffer, ssim_weight: float
) -> tuple[Buffer, Buffer, Buffer]:
    """Compute partial sums of L1 and SSIM over SUM_LENGTH values of images (3, H, W), and the gradient."""
    channels, height, width = image.shape
    size = channels * height * width
    lines, slopes = (device.scratch(np.float32, height, width, 4) for _ in range(2))
    similar, different, gradient = (device.scratch(np.float32, *image.shape) for _ in range(3))
    weights = (1 - ssim_weight) / size, ssim_weight / size
    for channel in range(channels):
        launch = group_count(height * width), (*weights, width, height, channel)
        device.run("loss", "products", *launch, image=image, truth=truth, lines=lines)
        device.run("loss", "similarity", *launch, across=lines, by_means=slopes, similar=similar)
        device.run("loss", "slopes_across", *launch, slopes=slopes, lines=lines)
        device.run(
            "loss", "finish", *launch, across=lines, image=image, truth=truth, gradient=gradient,
            different=different,
        )  # fmt: skip
    l1, ssim = (device.scratch(np.float32, group_count(size, SUM_LENGTH)) for _ in range(2))
    for values, totals in ((different, l1), (similar, ssim)):
        numbers = *weights, width, height, 0
        device.run("loss", "add", group_count(totals.shape[0]), numbers, values=values, totals=totals)
    return l1, ssim, gradient
