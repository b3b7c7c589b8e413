"""Splats in a file of no name, which takes them out of memory for a while."""

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
"""Rows that are read together where some of them are wanted."""
_RUN = 1 << 15
"""Most rows that are read together."""


class ScratchFile:
    """Splats of the same columns, in a file that goes when it is closed, or the process ends.

    The file is read and written by explicit calls: a mapped page would count as the process's own memory.

    Args:
        folder: where the file is.

    Raises:
        LodgsError: the folder takes no file.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._row = np.dtype([])
        with self._telling():
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115

    def __enter__(self) -> ScratchFile:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Forgets the splats."""
        self._file.close()

    def write(self, begin: int, splats: Splats) -> None:
        """Puts splats at the rows from one on, which may be beyond the last one.

        Raises:
            LodgsError: the disk is full, or the file cannot be written.
        """
        records = to_records(all_columns(splats))
        self._row = self._row if self._row.names else records.dtype
        assert records.dtype == self._row, "splats of other columns"
        self._count = max(self._count, begin + len(splats))
        with self._telling():
            self._file.seek(begin * self._row.itemsize)
            left = records.view(np.uint8).data
            while left:
                left = left[self._file.write(left) :]

    def append(self, splats: Splats) -> None:
        """Adds splats at the end.

        Raises:
            LodgsError: as :meth:`write`.
        """
        self.write(len(self), splats)

    def select(self, rows: slice | np.ndarray) -> Splats:
        """The splats of a range of rows, or of rows (M,) in any order.

        Raises:
            LodgsError: the file cannot be read.
        """
        if isinstance(rows, slice):
            begin, end, _ = rows.indices(self._count)
            return splats_from_rows(self._read(begin, max(begin, end)), "")
        order = np.argsort(rows, kind="stable")
        whole = np.dtype((np.void, self._row.itemsize))  # which numpy copies faster than field by field
        rows, found = rows[order], np.empty(len(rows), whole)
        pages = rows // _PAGE
        breaks = np.flatnonzero((np.diff(pages) > 1) | (np.diff(rows // _RUN) > 0)) + 1
        for begin, end in pairwise([0, *breaks.tolist(), len(rows)]):
            if begin < end:
                part = self._read(int(rows[begin]), int(rows[end - 1]) + 1).view(whole)
                found[order[begin:end]] = part[rows[begin:end] - rows[begin]]
        return splats_from_rows(found.view(self._row), "")

    def _read(self, begin: int, end: int) -> np.ndarray:
        records = np.empty(end - begin, self._row)
        with self._telling():
            self._file.seek(begin * self._row.itemsize)
            left = records.view(np.uint8).data
            while left:
                got = self._file.readinto(left)
                if not got:
                    raise OSError("it is cut short")
                left = left[got:]
        return records

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """What goes wrong with the file is a LodgsError."""
        try:
            yield
        except OSError as error:
            raise LodgsError(
                f"A file in {self._folder} could not be read or written: {error.strerror or error}.",
                "Free some space there or choose another folder.",
            ) from error
