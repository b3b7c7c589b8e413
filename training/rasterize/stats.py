"""Statistics of density control, summed over training images."""

from __future__ import annotations

from collections.abc import MutableMapping

import torch

PEAK_STATS = ("gradient_max", "radius_max")
"""Stats of densification by maxima: gradient as in ``gradient_sum``, and radius in pixels."""


@torch.no_grad()
def accumulate_stats(
    stats: MutableMapping[str, torch.Tensor],
    grad2d: torch.Tensor,
    radii: torch.Tensor,
    opacity_logits: torch.Tensor | None = None,
    shrink: float = 1,
) -> None:
    """Add an image's gradient norms, draw counts and opacities to the stats (N,) that exist.

    Args:
        stats: ``gradient_sum`` and ``seen``, and optionally ``opacity_sum`` and PEAK_STATS, which are maxima.
        grad2d, radii: see ``Rendering``.
        opacity_logits: (N,), for ``opacity_sum``.
        shrink: factor by which the image was reduced, which enlarged gradients by the same factor (see
            ``TrainingData.threshold_scale``).
    """
    gradient = grad2d.norm(dim=1) / shrink
    stats["gradient_sum"] += gradient
    drawn = radii > 0
    stats["seen"] += drawn
    for name, values in zip(PEAK_STATS, (gradient, radii), strict=True):
        if name in stats:
            stats[name] = torch.maximum(stats[name], values)
    if "opacity_sum" in stats and opacity_logits is not None:
        stats["opacity_sum"] += torch.where(drawn, opacity_logits.sigmoid(), 0)
