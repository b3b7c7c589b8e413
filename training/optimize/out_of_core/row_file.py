"""Rows of numbers outside memory: splats with their moments in one file of a run, read and written in parts.

The file consists of slots that hold a block of rows each, and a table says which slot each block is in. What
a checkpoint has is never overwritten: the first time that a block is written after one, it goes to another
slot, and a checkpoint is the table alone, with a checksum of each block, kept in what ``checkpoints`` writes
by rename. So it costs what has changed since the last one, and whatever ends a trainer, a full disk too,
leaves every checkpoint as it was.

The file is read and written by explicit calls, not mapped: a mapped page counts as the process's own memory
for as long as the system leaves it there, and a failing disk would end the process by a signal.
"""

from __future__ import annotations

import os
import re
import zlib
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import FileIO
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import torch

from ...errors import LodgsError

BLOCK = 16
"""Rows of a block. Of rows that a step brings half as many bytes are written as with 64: blocks are whole."""
TABLE_BYTES = 21
"""Bytes in memory for each block, at most: where it is, its checksum, and where checkpoints have it."""
MAX_GAP = 4
"""Blocks between two that are wanted, at most, which are read with them: it takes less time than a call."""
STAGING_BYTES = 3 << 18
"""Bytes of blocks that are between file and tensors at a time; in up to six copies, all told."""
OLD_CHECKPOINTS = 2
"""Checkpoints before the newest one whose blocks stay: a run has as many, the newest may not be whole yet."""


class RowLayout:
    """What a row holds: arrays by name, one after the other, float32.

    Attributes:
        shapes: of each array of a row; () for a number.
        width: numbers of a row.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.shapes = {name: tuple(shape) for name, shape in shapes.items()}
        self.width = sum(map(prod, self.shapes.values()))

    def split(self, records: torch.Tensor) -> dict[str, torch.Tensor]:
        """Views of records (M, width), by name: (M, ...)."""
        parts = records.split([prod(shape) for shape in self.shapes.values()], dim=1)
        shapes = zip(self.shapes.items(), parts, strict=True)
        return {name: part.unflatten(1, shape) if shape else part[:, 0] for (name, shape), part in shapes}

    def join(self, tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Records (M, width) of tensors (M, ...) by name."""
        return torch.cat([tensors[name].reshape(len(tensors[name]), -1) for name in self.shapes], 1)


class RowFile:
    """Rows in a file of a folder; in memory are some numbers of each block of them, see TABLES.

    For one thread. Where a write fails, what it was to replace may be lost: nothing more is read or written
    then, and a run goes on from its last checkpoint.

    Args:
        folder: where the file is made, when first written to, under a name of its own.
        block: rows that are read and written together at least.
        staging: bytes, see STAGING.
        name: what the file's name begins with; others in the same folder have other ones.
    """

    def __init__(
        self,
        folder: Path,
        layout: RowLayout,
        block: int = BLOCK,
        staging: int = STAGING_BYTES,
        name: str = "rows",
    ) -> None:
        self.layout, self._folder, self._block, self._name = layout, folder, block, name
        self._blocks_at_once = max(staging // (4 * layout.width * block), 1)
        self._file: FileIO | None = None
        self._broken: LodgsError | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._count, self._size = 0, 0  # rows, and slots that the file has
        self._slots = np.zeros(0, np.int32)  # of each block; -1: all zeros, in none
        self._checks = np.zeros(0, np.int32)  # CRC-32 of each block
        self._fresh = np.zeros(0, bool)  # whether it has been written since the last checkpoint
        self._free = np.zeros(0, np.int32)  # slots that nobody needs
        self._retiring: list[np.ndarray] = []  # slots of the last checkpoint that have been replaced since
        self._retired: deque[np.ndarray] = deque()  # the same of the checkpoints before it, oldest first
        self._named: deque[str] = deque(
            maxlen=OLD_CHECKPOINTS + 1
        )  # files that these and the last one tell of

    def __len__(self) -> int:
        return self._count

    # -- rows ------------------------------------------------------------------------------------------

    @property
    def tables(self) -> int:
        """Bytes in memory, at most."""
        return TABLE_BYTES * len(self._slots)

    def read(
        self, rows: np.ndarray, records: torch.Tensor | None = None, at: np.ndarray | None = None
    ) -> torch.Tensor:
        """Records (M, width) at rows (M,) int64, in any order, on the CPU.

        Args:
            records: where they are put, (N, width) on the CPU, and come back; None: they alone.
            at: (M,) int64 in these, each once; None: all.

        Raises:
            LodgsError: the file cannot be read.
        """
        self._require_whole()
        rows = _checked(rows, self._count)
        records = torch.empty(len(rows), self.layout.width) if records is None else records
        found, slots = records.numpy(), self._slots[rows // self._block].astype(np.int64)
        there = np.flatnonzero(slots >= 0)
        to = there if at is None else at[there]
        if len(there) < len(rows):
            nowhere = np.flatnonzero(slots < 0)
            found[nowhere if at is None else at[nowhere]] = 0
        self._read_places(slots[there] * self._block + rows[there] % self._block, to, found)
        return records

    def write(self, rows: np.ndarray, records: torch.Tensor, at: np.ndarray | None = None) -> None:
        """Puts records (M, width) at rows (M,) int64, each named once, in any order.

        Args:
            at: (M,) int64: these of records (N, width); None: all.

        Raises:
            LodgsError: the disk is full, or the file cannot be written.
            ValueError: a row is named twice.
        """
        self._require_whole()
        rows = _checked(rows, self._count)
        values = records.detach().numpy()
        if (np.diff(rows) < 0).any():
            order = np.argsort(rows)
            rows, at = rows[order], order if at is None else at[order]
        if (np.diff(rows) == 0).any():
            raise ValueError("a row is written twice")
        begins = _begins(rows // self._block)
        ends = np.append(begins[1:], len(rows))
        for first in range(0, len(begins), self._blocks_at_once):
            some = slice(first, first + self._blocks_at_once)
            part = slice(begins[some][0], ends[some][-1])
            given = values[part] if at is None else values[at[part]]
            self._write_blocks((ends - begins)[some], rows[part], given)

    def append(self, records: torch.Tensor) -> None:
        """Adds rows (M, width) at the end.

        Raises:
            LodgsError: as :meth:`write`.
        """
        begin, self._count = self._count, self._count + len(records)
        more = -(-self._count // self._block) - len(self._slots)
        self._slots = np.append(self._slots, np.full(more, -1, np.int32))
        self._checks = np.append(self._checks, np.zeros(more, np.int32))
        self._fresh = np.append(self._fresh, np.zeros(more, bool))
        self.write(np.arange(begin, self._count), records)

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """A checkpoint, for the file that is then written; what it tells of is on the disk.

        Call it for nothing else: after three further calls slots of this one are used again.

        Raises:
            LodgsError: the disk does not take it.
        """
        self._require_whole()
        with self._telling():
            if self._file is not None:
                os.fsync(self._file.fileno())
        self._retired.append(_joined(self._retiring))
        self._retiring = []
        while len(self._retired) > OLD_CHECKPOINTS:
            self._free = np.sort(np.append(self._free, self._retired.popleft()))
        self._fresh[:] = False
        self._named.append(self._file_name)
        if len(self._named) > OLD_CHECKPOINTS:
            self._remove_others()
        return {
            "file": self._file_name,
            "named": list(self._named),
            "count": self._count,
            "block": self._block,
            "shapes": {name: list(shape) for name, shape in self.layout.shapes.items()},
            "slots": torch.from_numpy(self._slots.copy()),
            "checks": torch.from_numpy(self._checks.copy()),
            "retired": [torch.from_numpy(slots) for slots in self._retired],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from a checkpoint, all of which is read once to be sure of it.

        Raises:
            ValueError: the file is not there, is damaged, or is not of such rows.
        """
        self.discard()
        shapes = {name: tuple(shape) for name, shape in state["shapes"].items()}
        if shapes != self.layout.shapes or state["block"] != self._block:
            raise ValueError("its rows are of another kind")
        self._count = state["count"]
        self._slots, self._checks = (state[name].cpu().numpy().copy() for name in ("slots", "checks"))
        self._retired = deque(slots.cpu().numpy().copy() for slots in state["retired"])
        self._named.extend(state.get("named", ()))  # older checkpoints do not have it
        self._fresh = np.zeros(len(self._slots), bool)
        if not (0 <= self._count <= len(self._slots) * self._block and len(self._slots) == len(self._checks)):
            raise ValueError("its table of rows is damaged")
        if state["file"]:
            if not self._may_be(state["file"]):
                raise ValueError("its file of rows has an impossible name")
            path = self._folder / state["file"]
            if path.is_symlink() or not path.is_file():
                raise ValueError(f"{path.name} is missing")
            self._open(path)
        self._verify()
        taken = np.concatenate([self._slots[self._slots >= 0], *self._retired])
        self._free = np.setdiff1d(np.arange(self._size, dtype=np.int32), taken)

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def supersede(self, other: RowFile) -> None:
        """Takes the place of other rows of the same folder, whose file goes once no checkpoint has it."""
        self._named.extend(other._named)
        other.discard()

    def discard(self) -> None:
        """Forgets all rows; a file that no checkpoint tells of is removed."""
        if self._file is not None:
            path, unknown = Path(str(self._file.name)), self._file_name not in self._named
            self.close()
            if unknown:
                path.unlink(missing_ok=True)
        self._broken = None
        self._begin_anew()

    def _verify(self) -> None:
        if (self._slots >= self._size).any() or (self._slots < -1).any():
            raise ValueError("its file of rows is cut short")
        there = np.flatnonzero(self._slots >= 0)
        there = there[np.argsort(self._slots[there])]
        for first in range(0, len(there), self._blocks_at_once):
            some = there[first : first + self._blocks_at_once]
            found = np.empty((len(some), self._block, self.layout.width), np.float32)
            self._read_slots(self._slots[some], np.arange(len(some)), found)
            if (_checksums(found) != self._checks[some]).any():
                raise ValueError("its file of rows is damaged")

    def _remove_others(self) -> None:
        """Removes files that no checkpoint tells of any more, of earlier lives of the run as well."""
        for path in self._folder.glob(f"{self._name}_*.bin"):
            if self._may_be(path.name) and path.name not in self._named:
                with suppress(OSError):
                    path.unlink()

    def _may_be(self, name: str) -> bool:
        return re.fullmatch(rf"{self._name}_[0-9a-f]{{8}}\.bin", name) is not None

    # -- blocks ----------------------------------------------------------------------------------------

    def _write_blocks(self, given: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
        """Writes the blocks (B,) of rows (M,), ascending, of which each has so many: ``given`` (B,)."""
        blocks = rows[np.cumsum(given) - given] // self._block
        before, fresh = self._slots[blocks], self._fresh[blocks]
        held = np.minimum(self._count - blocks * self._block, self._block)
        slots = before.copy()
        slots[~fresh] = self._new_slots(int((~fresh).sum()))
        place = np.empty_like(slots)  # of each block in the buffer, which is in the order of the file
        place[np.argsort(slots)] = np.arange(len(slots))
        buffer = np.zeros((len(slots), self._block, self.layout.width), np.float32)
        old = np.flatnonzero((given < held) & (before >= 0))
        self._read_slots(before[old], place[old], buffer)
        buffer[np.repeat(place, given), rows % self._block] = values
        with self._telling():
            file = self._file or self._open(self._folder / f"{self._name}_{uuid4().hex[:8]}.bin", new=True)
            in_order = np.sort(slots)
            for run in _runs(in_order):
                file.seek(int(in_order[run.start]) * self._block_bytes)
                _write(file, buffer[run])
        self._slots[blocks], self._checks[blocks], self._fresh[blocks] = (
            slots,
            _checksums(buffer)[place],
            True,
        )
        self._retiring.append(before[~fresh & (before >= 0)])

    def _new_slots(self, count: int) -> np.ndarray:
        """Slots that nobody needs, ascending; at the end of the file where there are no others."""
        found, self._free = self._free[:count], self._free[count:]
        end = np.arange(self._size, self._size + count - len(found), dtype=np.int32)
        self._size += len(end)
        return np.append(found, end)

    def _read_slots(self, slots: np.ndarray, to: np.ndarray, found: np.ndarray) -> None:
        """Reads the blocks in slots (B,) to places ``to`` (B,) among blocks ``found`` (., block, width)."""
        inside = np.arange(self._block)
        places, to = ((each[:, None].astype(np.int64) * self._block + inside).ravel() for each in (slots, to))
        self._read_places(places, to, found.reshape(-1, self.layout.width))

    def _read_places(self, places: np.ndarray, to: np.ndarray, found: np.ndarray) -> None:
        """Reads the rows at places (M,), counted through all slots, to rows ``to`` (M,) of ``found``.

        Blocks that follow each other, or nearly, are read at once, with what is between. What does not go
        where it belongs as it lies there is put in its places afterwards, as much of it together as STAGING
        has.
        """
        if (np.diff(places) < 0).any():
            order = np.argsort(places)
            places, to = places[order], to[order]
        most = self._blocks_at_once * self._block
        runs = _runs(places // self._block, places // most, 1 + MAX_GAP)
        gaps = np.append(0, np.cumsum((np.diff(places) != 1) | (np.diff(to) != 1)))[: len(places)]
        staged = np.empty((0, self.layout.width), np.float32)
        at, used, begin, end = np.empty_like(places), 0, 0, 0  # rows of ``staged``; runs that wait in it
        with self._telling():
            for run in runs:
                first, last = int(places[run.start]), int(places[run.stop - 1])
                as_they_lie = gaps[run.start] == gaps[run.stop - 1] and last - first >= self._block
                count = 0 if as_they_lie else last - first + 1
                if begin < end and (as_they_lie or used + count > most):
                    found[to[begin:end]] = staged[at[begin:end]]
                    used = begin = end = 0
                assert self._file is not None, "where a block has a slot there is a file"
                self._file.seek(first * 4 * self.layout.width)
                if as_they_lie:
                    _read(self._file, found[to[run.start] : to[run.stop - 1] + 1])
                    continue
                if not len(staged):
                    staged = np.empty((most, self.layout.width), np.float32)
                _read(self._file, staged[used : used + count])
                np.add(places[run], used - first, out=at[run])
                used, begin, end = used + count, begin if used else run.start, run.stop
            found[to[begin:end]] = staged[at[begin:end]]

    # -- the file --------------------------------------------------------------------------------------

    def _open(self, path: Path, new: bool = False) -> FileIO:
        self._file = file = open(path, "x+b" if new else "r+b", buffering=0)  # noqa: SIM115
        self._size = max(self._size, os.fstat(file.fileno()).st_size // self._block_bytes)
        return file

    @property
    def _file_name(self) -> str:
        return "" if self._file is None else Path(str(self._file.name)).name

    @property
    def _block_bytes(self) -> int:
        return 4 * self.layout.width * self._block

    def _require_whole(self) -> None:
        if self._broken is not None:
            raise self._broken

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """What goes wrong with the file is a LodgsError, then and later."""
        try:
            yield
        except OSError as error:
            place = self._folder if self._file is None else self._file.name
            self._broken = LodgsError(
                f"{place} could not be read or written: {error.strerror or error}.",
                "Free some space there or choose another folder, then resume the run.",
            )
            raise self._broken from error


def _checked(rows: np.ndarray, count: int) -> np.ndarray:
    rows = np.asarray(rows, np.int64)
    if len(rows) and (rows.min() < 0 or rows.max() >= count):
        raise IndexError(f"rows from {rows.min()} to {rows.max()}, there are {count}")
    return rows


def _joined(arrays: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(arrays) if arrays else np.zeros(0, np.int32)


def _runs(numbers: np.ndarray, cells: np.ndarray | None = None, apart: int = 1) -> list[slice]:
    """Where ascending numbers (M,) are at most so far apart, without leaving a cell."""
    if not len(numbers):
        return []
    breaks = np.diff(numbers) > apart
    if cells is not None:
        breaks |= np.diff(cells) > 0
    borders = [0, *(np.flatnonzero(breaks) + 1).tolist(), len(numbers)]
    return [slice(*ends) for ends in pairwise(borders)]


def _begins(numbers: np.ndarray) -> np.ndarray:
    """Where each of ascending numbers (M,) is the first time."""
    return np.flatnonzero(np.append(True, np.diff(numbers) > 0)[: len(numbers)])


def _checksums(blocks: np.ndarray) -> np.ndarray:
    """CRC-32 of each block."""
    return np.array([zlib.crc32(block) for block in blocks], np.uint32).view(np.int32)


def _read(file: FileIO, array: np.ndarray) -> None:
    left = array.data.cast("B")
    while left:
        got = file.readinto(left)
        if not got:
            raise OSError("it is cut short")
        left = left[got:]


def _write(file: FileIO, array: np.ndarray) -> None:
    left = np.ascontiguousarray(array).data.cast("B")
    while left:
        left = left[file.write(left) :]
