"""Batches of rows, which keep temporary arrays small."""

from __future__ import annotations

from collections.abc import Iterator

from .gaussians import SplatRows, Splats

BATCH_ROWS = 1 << 15
"""Rows per batch when splats are larger than memory."""


def batch_slices(count: int, size: int = BATCH_ROWS) -> Iterator[slice]:
    """Yield consecutive slices of ``size`` rows, the last one shorter, that cover ``count`` rows."""
    for begin in range(0, count, size):
        yield slice(begin, min(begin + size, count))


def read_batches(rows: SplatRows) -> Iterator[Splats]:
    """Read all splats, BATCH_ROWS at a time; yields at least one batch, which may be empty."""
    for batch in batch_slices(max(len(rows), 1)):
        yield rows.select(batch)
