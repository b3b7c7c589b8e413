"""When things happen in training, and how rates fall."""

from __future__ import annotations


def log_linear(first: float, last: float, share: float) -> float:
    """From the first to the last value, in equal factors, after a share of the steps (all from 1 on)."""
    share = min(share, 1.0)
    return float(first ** (1 - share) * last**share)


def due(interval: int, step: int) -> bool:
    """Whether what happens every ``interval`` steps (0: never) happens after the ``step``-th, from 1."""
    return interval > 0 and step % interval == 0
