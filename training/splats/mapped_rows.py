"""Rows of files that are mapped into memory."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .coding import CodedRows


def require_size(rows: np.ndarray | CodedRows, path: str | Path) -> None:
    """Raise a LodgsError if a mapped file has lost rows: the system ends processes that read there."""
    base: object = rows.codes if isinstance(rows, CodedRows) else rows
    offset = 0
    while isinstance(base, np.ndarray):
        offset = getattr(base, "offset", offset)
        base = base.base
    if isinstance(base, mmap.mmap):
        begin = offset - offset % mmap.ALLOCATIONGRANULARITY
        if base.size() < begin + len(base):
            raise LodgsError(
                f"Cannot read {path}: another program has truncated it.",
                "Restore the file, and open it again.",
            )


def release_pages(rows: np.ndarray | CodedRows) -> None:
    """Release the pages of a mapped file that have been read, which count as memory of the process."""
    base = rows.codes if isinstance(rows, CodedRows) else rows
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
        base.madvise(mmap.MADV_DONTNEED)
