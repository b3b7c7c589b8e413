"""Views in an order that stays near: a walk over the graph of each view's nearest neighbours."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

NEIGHBOURS = 100
"""How many of its nearest views may follow a view, as the authors have it."""
BLOCK = 128
"""Of so many steps the first one's view is random."""
SPREAD = 1.0
"""W, as a multiple of the median distance of a view to those that may follow it."""


class ViewOrder:
    """A view for each step, most of them near the one before ("A LoD of Gaussians", Sec. 4.4).

    After view i comes one of its k nearest, j with P(j | i) proportional to 1 / (w_ij + W), where w_ij is the
    distance of their cameras. W has no value in the paper, and in the authors' program one in their scene's
    units; here it is a multiple of the median of all w_ij. The first view of each block of steps is random:
    of a new shuffle of all views each time that all have been first, so that every view is seen.

    A step's view depends on (cameras, seed, step) alone: nothing is to be saved, and it can be asked ahead.

    Args:
        centers: (V, 3) of the cameras, V >= 1.
        neighbours: k; no more than there are others.
        spread: W over the median distance; the larger, the less the distance counts.
        block: steps from one random view to the next.

    Attributes:
        neighbours: (V, k) the views that may follow each, nearest first.
        chances: (V, k) float64, how likely each of these is; rows add up to 1.
    """

    def __init__(
        self,
        centers: np.ndarray,
        seed: int,
        neighbours: int = NEIGHBOURS,
        spread: float = SPREAD,
        block: int = BLOCK,
    ) -> None:
        count = len(centers)
        self._seed, self._block = seed, block
        k = min(neighbours, count - 1)
        distances, found = KDTree(centers).query(centers, k + 1)
        found, distances = found.reshape(count, k + 1), distances.reshape(count, k + 1)
        # itself is among them: not always first where cameras stand in one place, nor at all where many do
        others = found != np.arange(count)[:, None]
        others[others.all(1), -1] = False
        self.neighbours = found[others].reshape(count, k)
        distances = distances[others].reshape(count, k)
        typical = float(np.median(distances)) if k else 0.0
        weights = 1 / (distances + spread * typical) if typical > 0 and spread > 0 else _limit(distances)
        self.probabilities = weights / weights.sum(1, keepdims=True)
        self._ends = np.cumsum(self.probabilities, 1)
        self._views = lru_cache(8)(self._walked)

    def __call__(self, step: int) -> int:
        """The view of a step, from 0."""
        block, place = divmod(step, self._block)
        return int(self._views(block)[place])

    def _walked(self, block: int) -> np.ndarray:
        """The views (block,) of a block of steps."""
        count = len(self.neighbours)
        epoch, place = divmod(block, count)
        views = np.empty(self._block, np.int64)
        views[0] = np.random.default_rng([self._seed, epoch, 21]).permutation(count)[place]
        draws = np.random.default_rng([self._seed, block, 22]).random(self._block)
        for step in range(1, self._block):
            view = views[step - 1]
            if self.neighbours.shape[1]:
                which = np.searchsorted(self._ends[view], draws[step] * self._ends[view, -1], side="right")
                view = self.neighbours[view, min(which, self.neighbours.shape[1] - 1)]
            views[step] = view
        return views


def _limit(distances: np.ndarray) -> np.ndarray:
    """What chances tend to where W is 0: by the inverse distance, or to those in the same place alone."""
    same = distances == 0
    with np.errstate(divide="ignore"):
        return np.where(same.any(1, keepdims=True), same, 1 / distances)
