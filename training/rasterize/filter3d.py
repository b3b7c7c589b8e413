"""Mip-Splatting's 3D smoothing filter."""

from __future__ import annotations

import torch
from torch.nn.functional import logsigmoid


def apply_filter3d(
    log_scales: torch.Tensor, opacity_logits: torch.Tensor, std: torch.Tensor | float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Convolve splats with an isotropic Gaussian and preserve their mass; differentiable.

    The covariance Sigma becomes Sigma + std² I, and the opacity is multiplied by
    sqrt(|Sigma| / |Sigma + std² I|) (Mip-Splatting, Eq. 9; LODGE, Eq. 3).

    Args:
        log_scales: (N, 3).
        opacity_logits: (N,).
        std: (N,) or a number, non-negative, in world units. In LODGE it is the filter's standard deviation in
            pixels, times a level's distance, divided by the focal length.

    Returns:
        log_scales (N, 3) and opacity_logits (N,).
    """
    log_std = torch.as_tensor(std).to(log_scales).clamp_min(torch.finfo(log_scales.dtype).tiny).log()
    wider = 0.5 * torch.logaddexp(2 * log_scales, 2 * log_std.expand(len(log_scales))[:, None])
    log_opacity = logsigmoid(opacity_logits) + (log_scales - wider).sum(1)
    return wider, log_opacity - torch.log(-torch.expm1(log_opacity))
