"""Simplification of splats while a view moves, for graphics that draw all of them too slowly.

This module uses numpy only and runs in a worker thread.
"""

from __future__ import annotations

import numpy as np

FACTOR_STEPS = 8
"""Steps to find the probabilities whose sum is the wanted number; more change it by less than a percent."""
SAMPLE = 65_536
"""Number of splats above which the probabilities are estimated from every second splat, every third, ..."""
MIN_PROBABILITY = 1e-4
"""Lowest probability; its splats become a hundred times as large."""
CONE = 0.5
"""Cosine of the angle from the direction of the view beyond which splats count as beside it."""
BESIDE = 0.1
"""Factor of the visibility of splats beside the view, which a turn shows before the next simplification."""


def simplify(instances: np.ndarray, visibility: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose about ``count`` splats that look like all of them, in their order.

    Splats of low visibility are kept with a probability p in proportion to it, and enlarged to 1 / p of their
    area (stochastic simplification, Cook et al. 2007). A splat stays kept while its probability grows.

    Args:
        instances: (M, 4) float32, see ``arrangement.Arrangement``.
        visibility: (M,) area in the image times opacity.

    Returns:
        Indices (K,) of the kept splats, and their (K, 4) instances; the third value is the placement number
        plus 1 - sqrt(p).
    """
    step = max(len(visibility) // SAMPLE, 1)
    factor = _clipped_factor(visibility[::step], count / step)
    probability = np.clip(visibility * np.float32(factor), np.float32(MIN_PROBABILITY), np.float32(1))
    hashes = instances[:, 0].astype(np.uint32) * np.uint32(0x9E3779B1)  # evenly distributed, Knuth
    kept = np.flatnonzero(hashes < probability.astype(np.float64) * 2.0**32)
    simplified = instances[kept]
    simplified[:, 2] += 1 - np.sqrt(probability[kept])
    return kept, simplified


def dim_beside(visibility: np.ndarray, offsets: np.ndarray, backward: tuple[float, float, float]) -> None:
    """Reduce the visibility (M,) of splats beside the view in place.

    Args:
        offsets: (M, 3) from the view to the splats.
        backward: direction opposite to the view direction, of length 1.
    """
    along = offsets @ -np.array(backward, np.float32)
    is_beside = along < CONE * np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
    visibility[is_beside] *= np.float32(BESIDE)


def _clipped_factor(values: np.ndarray, total: float) -> float:
    """Return the factor with which values (M,), each clipped to 1, have this sum, which M exceeds."""
    factor = 0.0
    for _ in range(FACTOR_STEPS):
        rest = values[values * np.float32(factor) < 1]
        room, rest_sum = total - (len(values) - len(rest)), float(rest.sum(dtype=np.float64))
        if room <= 0 or rest_sum <= 0:
            break
        factor = room / rest_sum
    return factor
