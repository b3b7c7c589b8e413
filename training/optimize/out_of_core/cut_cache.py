"""Cuts of point trees in fast memory: what a view needs of rows that lie elsewhere, kept while it is near."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from ...errors import LodgsError
from ..memory import keep_freed_memory
from ..schedules import due
from .row_file import STAGING_BYTES, RowFile

REUSE = 0.77, 2.0
"""A cut is used again where the distance over that of its making is in here ("A LoD of Gaussians", Eq. 7)."""
FLUSH_INTERVAL = 1000
"""Steps after which everything goes back, so that no cut stays for good."""
KEEP_SHARE = 0.8
"""Share of the room that is taken after the least recently used has gone."""
SLOT_BYTES = 17
"""Bytes that are kept of each row here beside its numbers: which row, its group, whether changed, places."""
INDEX_BYTES = 4
"""Bytes that are kept of each row there is: where it is here."""

BATCH_ROWS = 1 << 15
"""Rows that are read or written together."""

MMAP_BYTES = 1 << 20
"""Bytes from which on an array's memory is the system's again when it is freed, where not all rows have room:
what is made of cuts has another size each step, and a heap would keep half as much again in pieces that fit
nothing. It costs some 10 % of a step's time."""

FREE = -1
"""The group of a place without a row."""


class CutTooLarge(LodgsError):
    """What a view needs at once is more than the budget has room for.

    Attributes:
        needed, room: rows.
        budget: bytes that would do.
    """

    def __init__(self, needed: int, room: int, budget: int) -> None:
        super().__init__(
            f"A view needs {needed:,} splats at once; the memory budget has room for {room:,}.",
            f"Give at least {-(-budget // 10**6):,} MB as splat_memory, or ask for coarser detail.",
        )
        self.needed, self.room, self.budget = needed, room, budget


Cut = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Told which (K,) of the groups asked for have to be cut, says the rows of each, one group's after the
other's, (M,) int64, and how many each has, (K,)."""


class CutCache:
    """Rows in fast memory, in groups that come and go together: a group's is a cut of one point tree.

    Rows that leave a cut stay here, and their changes with them, as long as there is room: what has been in
    no cut for longest goes first, and where cuts themselves have no room, those least recently used. Memory
    is the budget, in which are the tables of all rows there are. A group's rows are no other group's.

    What a step sees depends on which cuts are here, so ``state_dict`` tells that, too; it does not depend on
    which other rows are.

    Args:
        rows: where rows are otherwise; only this object may change them.
        groups: how many groups there are.
        budget: bytes.
        device: where records live.
        reuse: smallest and largest distance, over that of its making, for which a cut is used again.
        flush_interval: steps, see :meth:`after`.
        reduced: see REDUCED.

    Attributes:
        capacity: rows for which there is room.
        records: (capacity, width) on the device; who changes some in place says so by :meth:`changed`.
        loaded: rows that have been brought in so far.
        reused: rows that were there when they were asked for.
    """

    def __init__(
        self,
        rows: RowFile,
        groups: int,
        budget: int,
        device: torch.device | str = "cpu",
        reuse: tuple[float, float] = REUSE,
        flush_interval: int = FLUSH_INTERVAL,
        reduced: float = KEEP_SHARE,
    ) -> None:
        self.rows, self.layout, self._device = rows, rows.layout, torch.device(device)
        self._least, self._most = reuse
        self._flush_interval, self._reduced = flush_interval, reduced
        self._record, self.budget = 4 * self.layout.width, budget
        # on a device what is between it and the file has memory of its own
        self._at_once = BATCH_ROWS if self._device.type == "cpu" else max(STAGING_BYTES // self._record, 1)
        self.records = torch.zeros(0, self.layout.width, device=self._device)
        self.loaded = self.reused = 0
        self._forget(groups)

    def _forget(self, groups: int) -> None:
        most = max(self.budget - self.tables, 0) // (self._record + SLOT_BYTES)
        self.capacity = min(most, len(self.rows))
        if self.capacity < len(self.rows):
            keep_freed_memory(MMAP_BYTES)
        if len(self.records) != self.capacity:
            self.records = self.records[:0].clone()
            self.records = torch.zeros(self.capacity, self.layout.width, device=self._device)
        self._place = np.full(len(self.rows), -1, np.int32)  # of each row, where its record is; -1: not here
        self._row = np.zeros(self.capacity, np.int32)  # of each record, which row it is
        self._group = np.full(self.capacity, FREE, np.int32)  # or FREE - 1 - the clock when it left one
        self._dirty = np.zeros(self.capacity, bool)
        self._free = np.arange(self.capacity, dtype=np.int32)[::-1].copy()  # a stack of places
        self._room = self.capacity  # of these so many are left
        self._places: dict[int, np.ndarray] = {}  # of each group whose cut is here, int32
        self._held = 0  # rows of all these
        self._distance = np.full(groups, np.nan)
        self._used = np.full(groups, -1)
        self._clock = 0

    def __len__(self) -> int:
        """Rows that are here."""
        return self.capacity - self._room

    @property
    def tables(self) -> int:
        """Bytes of what is kept of all rows there are."""
        return INDEX_BYTES * len(self.rows) + self.rows.tables

    # -- a step ----------------------------------------------------------------------------------------

    def reusable(self, groups: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Which of some groups (G,) have a cut here that serves for these distances (G,)."""
        made = self._distance[groups]
        with np.errstate(invalid="ignore"):
            return (distances >= self._least * made) & (distances <= self._most * made)

    def acquire(self, groups: np.ndarray, distances: np.ndarray, cut: Cut) -> np.ndarray:
        """Where the records of groups are, brought in where no cut of theirs serves.

        Args:
            groups: (G,) int64, each once.
            distances: (G,) from the eye to the root of each.
            cut: asked for the rows of those that are not here, or for another distance.

        Returns:
            (M,) int64 places, for :meth:`get` and :meth:`put`: group after group, each in its cut's order.

        Raises:
            NoRoom: there is none for them all; nothing has changed.
            ValueError: a row is in two groups, or in one twice.
        """
        groups, distances = np.asarray(groups, np.int64), np.asarray(distances, np.float64)
        for known in (self.reusable(groups, distances), np.zeros(len(groups), bool)):
            anew = np.flatnonzero(~known)
            rows, counts = cut(anew) if len(anew) else (np.zeros(0, np.int64), np.zeros(0, np.int64))
            there = sum(len(self._places[group]) for group in groups[known].tolist())
            if there + len(rows) <= self.capacity or not known.any():
                break  # otherwise cuts that are finer than they need be have no room
        if there + len(rows) > self.capacity:
            needed = there + len(rows)
            budget = needed * (self._record + SLOT_BYTES) + self.tables
            raise CutTooLarge(needed, self.capacity, budget)
        self._clock += 1
        self._used[groups] = self._clock
        self.reused += there
        if len(anew):
            self._bring(groups[anew], np.asarray(rows, np.int64), np.asarray(counts, np.int64))
        self._distance[groups[anew]] = distances[anew]
        places = [self._places[group] for group in groups.tolist()]
        return np.concatenate(places, dtype=np.int64) if places else np.zeros(0, np.int64)

    def rows_at(self, places: np.ndarray) -> np.ndarray:
        """Which rows (M,) are at places (M,)."""
        return self._row[places]

    def groups_at(self, places: np.ndarray) -> np.ndarray:
        """Which groups (M,) these are of."""
        return self._group[places]

    def get(self, places: np.ndarray) -> torch.Tensor:
        """A copy of the records (M, width) at places (M,), on the device."""
        return self.records.index_select(0, torch.from_numpy(places).to(self._device))

    def put(self, places: np.ndarray, records: torch.Tensor) -> None:
        """Puts records (M, width) at places (M,), each named once."""
        self.records.index_copy_(0, torch.from_numpy(places).to(self._device), records)
        self.mark_changed(places)

    def mark_changed(self, places: np.ndarray) -> None:
        """The records at places (M,) are to be written back."""
        self._dirty[places] = True

    def end_step(self, step: int) -> None:
        """To be called after every step: cuts are forgotten where that is due."""
        if due(self._flush_interval, step + 1):
            self.release_cuts()

    # -- coming and going ------------------------------------------------------------------------------

    def write_back(self) -> None:
        """What has changed is written; all stays here."""
        self._write(np.flatnonzero(self._dirty))

    def release_cuts(self) -> None:
        """No cut serves any more; rows stay here."""
        self._leave(list(self._places.values()))
        self._places = {}
        self._distance[:] = np.nan

    def evict_all(self) -> None:
        """Writes back, and keeps nothing."""
        self.release_cuts()
        self._drop(np.flatnonzero(self._group != FREE))

    def _bring(self, groups: np.ndarray, rows: np.ndarray, counts: np.ndarray) -> None:
        """Makes some groups consist of these rows; what they have in common with before stays."""
        owners, places = np.repeat(groups, counts), self._place[rows]
        here = places >= 0
        coming, stays = rows[~here], places[here]
        self._place[coming] = np.arange(len(coming), dtype=np.int32)
        twice = not np.array_equal(self._place[coming], np.arange(len(coming)))
        self._place[coming] = -1
        others = self._group[stays]
        if twice or ((others >= 0) & (others != owners[here])).any() or len(np.unique(stays)) < len(stays):
            raise ValueError("a row is in two groups, or in one twice")
        self._leave([self._places.pop(group) for group in groups.tolist() if group in self._places])
        self._group[stays] = owners[here]
        over = self._held + len(rows) - self.capacity
        if over > 0:
            self._leave(self._least_used(over))
        short = len(coming) - self._room
        if short > 0:
            self._drop(self._longest_left(short))
        self._held += len(rows)
        self._room -= len(coming)
        room = self._free[self._room : self._room + len(coming)].astype(np.int64)
        for first in range(0, len(coming), self._at_once):
            some = slice(first, first + self._at_once)
            if self._device.type == "cpu":
                self.rows.read(coming[some], self.records, room[some])
                continue
            records = self.rows.read(coming[some]).pin_memory().to(self._device, non_blocking=True)
            self.records.index_copy_(0, torch.from_numpy(room[some]).to(self._device), records)
        self._place[coming], self._row[room] = room, coming
        places[~here] = room
        self._group[places] = owners
        ends = np.cumsum(counts)
        parts = (part.copy() for part in np.split(places, ends[:-1]))  # each leaves by itself
        self._places |= zip(groups.tolist(), parts, strict=True)
        self.loaded += len(coming)
        self.reused += len(stays)

    def _least_used(self, short: int) -> list[np.ndarray]:
        """The cuts of groups that go, so that so many rows fit, and some more; none that are in use now."""
        others = np.array([g for g in self._places if self._used[g] < self._clock], np.int64)
        others = others[np.lexsort((others, self._used[others]))]
        sizes = np.cumsum([len(self._places[group]) for group in others.tolist()])
        enough = short + int((1 - self._reduced) * self.capacity)
        many = min(int(np.searchsorted(sizes, enough)) + 1, len(others))
        self._distance[others[:many]] = np.nan
        return [self._places.pop(group) for group in others[:many].tolist()]

    def _leave(self, cuts: list[np.ndarray]) -> None:
        """The rows at these places are in no cut from now on."""
        for places in cuts:
            self._group[places] = FREE - 1 - self._clock
            self._held -= len(places)

    def _longest_left(self, short: int) -> np.ndarray:
        """The places of rows in no cut that go, so that so many are free, and some more."""
        left = self._group[self._group < FREE]
        enough = min(max(short, int((1 - self._reduced) * self.capacity)), len(left))
        if not enough:
            return np.zeros(0, np.int64)
        left.partition(len(left) - enough)  # sorting all would take five times the memory
        border = left[len(left) - enough]
        del left
        before = np.flatnonzero((self._group > border) & (self._group < FREE))
        return np.append(before, np.flatnonzero(self._group == border)[: enough - len(before)])

    def _drop(self, places: np.ndarray) -> None:
        self._write(places[self._dirty[places]])
        self._place[self._row[places]] = -1
        self._group[places] = FREE
        self._free[self._room : self._room + len(places)] = places
        self._room += len(places)

    def _write(self, places: np.ndarray) -> None:
        """Writes back the records at places, in the order of their rows."""
        places = places[np.argsort(self._row[places])]
        for first in range(0, len(places), self._at_once):
            some = places[first : first + self._at_once]
            here = (self.records, some) if self._device.type == "cpu" else (self.get(some).cpu(), None)
            self.rows.write(self._row[some], *here)
            self._dirty[some] = False

    # -- what lasts ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """A checkpoint of the rows, see ``RowFile.state_dict``, and which of them are here."""
        self.write_back()
        groups = sorted(self._places)
        places = [self._places[group] for group in groups]
        return {
            "rows": self.rows.state_dict(),
            "groups": torch.tensor(groups, dtype=torch.int64),
            "counts": torch.tensor([len(each) for each in places], dtype=torch.int64),
            "here": torch.from_numpy(self._row[np.concatenate(places)] if places else self._row[:0].copy()),
            "distance": torch.from_numpy(self._distance.copy()),
            "used": torch.from_numpy(self._used.copy()),
            "clock": self._clock,
            "budget": self.budget,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from what ``state_dict`` gave, with a budget that may be another one.

        Raises:
            ValueError: the rows cannot be read.
        """
        self.rows.load_state_dict(state["rows"])
        groups, counts, here, distance, used = (
            state[name].cpu().numpy().copy() for name in ("groups", "counts", "here", "distance", "used")
        )
        self._forget(len(used))
        if len(here) > self.capacity:
            return
        if len(groups):
            self._bring(groups, here, counts)
        self._distance, self._used, self._clock = distance, used, state["clock"]
