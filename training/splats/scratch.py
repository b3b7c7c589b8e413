"""Temporary storage of splats in an unnamed file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .gaussians import Splats
from .ply import all_columns, splats_from_rows, to_records

_PAGE = 64
"""Rows per page. Requested rows on neighbouring pages are read together."""
_RUN = 1 << 15
"""Maximum number of rows of one read."""


class ScratchFile:
    """Splats with identical columns in a file that disappears when it is closed or the process ends.

    Reads and writes are explicit calls, because mapped pages would count as memory of the process.

    Args:
        folder: location of the file.

    Raises:
        LodgsError: the folder is not writable.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._count = 0
        self._row = np.dtype([])
        with self._readable_errors():
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115

    def __enter__(self) -> ScratchFile:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Discard the splats."""
        self._file.close()

    def write(self, begin: int, splats: Splats) -> None:
        """Write splats to consecutive rows from ``begin``, which may lie beyond the last row.

        Raises:
            LodgsError: the disk is full, or the file cannot be written.
        """
        records = to_records(all_columns(splats))
        self._row = self._row if self._row.names else records.dtype
        assert records.dtype == self._row, "splats with other columns"
        self._count = max(self._count, begin + len(splats))
        with self._readable_errors():
            self._file.seek(begin * self._row.itemsize)
            remaining = records.view(np.uint8).data
            while remaining:
                remaining = remaining[self._file.write(remaining) :]

    def append(self, splats: Splats) -> None:
        """Write splats after the last row.

        Raises:
            LodgsError: see :meth:`write`.
        """
        self.write(len(self), splats)

    def select(self, rows: slice | np.ndarray) -> Splats:
        """Read the splats of a range of rows, or of rows (M,) in any order.

        Raises:
            LodgsError: the file cannot be read.
        """
        if isinstance(rows, slice):
            begin, end, _ = rows.indices(self._count)
            return splats_from_rows(self._read(begin, max(begin, end)), "")
        order = np.argsort(rows, kind="stable")
        opaque_row = np.dtype((np.void, self._row.itemsize))  # numpy copies it faster than separate fields
        rows = rows[order]
        records = np.empty(len(rows), opaque_row)
        pages = rows // _PAGE
        breaks = np.flatnonzero((np.diff(pages) > 1) | (np.diff(rows // _RUN) > 0)) + 1
        for begin, end in pairwise([0, *breaks.tolist(), len(rows)]):
            if begin < end:
                run = self._read(int(rows[begin]), int(rows[end - 1]) + 1).view(opaque_row)
                records[order[begin:end]] = run[rows[begin:end] - rows[begin]]
        return splats_from_rows(records.view(self._row), "")

    def _read(self, begin: int, end: int) -> np.ndarray:
        records = np.empty(end - begin, self._row)
        with self._readable_errors():
            self._file.seek(begin * self._row.itemsize)
            remaining = records.view(np.uint8).data
            while remaining:
                count = self._file.readinto(remaining)
                if not count:
                    raise OSError("it is truncated")
                remaining = remaining[count:]
        return records

    @contextmanager
    def _readable_errors(self) -> Iterator[None]:
        """Turn OSError into LodgsError."""
        try:
            yield
        except OSError as error:
            raise LodgsError(
                f"Cannot read or write a temporary file in {self._folder}: {error.strerror or error}.",
                "Free some space there or choose another folder.",
            ) from error
