"""Restriction of growth to the job's region."""

from __future__ import annotations

import torch

from ..lod.crop import Crop
from .model import PEAK_STATS, Model
from .schedules import due

OUTSIDE = "outside"
"""Column that marks rows outside the region with 1: no splats are added there."""
UPDATE_INTERVAL = 50
"""Steps between two updates of this column."""


class GrowthRegion:
    """Region in which splats are added.

    Args:
        region: region in scene coordinates; None for everywhere.
    """

    def __init__(self, region: Crop | None) -> None:
        self._region = region

    def clear_outside(self, model: Model, step: int) -> None:
        """Clear the gradient statistics of splats outside, so that none are added there."""
        if self._region is None:
            return
        if OUTSIDE not in model.columns or due(UPDATE_INTERVAL, step):
            outside = ~self._region.contains(model["means"].detach().cpu().numpy())
            model.columns[OUTSIDE] = torch.from_numpy(outside).to(model["means"])
        for name in ("gradient_sum", PEAK_STATS[0]):
            if name in model.stats:
                model.stats[name][model.columns[OUTSIDE] > 0] = 0
