"""Order of training views with nearby successors: a random walk over the graph of nearest neighbours."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import KDTree

NEIGHBORS = 100
"""Number of nearest views that may follow a view, as in the published program."""
BLOCK = 128
"""Steps between two random views."""
SPREAD = 1.0
"""W, as a multiple of the median distance of a view to its successors."""


class ViewOrder:
    """View of each step, usually near the previous one ("A LoD of Gaussians", Sec. 4.4).

    A view i is followed by one of its k nearest, j with P(j | i) proportional to 1 / (w_ij + W), where w_ij
    is the distance of their cameras. The paper gives no value of W, the published program one in scene units;
    here it is a multiple of the median of all w_ij. The first view of each block of steps is random,
    from a shuffle of all views, so that every view is used.

    A step's view depends only on (cameras, seed, step): it needs no saved state and can be computed ahead.

    Args:
        centers: (V, 3) of the cameras, V >= 1.
        neighbours: k, limited to V - 1.
        spread: W over the median distance; larger values reduce the influence of distance.
        block: steps from one random view to the next.

    Attributes:
        neighbours: (V, k) possible successors of each view, nearest first.
        probabilities: (V, k) float64 of these successors; rows sum to 1.
    """

    def __init__(
        self,
        centers: np.ndarray,
        seed: int,
        neighbors: int = NEIGHBORS,
        spread: float = SPREAD,
        block: int = BLOCK,
    ) -> None:
        count = len(centers)
        self._seed = seed
        self._block = block
        k = min(neighbors, count - 1)
        distances, indices = KDTree(centers).query(centers, k + 1)
        indices, distances = indices.reshape(count, k + 1), distances.reshape(count, k + 1)
        # A view is not always its first neighbour if cameras coincide, and not always among k + 1.
        different = indices != np.arange(count)[:, None]
        different[different.all(1), -1] = False
        self.neighbors = indices[different].reshape(count, k)
        distances = distances[different].reshape(count, k)
        median = float(np.median(distances)) if k else 0.0
        weights = 1 / (distances + spread * median) if median > 0 and spread > 0 else _limit(distances)
        self.probabilities = weights / weights.sum(1, keepdims=True)
        self._ends = np.cumsum(self.probabilities, 1)
        self._views = lru_cache(8)(self._walk_block)

    def __call__(self, step: int) -> int:
        """Return the view of a step, counted from 0."""
        block, position = divmod(step, self._block)
        return int(self._views(block)[position])

    def _walk_block(self, block: int) -> np.ndarray:
        """Return the views (block,) of a block of steps."""
        count = len(self.neighbors)
        epoch, position = divmod(block, count)
        views = np.empty(self._block, np.int64)
        views[0] = np.random.default_rng([self._seed, epoch, 21]).permutation(count)[position]
        draws = np.random.default_rng([self._seed, block, 22]).random(self._block)
        for step in range(1, self._block):
            view = views[step - 1]
            if self.neighbors.shape[1]:
                rank = np.searchsorted(self._ends[view], draws[step] * self._ends[view, -1], side="right")
                view = self.neighbors[view, min(rank, self.neighbors.shape[1] - 1)]
            views[step] = view
        return views


def _limit(distances: np.ndarray) -> np.ndarray:
    """Compute the weights for W = 0: inverse distances, or only coincident cameras if there are any."""
    same = distances == 0
    with np.errstate(divide="ignore"):
        return np.where(same.any(1, keepdims=True), same, 1 / distances)
