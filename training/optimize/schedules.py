"""When things happen in training, and how rates fall."""

from __future__ import annotations

from math import ceil, sqrt


def log_linear(first: float, last: float, share: float) -> float:
    """From the first to the last value, in equal factors, after a share of the steps (all from 1 on)."""
    share = min(share, 1.0)
    return float(first ** (1 - share) * last**share)


def due(interval: int, step: int) -> bool:
    """Whether what happens every ``interval`` steps (0: never) happens after the ``step``-th, from 1."""
    return interval > 0 and step % interval == 0


def shrink_at(share: float, first: float, full: float) -> float:
    """How many times smaller photographs are after a share of the steps.

    Their pixels grow evenly to all. What is coarse is learned sooner from fewer pixels, by fewer splats
    (DashGaussian, Chen et al. 2025). Sides
    are whole tenths, so that photographs of each size can be kept.

    Args:
        first: what photographs' sides begin with, as a share of their own.
        full: the share of the steps from which they have all their pixels.
    """
    grown = min(share / full, 1.0) if full > 0 else 1.0
    side = sqrt(first**2 + (1 - first**2) * grown)
    return 10 / ceil(10 * side - 1e-9)
