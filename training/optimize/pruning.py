"""Selection of a coarser level's splats from a finished level. Does not import torch."""

from __future__ import annotations

import numpy as np

from ..lod.blocks import SIZE


def importance_threshold(importance: np.ndarray, views: np.ndarray, budget: float) -> float:
    """Return the importance above which splats are kept within a budget.

    Args:
        importance: (N,) importance of each splat; the most important ones are kept.
        views: (N,) number of views that draw each splat.
        budget: maximum number of splats drawn, summed over all views.

    Returns:
        A value of ``importance``, or 0 if all splats or none fit the budget.
    """
    descending = np.argsort(-importance, kind="stable")
    within = int(np.searchsorted(views[descending].cumsum(), budget, side="right"))
    return float(importance[descending[within - 1]]) if 0 < within < len(importance) else 0.0


def log_scale_gain(log_scales: np.ndarray, shares: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Compute the enlargement that lets the kept splats cover the area of all splats.

    Areas are weighted by the splats' shares of a pixel and summed in each block. Splats at most double in
    size, because a block that loses nearly all splats is not one surface.

    Args:
        log_scales: (N, 3).
        shares: (N,) share of a pixel.
        mask: (N,) bool, the kept splats.

    Returns:
        (N,) float32 offsets to add to the log-scales.
    """
    if not len(mask):
        return np.zeros(0, np.float32)
    begins = np.arange(0, len(mask), SIZE)
    ascending = np.sort(log_scales, axis=1)
    area = shares * np.exp(ascending[:, 1] + ascending[:, 2]).astype(np.float64)
    total = np.add.reduceat(area, begins)
    remaining = np.add.reduceat(area * mask, begins)
    gain = np.log(np.clip(total / np.maximum(remaining, 1e-30), 1, 4)) / 2
    return np.repeat(gain, SIZE)[: len(mask)].astype(np.float32)
