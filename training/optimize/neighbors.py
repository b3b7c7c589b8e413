"""Queries of k-d trees on all cores."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial import KDTree


def query_neighbors(tree: KDTree, positions: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances and indices of the nearest points of a tree, (N,), or (N, count) for several.

    An interrupt waits for the query: scipy's threads would continue and write to freed memory.
    """
    with ThreadPoolExecutor(1) as pool:
        distances, indices = pool.submit(tree.query, positions, count, workers=-1).result()
    return np.asarray(distances), np.asarray(indices)
