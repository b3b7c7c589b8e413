"""Order of points along a Z-order curve, where neighbours in space are close. numpy only."""

from __future__ import annotations

import numpy as np

from .batches import batch_slices

AXIS_BITS = 21
"""Bits per axis of a Morton code."""
_BATCH = 1 << 16
"""Morton codes per batch."""


def spatial_order(means: np.ndarray) -> np.ndarray:
    """Return an order (N,) int64 of points (N, 3) along a Z-order curve."""
    return np.argsort(morton_codes(means), kind="stable")


def morton_codes(means: np.ndarray) -> np.ndarray:
    """Return Morton codes (N,) uint64 of means (N, 3), with 2^AXIS_BITS cells along the longest side."""
    if not len(means):
        return np.zeros(0, np.uint64)
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.01, 0.99), axis=0)
    low, high = low - (high - low) / 4, high + (high - low) / 4  # outliers are clamped to the border
    unit = ((1 << AXIS_BITS) - 1) / max(float((high - low).max()), 1e-30)
    code = np.zeros(len(means), np.uint64)
    for batch in batch_slices(len(means), _BATCH):
        cells = np.clip((means[batch] - low) * unit, 0, (1 << AXIS_BITS) - 1)
        for axis, cell in enumerate(cells.astype(np.uint64).T):
            for shift, mask in (
                (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
            ):  # fmt: skip
                cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
            code[batch] |= cell << np.uint64(axis)
    return code
