"""Which splats of a finished level a coarser one keeps, and how these cover for the others. No torch."""

from __future__ import annotations

import numpy as np

from ..lod.blocks import SIZE


def importance_threshold(importance: np.ndarray, views: np.ndarray, most: float) -> float:
    """The importance from which on splats stay, so that no more are drawn than may be.

    Args:
        importance: (N,) of each splat; the most important ones stay.
        views: (N,) in how many views each is drawn.
        most: over these views together so many may be.

    Returns:
        A value of ``importance``; 0 where all may stay, or none.
    """
    descending = np.argsort(-importance, kind="stable")
    within = int(np.searchsorted(views[descending].cumsum(), most, side="right"))
    return float(importance[descending[within - 1]]) if 0 < within < len(importance) else 0.0


def log_scale_gain(log_scales: np.ndarray, shares: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """What is to be added to log-scales (N, 3), (N,), so that those that are kept cover what all did.

    In each block, areas weighted by the splats' shares of a pixel add up to what they were. At most doubles
    a splat's size: a block of which nearly nothing is kept is not one surface.
    """
    if not len(kept):
        return np.zeros(0, np.float32)
    begins = np.arange(0, len(kept), SIZE)
    ordered = np.sort(log_scales, axis=1)
    covered = shares * np.exp(ordered[:, 1] + ordered[:, 2]).astype(np.float64)
    before, after = (np.add.reduceat(each, begins) for each in (covered, covered * kept))
    wider = np.log(np.clip(before / np.maximum(after, 1e-30), 1, 4)) / 2
    return np.repeat(wider, SIZE)[: len(kept)].astype(np.float32)
