"""Image of splats as three.js draws them, for ``tools/interop_viewers.py``.

three.js 0.187 (``examples/jsm/objects/GaussianSplat.js``) cuts splats at two standard deviations, adds 0.3
square pixels to their variance, and scales opacity by the change of area.
"""

from __future__ import annotations

import numpy as np
import torch

from training.rasterize import reference
from training.rasterize.gaussians import Gaussians
from training.rasterize.rendering import ALPHA_MAX, KernelCamera
from training.scenes.cameras import Camera
from training.splats import sh as harmonics
from training.splats.gaussians import Splats

CUT = 2.0
"""Standard deviations at which three.js cuts splats."""
VARIANCE = 0.3
"""Square pixels that it adds to the variance of splats."""


def draw_with_cut(
    splats: Splats, camera: Camera, near: float, cut: float = CUT, variance: float = VARIANCE
) -> np.ndarray:
    """Return the image (H, W, 3) float32 of splats over black.

    Args:
        cut: number of standard deviations up to which splats are drawn.
        variance: square pixels added to the variance along each axis of the image.
    """
    gaussians = Gaussians.of(splats, torch.device("cpu"))
    view = KernelCamera.of(camera, near)
    rotation, translation = (torch.as_tensor(part).float() for part in (view.rotation, view.translation))
    position = gaussians.means @ rotation.T + translation
    order = position[:, 2].argsort()
    order = order[position[order, 2] > near]
    scales = gaussians.log_scales[order].exp()
    half = rotation @ reference.rotation_matrices(gaussians.quats[order]) * scales[:, None]
    means, (xx, xy, yy), determinant, area = reference.project(position[order], half, view, variance)
    opacity = torch.sigmoid(gaussians.opacity_logits[order]) * area
    offsets = gaussians.means[order] - torch.as_tensor(view.position).float()
    x, y, z = torch.nn.functional.normalize(offsets).unbind(1)
    values: list = [None] * gaussians.sh.shape[1]
    harmonics.basis(x, y, z, splats.sh_degree, values)
    colors = (torch.stack(values, 1)[:, :, None] * gaussians.sh[order]).sum(1).add(0.5).clamp(0, 1)

    image = np.zeros((camera.height, camera.width, 3), np.float32)
    light = np.ones((camera.height, camera.width), np.float32)
    columns = (means, xx, xy, yy, determinant, opacity, colors)
    for (x, y), a, b, c, det, alpha, color in zip(*(column.numpy() for column in columns), strict=True):
        reach = cut * np.sqrt([a, c])
        left, top = np.maximum(np.ceil((x, y) - reach - 0.5), 0).astype(int)
        right, bottom = np.minimum(np.floor((x, y) + reach + 0.5), (camera.width, camera.height)).astype(int)
        if left >= right or top >= bottom:
            continue
        dx, dy = np.arange(left, right) + 0.5 - x, (np.arange(top, bottom) + 0.5 - y)[:, None]
        distance = (c * dx**2 - 2 * b * dx * dy + a * dy**2) / det
        covered = np.where(distance <= cut**2, alpha * np.exp(-distance / 2), 0).clip(0, ALPHA_MAX)
        part = light[top:bottom, left:right]
        image[top:bottom, left:right] += (part * covered)[..., None] * color
        part *= 1 - covered
    return image
