"""Mip-Splatting's 3D filter as a function on splats: none is finer than the pixels that saw it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch.nn.functional import logsigmoid

from ..scenes.cameras import Camera

VARIANCE = 0.2
"""The filter's variance in squared pixels (Mip-Splatting, Yu et al. 2024, Sec. 6)."""


@torch.no_grad()
def pixel_spacing(
    means: torch.Tensor, cameras: Iterable[Camera], near: float = 0.01, margin: float = 0.15
) -> torch.Tensor:
    """The size (N,) of a pixel at each splat, in world units, in the camera that samples it most finely.

    z / f, the least over the cameras that see the mean (Mip-Splatting, Eq. 7); what none sees takes the
    largest of the others.

    Args:
        means: (N, 3) in the world.
        near: a camera sees what lies deeper than this, in world units,
        margin: and within its image widened by this share of its size on every side.
    """
    points = means.double().cpu().numpy()
    spacing = np.full(len(points), np.inf)
    for camera in cameras:
        seen = camera.sees(points, near, margin)
        finest = camera.view_space(points)[seen, 2] / max(camera.fx, camera.fy)
        spacing[seen] = np.minimum(spacing[seen], finest)
    known = np.isfinite(spacing)
    spacing[~known] = spacing[known].max() if known.any() else 0.0
    return torch.from_numpy(spacing).to(means)


def smoothed(
    log_scales: torch.Tensor, opacity_logits: torch.Tensor, std: torch.Tensor | float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats convolved with a round Gaussian, their mass kept; differentiable.

    Sigma + std² I, and the opacity times sqrt(|Sigma| / |Sigma + std² I|) (Mip-Splatting, Eq. 9; LODGE,
    Eq. 3).

    Args:
        log_scales: (N, 3).
        opacity_logits: (N,).
        std: (N,) or one number, of at least 0, in world units: ``VARIANCE ** 0.5 * pixel_spacing(...)``, or
            with a level's own distance over the focal length in the place of the spacing (LODGE).

    Returns:
        log_scales (N, 3) and opacity_logits (N,).
    """
    log_std = torch.as_tensor(std).to(log_scales).clamp_min(torch.finfo(log_scales.dtype).tiny).log()
    wider = 0.5 * torch.logaddexp(2 * log_scales, 2 * log_std.expand(len(log_scales))[:, None])
    log_opacity = logsigmoid(opacity_logits) + (log_scales - wider).sum(1)
    return wider, log_opacity - torch.log(-torch.expm1(log_opacity))
