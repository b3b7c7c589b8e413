"""Loss of inverse depths, where the depth of a training view is known."""

from __future__ import annotations

import torch

from ..rasterize import Rendering, Target
from .schedules import log_linear

FINAL_WEIGHT = 0.01
"""Weight at the end, as a share of the initial one."""


class DepthLoss:
    """Weighted mean |Σ w / z − 1 / depth| over pixels with known depth.

    As in H3DGS (Kerbl et al. 2024), but in inverse median depths.

    Args:
        weight: initial weight; 0 disables.
        median_depth: median depth of the scene, in scene units.
    """

    def __init__(self, weight: float, median_depth: float) -> None:
        self._weight = weight
        self._median_depth = median_depth

    @property
    def outputs(self) -> tuple[str, ...]:
        """Additional outputs that renderings need; see ``rasterize``."""
        return ("inverse_depth",) if self._weight else ()

    def __call__(self, rendering: Rendering, target: Target, share: float) -> torch.Tensor | float:
        """Return the loss of a rendering after a share of the steps, 0 if no depth is known."""
        rendered = rendering.inverse_depth
        truth = target.inverse_depth
        if rendered is None or truth is None:
            return 0.0
        truth = truth.to(rendered)
        valid = truth.isfinite()
        error = torch.where(valid, rendered - truth, 0).abs().sum() / valid.sum().clamp_min(1)
        weight = log_linear(self._weight, FINAL_WEIGHT * self._weight, share)
        return weight * self._median_depth * error
