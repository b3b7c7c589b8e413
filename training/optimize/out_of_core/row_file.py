"""Rows of numbers on disk: splats with their moments in one file of a run, read and written in blocks.

The file consists of slots of one block of rows each, and a table maps blocks to slots. Slots of a checkpoint
are never overwritten: the first write to a block after a checkpoint goes to another slot. A checkpoint is the
table with a checksum of each block, in the file that ``checkpoints`` writes by rename. Its cost is therefore
proportional to the changes since the last one, and a crash or a full disk leaves every checkpoint intact.

The file is read and written by explicit calls, not mapped: the system counts mapped pages as memory of the
process, and a disk error would end the process by a signal.
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
"""Rows per block. Blocks are written whole; 16 halve the bytes written per step compared with 64."""
TABLE_BYTES = 21
"""Maximum memory per block in bytes: its slot, its checksum and its slots in checkpoints."""
MAX_GAP = 4
"""Maximum gap in blocks to read along, as one larger read is faster than two."""
STAGING_BYTES = 3 << 18
"""Bytes per transfer between file and tensors; up to six copies are in memory."""
OLD_CHECKPOINTS = 2
"""Older checkpoints whose blocks are preserved, as many as a run keeps, in case the newest is incomplete."""


class RowLayout:
    """Layout of a row: consecutive float32 arrays by name.

    Attributes:
        shapes: shape of each array; () for a number.
        width: number of values in a row.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.shapes = {name: tuple(shape) for name, shape in shapes.items()}
        self.width = sum(map(prod, self.shapes.values()))

    def split(self, records: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return views of records (M, width) by name, (M, ...)."""
        parts = records.split([prod(shape) for shape in self.shapes.values()], dim=1)
        shapes = zip(self.shapes.items(), parts, strict=True)
        return {name: part.unflatten(1, shape) if shape else part[:, 0] for (name, shape), part in shapes}

    def join(self, tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Join tensors (M, ...) by name to records (M, width)."""
        return torch.cat([tensors[name].reshape(len(tensors[name]), -1) for name in self.shapes], 1)


class RowFile:
    """Rows in a file, with a table of ``TABLE_BYTES`` per block in memory. Not thread-safe.

    A failed write may lose the previous rows. All later reads and writes fail, and the run has to resume from
    its last checkpoint.

    Args:
        folder: folder of the file, which is created at the first write under a unique name.
        block: rows per block.
        staging: bytes, see ``STAGING_BYTES``.
        name: start of the file's name, unique in the folder.
    """

    def __init__(
        self,
        folder: Path,
        layout: RowLayout,
        block: int = BLOCK,
        staging: int = STAGING_BYTES,
        name: str = "rows",
    ) -> None:
        self.layout = layout
        self._folder = folder
        self._block = block
        self._name = name
        self._batch_blocks = max(staging // (4 * layout.width * block), 1)
        self._file: FileIO | None = None
        self._broken: LodgsError | None = None
        self._clear()

    def _clear(self) -> None:
        self._count = 0  # rows
        self._size = 0  # slots of the file
        self._slots = np.zeros(0, np.int32)  # slot of each block, -1 for zeros without a slot
        self._checks = np.zeros(0, np.int32)  # CRC-32 of each block
        self._fresh = np.zeros(0, bool)  # blocks written since the last checkpoint
        self._free = np.zeros(0, np.int32)  # unused slots
        self._retiring: list[np.ndarray] = []  # slots of the last checkpoint replaced since
        self._retired: deque[np.ndarray] = deque()  # the same for older checkpoints, oldest first
        self._named: deque[str] = deque(maxlen=OLD_CHECKPOINTS + 1)  # files of these checkpoints

    def __len__(self) -> int:
        return self._count

    # -- rows ------------------------------------------------------------------------------------------

    @property
    def table_bytes(self) -> int:
        """Maximum memory of the tables in bytes."""
        return TABLE_BYTES * len(self._slots)

    def read(
        self, rows: np.ndarray, records: torch.Tensor | None = None, at: np.ndarray | None = None
    ) -> torch.Tensor:
        """Read the records (M, width) of rows (M,) int64, in any order, to the CPU.

        Args:
            records: output (N, width) on the CPU; None for a new tensor.
            at: (M,) int64 distinct rows of the output; None for all.

        Returns:
            The output.

        Raises:
            LodgsError: the file cannot be read.
        """
        self._require_intact()
        rows = _check_rows(rows, self._count)
        records = torch.empty(len(rows), self.layout.width) if records is None else records
        output = records.numpy()
        slots = self._slots[rows // self._block].astype(np.int64)
        stored = np.flatnonzero(slots >= 0)
        to = stored if at is None else at[stored]
        if len(stored) < len(rows):
            zero = np.flatnonzero(slots < 0)
            output[zero if at is None else at[zero]] = 0
        self._read_positions(slots[stored] * self._block + rows[stored] % self._block, to, output)
        return records

    def write(self, rows: np.ndarray, records: torch.Tensor, at: np.ndarray | None = None) -> None:
        """Write records (M, width) to distinct rows (M,) int64, in any order.

        Args:
            at: (M,) int64 indices into records (N, width); None for all.

        Raises:
            LodgsError: the disk is full, or the file cannot be written.
            ValueError: duplicate row.
        """
        self._require_intact()
        rows = _check_rows(rows, self._count)
        values = records.detach().numpy()
        if (np.diff(rows) < 0).any():
            order = np.argsort(rows)
            rows, at = rows[order], order if at is None else at[order]
        if (np.diff(rows) == 0).any():
            raise ValueError("duplicate row")
        begins = _run_starts(rows // self._block)
        ends = np.append(begins[1:], len(rows))
        for first in range(0, len(begins), self._batch_blocks):
            batch = slice(first, first + self._batch_blocks)
            part = slice(begins[batch][0], ends[batch][-1])
            source = values[part] if at is None else values[at[part]]
            self._write_blocks((ends - begins)[batch], rows[part], source)

    def append(self, records: torch.Tensor) -> None:
        """Add rows (M, width) at the end.

        Raises:
            LodgsError: see :meth:`write`.
        """
        begin, self._count = self._count, self._count + len(records)
        more = -(-self._count // self._block) - len(self._slots)
        self._slots = np.append(self._slots, np.full(more, -1, np.int32))
        self._checks = np.append(self._checks, np.zeros(more, np.int32))
        self._fresh = np.append(self._fresh, np.zeros(more, bool))
        self.write(np.arange(begin, self._count), records)

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return a checkpoint, after flushing the rows to disk.

        Only call this to write a checkpoint: after three further calls, its slots are reused.

        Raises:
            LodgsError: the file cannot be written.
        """
        self._require_intact()
        with self._convert_errors():
            if self._file is not None:
                os.fsync(self._file.fileno())
        self._retired.append(_concatenate(self._retiring))
        self._retiring = []
        while len(self._retired) > OLD_CHECKPOINTS:
            self._free = np.sort(np.append(self._free, self._retired.popleft()))
        self._fresh[:] = False
        self._named.append(self._file_name)
        if len(self._named) > OLD_CHECKPOINTS:
            self._remove_old_files()
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
        """Restore a checkpoint and verify all of its rows.

        Raises:
            ValueError: the file is missing, corrupt, or has other rows.
        """
        self.discard()
        shapes = {name: tuple(shape) for name, shape in state["shapes"].items()}
        if shapes != self.layout.shapes or state["block"] != self._block:
            raise ValueError("its rows have another layout")
        self._count = state["count"]
        self._slots, self._checks = (state[name].cpu().numpy().copy() for name in ("slots", "checks"))
        self._retired = deque(slots.cpu().numpy().copy() for slots in state["retired"])
        self._named.extend(state.get("named", ()))  # missing in older checkpoints
        self._fresh = np.zeros(len(self._slots), bool)
        if not (0 <= self._count <= len(self._slots) * self._block and len(self._slots) == len(self._checks)):
            raise ValueError("its row table is corrupt")
        if state["file"]:
            if not self._is_row_file(state["file"]):
                raise ValueError("its row file has an invalid name")
            path = self._folder / state["file"]
            if path.is_symlink() or not path.is_file():
                raise ValueError(f"{path.name} is missing")
            self._open(path)
        self._verify()
        used = np.concatenate([self._slots[self._slots >= 0], *self._retired])
        self._free = np.setdiff1d(np.arange(self._size, dtype=np.int32), used)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def supersede(self, previous: RowFile) -> None:
        """Replace other rows in the same folder. Their file is deleted when no checkpoint uses it."""
        self._named.extend(previous._named)
        previous.discard()

    def discard(self) -> None:
        """Drop all rows, and delete the file if no checkpoint uses it."""
        if self._file is not None:
            path = Path(str(self._file.name))
            unused = self._file_name not in self._named
            self.close()
            if unused:
                path.unlink(missing_ok=True)
        self._broken = None
        self._clear()

    def _verify(self) -> None:
        if (self._slots >= self._size).any() or (self._slots < -1).any():
            raise ValueError("its row file is truncated")
        stored = np.flatnonzero(self._slots >= 0)
        stored = stored[np.argsort(self._slots[stored])]
        for first in range(0, len(stored), self._batch_blocks):
            batch = stored[first : first + self._batch_blocks]
            blocks = np.empty((len(batch), self._block, self.layout.width), np.float32)
            self._read_slots(self._slots[batch], np.arange(len(batch)), blocks)
            if (_checksums(blocks) != self._checks[batch]).any():
                raise ValueError("its row file is corrupt")

    def _remove_old_files(self) -> None:
        """Delete files that no checkpoint uses, also those of earlier processes of the run."""
        for path in self._folder.glob(f"{self._name}_*.bin"):
            if self._is_row_file(path.name) and path.name not in self._named:
                with suppress(OSError):
                    path.unlink()

    def _is_row_file(self, name: str) -> bool:
        return re.fullmatch(rf"{self._name}_[0-9a-f]{{8}}\.bin", name) is not None

    # -- blocks ----------------------------------------------------------------------------------------

    def _write_blocks(self, counts: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
        """Write ascending rows (M,) that lie in B blocks, with ``counts`` (B,) rows in each."""
        blocks = rows[np.cumsum(counts) - counts] // self._block
        previous = self._slots[blocks]
        fresh = self._fresh[blocks]
        sizes = np.minimum(self._count - blocks * self._block, self._block)
        slots = previous.copy()
        slots[~fresh] = self._new_slots(int((~fresh).sum()))
        position = np.empty_like(slots)  # of each block in the buffer, which is in the order of the file
        position[np.argsort(slots)] = np.arange(len(slots))
        buffer = np.zeros((len(slots), self._block, self.layout.width), np.float32)
        partial = np.flatnonzero((counts < sizes) & (previous >= 0))
        self._read_slots(previous[partial], position[partial], buffer)
        buffer[np.repeat(position, counts), rows % self._block] = values
        with self._convert_errors():
            file = self._file or self._open(self._folder / f"{self._name}_{uuid4().hex[:8]}.bin", new=True)
            in_order = np.sort(slots)
            for run in _runs(in_order):
                file.seek(int(in_order[run.start]) * self._block_bytes)
                _write(file, buffer[run])
        self._slots[blocks] = slots
        self._checks[blocks] = _checksums(buffer)[position]
        self._fresh[blocks] = True
        self._retiring.append(previous[~fresh & (previous >= 0)])

    def _new_slots(self, count: int) -> np.ndarray:
        """Return unused slots, ascending, extending the file if necessary."""
        reused, self._free = self._free[:count], self._free[count:]
        added = np.arange(self._size, self._size + count - len(reused), dtype=np.int32)
        self._size += len(added)
        return np.append(reused, added)

    def _read_slots(self, slots: np.ndarray, to: np.ndarray, output: np.ndarray) -> None:
        """Read the blocks in slots (B,) to blocks ``to`` (B,) of the output (., block, width)."""
        offsets = np.arange(self._block)
        positions, to = (
            (blocks[:, None].astype(np.int64) * self._block + offsets).ravel() for blocks in (slots, to)
        )
        self._read_positions(positions, to, output.reshape(-1, self.layout.width))

    def _read_positions(self, positions: np.ndarray, to: np.ndarray, output: np.ndarray) -> None:
        """Read the rows at positions (M,) of the file to rows ``to`` (M,) of the output.

        Adjacent and nearly adjacent blocks are read with one call. Contiguous rows are read directly to the
        output, others by way of a staging buffer.
        """
        if (np.diff(positions) < 0).any():
            order = np.argsort(positions)
            positions, to = positions[order], to[order]
        limit = self._batch_blocks * self._block
        runs = _runs(positions // self._block, positions // limit, 1 + MAX_GAP)
        gaps = np.append(0, np.cumsum((np.diff(positions) != 1) | (np.diff(to) != 1)))[: len(positions)]
        staged = np.empty((0, self.layout.width), np.float32)
        at = np.empty_like(positions)  # rows of ``staged``
        used = begin = end = 0  # used rows of ``staged``, and the range of positions in it
        with self._convert_errors():
            for run in runs:
                first, last = int(positions[run.start]), int(positions[run.stop - 1])
                contiguous = gaps[run.start] == gaps[run.stop - 1] and last - first >= self._block
                count = 0 if contiguous else last - first + 1
                if begin < end and (contiguous or used + count > limit):
                    output[to[begin:end]] = staged[at[begin:end]]
                    used = begin = end = 0
                assert self._file is not None, "blocks with a slot are in a file"
                self._file.seek(first * 4 * self.layout.width)
                if contiguous:
                    _read(self._file, output[to[run.start] : to[run.stop - 1] + 1])
                    continue
                if not len(staged):
                    staged = np.empty((limit, self.layout.width), np.float32)
                _read(self._file, staged[used : used + count])
                np.add(positions[run], used - first, out=at[run])
                begin = begin if used else run.start
                end = run.stop
                used += count
            output[to[begin:end]] = staged[at[begin:end]]

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

    def _require_intact(self) -> None:
        """Raise the error of an earlier failed write or read."""
        if self._broken is not None:
            raise self._broken

    @contextmanager
    def _convert_errors(self) -> Iterator[None]:
        """Convert OSError to LodgsError, and keep it for later calls."""
        try:
            yield
        except OSError as error:
            place = self._folder if self._file is None else self._file.name
            self._broken = LodgsError(
                f"Cannot read or write {place}: {error.strerror or error}.",
                "Free some space or choose another folder, then resume the run.",
            )
            raise self._broken from error


def _check_rows(rows: np.ndarray, count: int) -> np.ndarray:
    rows = np.asarray(rows, np.int64)
    if len(rows) and (rows.min() < 0 or rows.max() >= count):
        raise IndexError(f"rows {rows.min()} to {rows.max()} are out of range for {count} rows")
    return rows


def _concatenate(arrays: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(arrays) if arrays else np.zeros(0, np.int32)


def _runs(numbers: np.ndarray, cells: np.ndarray | None = None, max_step: int = 1) -> list[slice]:
    """Split ascending numbers (M,) into runs with steps of at most ``max_step`` in one cell each."""
    if not len(numbers):
        return []
    breaks = np.diff(numbers) > max_step
    if cells is not None:
        breaks |= np.diff(cells) > 0
    borders = [0, *(np.flatnonzero(breaks) + 1).tolist(), len(numbers)]
    return [slice(*ends) for ends in pairwise(borders)]


def _run_starts(numbers: np.ndarray) -> np.ndarray:
    """Return the index of the first occurrence of each of ascending numbers (M,)."""
    return np.flatnonzero(np.append(True, np.diff(numbers) > 0)[: len(numbers)])


def _checksums(blocks: np.ndarray) -> np.ndarray:
    """Return the CRC-32 of each block."""
    return np.array([zlib.crc32(block) for block in blocks], np.uint32).view(np.int32)


def _read(file: FileIO, array: np.ndarray) -> None:
    remaining = array.data.cast("B")
    while remaining:
        count = file.readinto(remaining)
        if not count:
            raise OSError("it is truncated")
        remaining = remaining[count:]


def _write(file: FileIO, array: np.ndarray) -> None:
    remaining = np.ascontiguousarray(array).data.cast("B")
    while remaining:
        remaining = remaining[file.write(remaining) :]
