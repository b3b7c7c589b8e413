"""Batches of rows, which keep temporary arrays small."""

from __future__ import annotations

from collections.abc import Iterator


def batch_slices(count: int, size: int) -> Iterator[slice]:
    """Yield consecutive slices of ``size`` rows, the last one shorter, that cover ``count`` rows."""
    for begin in range(0, count, size):
        yield slice(begin, min(begin + size, count))
