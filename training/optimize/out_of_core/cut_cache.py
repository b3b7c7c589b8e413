"""Cuts of point trees in memory: rows on disk that a view needs, cached while the camera is near."""

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
"""Range of the current distance over a cut's original distance for reuse ("A LoD of Gaussians", Eq. 7)."""
FLUSH_INTERVAL = 1000
"""Steps after which all cuts are released, so that none stays forever."""
KEEP_SHARE = 0.8
"""Share of the capacity in use after an eviction."""
SLOT_BYTES = 17
"""Bytes per cached row besides its record: row, group, changed flag and slots."""
INDEX_BYTES = 4
"""Bytes per row on disk: its slot."""

BATCH_ROWS = 1 << 15
"""Rows to read or write together."""

MMAP_BYTES = 1 << 20
"""Arrays from this size on are returned to the system if the cache holds only a part of the rows. Arrays that
depend on cuts change size in every step, and fragments of the heap would take half as much memory again. It
takes about 10 % of a step."""

FREE = -1
"""Group of a free slot."""


class CutTooLarge(LodgsError):
    """A view needs more rows than the memory budget holds.

    Attributes:
        needed: rows of the view.
        room: rows of the budget.
        budget: sufficient budget in bytes.
    """

    def __init__(self, needed: int, room: int, budget: int) -> None:
        super().__init__(
            f"Cannot render the view: it needs {needed:,} splats, the memory budget holds {room:,}.",
            f"Set splat_memory to at least {-(-budget // 10**6):,} MB, or use coarser detail.",
        )
        self.needed = needed
        self.room = room
        self.budget = budget


Cut = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Compute the cuts of groups. Gets indices (K,) into the requested groups, and returns the rows (M,) int64,
group after group, and the number of rows of each (K,)."""


class CutCache:
    """Cached rows in groups that are loaded together: the rows of a group are a cut of one point tree.

    Rows that leave a cut stay cached with their changes as long as there is room. Rows that left their cut
    first are evicted first. If cuts themselves do not fit, the least recently used ones are released. The
    budget includes the tables of all rows. Groups have no rows in common.

    Steps depend on the cached cuts, so ``state_dict`` includes them. They do not depend on other cached rows.

    Args:
        rows: rows on disk; only this object may change them.
        groups: number of groups.
        budget: bytes.
        device: device of the records.
        reuse: minimum and maximum distance, over a cut's original distance, for reuse.
        flush_interval: steps, see :meth:`end_step`.
        keep_share: see KEEP_SHARE.

    Attributes:
        capacity: maximum number of cached rows.
        records: (capacity, width) on the device; call :meth:`mark_changed` after changes in place.
        loaded: number of rows loaded so far.
        reused: number of requested rows that were cached.
    """

    def __init__(
        self,
        rows: RowFile,
        groups: int,
        budget: int,
        device: torch.device | str = "cpu",
        reuse: tuple[float, float] = REUSE,
        flush_interval: int = FLUSH_INTERVAL,
        keep_share: float = KEEP_SHARE,
    ) -> None:
        self.rows = rows
        self.layout = rows.layout
        self.budget = budget
        self._device = torch.device(device)
        self._min_ratio, self._max_ratio = reuse
        self._flush_interval = flush_interval
        self._keep_share = keep_share
        self._record_bytes = 4 * self.layout.width
        # Transfers to a device need staging memory in addition.
        self._on_host = self._device.type == "cpu"
        self._batch_rows = BATCH_ROWS if self._on_host else max(STAGING_BYTES // self._record_bytes, 1)
        self.records = torch.zeros(0, self.layout.width, device=self._device)
        self.loaded = self.reused = 0
        self._reset(groups)

    def _reset(self, groups: int) -> None:
        limit = max(self.budget - self.table_bytes, 0) // (self._record_bytes + SLOT_BYTES)
        self.capacity = min(limit, len(self.rows))
        if self.capacity < len(self.rows):
            keep_freed_memory(MMAP_BYTES)
        if len(self.records) != self.capacity:
            self.records = self.records[:0].clone()
            self.records = torch.zeros(self.capacity, self.layout.width, device=self._device)
        self._slot = np.full(len(self.rows), -1, np.int32)  # slot of each row, -1 if it is not cached
        self._row = np.zeros(self.capacity, np.int32)  # row of each slot
        self._group = np.full(self.capacity, FREE, np.int32)  # of each slot; FREE - 1 - clock after its cut
        self._dirty = np.zeros(self.capacity, bool)
        self._free = np.arange(self.capacity, dtype=np.int32)[::-1].copy()  # stack of free slots
        self._room = self.capacity  # number of free slots
        self._cuts: dict[int, np.ndarray] = {}  # int32 slots of each group whose cut is cached
        self._cut_rows = 0  # total number of rows of these cuts
        self._distance = np.full(groups, np.nan)
        self._used = np.full(groups, -1)
        self._clock = 0

    def __len__(self) -> int:
        """Return the number of cached rows."""
        return self.capacity - self._room

    @property
    def table_bytes(self) -> int:
        """Bytes of the tables of all rows."""
        return INDEX_BYTES * len(self.rows) + self.rows.table_bytes

    # -- a step ----------------------------------------------------------------------------------------

    def reusable(self, groups: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Find groups (G,) whose cached cut is valid at these distances (G,), as (G,) bool."""
        original = self._distance[groups]
        with np.errstate(invalid="ignore"):
            return (distances >= self._min_ratio * original) & (distances <= self._max_ratio * original)

    def acquire(self, groups: np.ndarray, distances: np.ndarray, cut: Cut) -> np.ndarray:
        """Return the slots of the cuts of groups, and load cuts that are not cached or not valid.

        Args:
            groups: (G,) int64, distinct.
            distances: (G,) from the camera to the root of each.
            cut: compute cuts that have to be loaded.

        Returns:
            (M,) int64 slots for :meth:`get` and :meth:`put`: group after group, each in its cut's order.

        Raises:
            CutTooLarge: the cuts exceed the capacity; nothing has changed.
            ValueError: duplicate row, in a group or in two.
        """
        groups = np.asarray(groups, np.int64)
        distances = np.asarray(distances, np.float64)
        for valid in (self.reusable(groups, distances), np.zeros(len(groups), bool)):
            missing = np.flatnonzero(~valid)
            rows, counts = cut(missing) if len(missing) else (np.zeros(0, np.int64), np.zeros(0, np.int64))
            cached = sum(len(self._cuts[group]) for group in groups[valid].tolist())
            if cached + len(rows) <= self.capacity or not valid.any():
                break  # otherwise compute all cuts again, as cached ones may be finer than necessary
        if cached + len(rows) > self.capacity:
            needed = cached + len(rows)
            budget = needed * (self._record_bytes + SLOT_BYTES) + self.table_bytes
            raise CutTooLarge(needed, self.capacity, budget)
        self._clock += 1
        self._used[groups] = self._clock
        self.reused += cached
        if len(missing):
            self._load(groups[missing], np.asarray(rows, np.int64), np.asarray(counts, np.int64))
        self._distance[groups[missing]] = distances[missing]
        slots = [self._cuts[group] for group in groups.tolist()]
        return np.concatenate(slots, dtype=np.int64) if slots else np.zeros(0, np.int64)

    def rows_at(self, slots: np.ndarray) -> np.ndarray:
        """Return the rows (M,) in slots (M,)."""
        return self._row[slots]

    def groups_at(self, slots: np.ndarray) -> np.ndarray:
        """Return the groups (M,) of slots (M,)."""
        return self._group[slots]

    def get(self, slots: np.ndarray) -> torch.Tensor:
        """Copy the records (M, width) in slots (M,), on the device."""
        return self.records.index_select(0, torch.from_numpy(slots).to(self._device))

    def put(self, slots: np.ndarray, records: torch.Tensor) -> None:
        """Store records (M, width) in distinct slots (M,)."""
        self.records.index_copy_(0, torch.from_numpy(slots).to(self._device), records)
        self.mark_changed(slots)

    def mark_changed(self, slots: np.ndarray) -> None:
        """Mark the records in slots (M,) to be written to disk."""
        self._dirty[slots] = True

    def end_step(self, step: int) -> None:
        """Release all cuts if due. Call after every step."""
        if due(self._flush_interval, step + 1):
            self.release_cuts()

    # -- loading and eviction --------------------------------------------------------------------------

    def write_back(self) -> None:
        """Write changed records to disk. All rows stay cached."""
        self._write(np.flatnonzero(self._dirty))

    def release_cuts(self) -> None:
        """Invalidate all cuts. Their rows stay cached."""
        self._leave(list(self._cuts.values()))
        self._cuts = {}
        self._distance[:] = np.nan

    def evict_all(self) -> None:
        """Write changed records to disk and empty the cache."""
        self.release_cuts()
        self._evict(np.flatnonzero(self._group != FREE))

    def _load(self, groups: np.ndarray, rows: np.ndarray, counts: np.ndarray) -> None:
        """Set the rows of groups. Rows that are cached stay in their slots."""
        owners = np.repeat(groups, counts)
        slots = self._slot[rows]
        cached = slots >= 0
        new_rows = rows[~cached]
        cached_slots = slots[cached]
        self._slot[new_rows] = np.arange(len(new_rows), dtype=np.int32)
        duplicate = not np.array_equal(self._slot[new_rows], np.arange(len(new_rows)))
        self._slot[new_rows] = -1
        previous = self._group[cached_slots]
        conflict = ((previous >= 0) & (previous != owners[cached])).any()
        if duplicate or conflict or len(np.unique(cached_slots)) < len(cached_slots):
            raise ValueError("duplicate row, in a group or in two")
        self._leave([self._cuts.pop(group) for group in groups.tolist() if group in self._cuts])
        self._group[cached_slots] = owners[cached]
        excess = self._cut_rows + len(rows) - self.capacity
        if excess > 0:
            self._leave(self._pop_least_used(excess))
        shortage = len(new_rows) - self._room
        if shortage > 0:
            self._evict(self._oldest_slots(shortage))
        self._cut_rows += len(rows)
        self._room -= len(new_rows)
        new_slots = self._free[self._room : self._room + len(new_rows)].astype(np.int64)
        for first in range(0, len(new_rows), self._batch_rows):
            batch = slice(first, first + self._batch_rows)
            if self._on_host:
                self.rows.read(new_rows[batch], self.records, new_slots[batch])
                continue
            records = self.rows.read(new_rows[batch]).pin_memory().to(self._device, non_blocking=True)
            self.records.index_copy_(0, torch.from_numpy(new_slots[batch]).to(self._device), records)
        self._slot[new_rows] = new_slots
        self._row[new_slots] = new_rows
        slots[~cached] = new_slots
        self._group[slots] = owners
        ends = np.cumsum(counts)
        cuts = (part.copy() for part in np.split(slots, ends[:-1]))  # copies, which are freed separately
        self._cuts |= zip(groups.tolist(), cuts, strict=True)
        self.loaded += len(new_rows)
        self.reused += len(cached_slots)

    def _pop_least_used(self, excess: int) -> list[np.ndarray]:
        """Remove cuts with at least ``excess`` rows, least recently used first, but none of this step."""
        unused = np.array([group for group in self._cuts if self._used[group] < self._clock], np.int64)
        unused = unused[np.lexsort((unused, self._used[unused]))]
        sizes = np.cumsum([len(self._cuts[group]) for group in unused.tolist()])
        target = excess + int((1 - self._keep_share) * self.capacity)
        count = min(int(np.searchsorted(sizes, target)) + 1, len(unused))
        self._distance[unused[:count]] = np.nan
        return [self._cuts.pop(group) for group in unused[:count].tolist()]

    def _leave(self, cuts: list[np.ndarray]) -> None:
        """Mark the rows in the slots of cuts as being in no cut."""
        for slots in cuts:
            self._group[slots] = FREE - 1 - self._clock
            self._cut_rows -= len(slots)

    def _oldest_slots(self, shortage: int) -> np.ndarray:
        """Return at least ``shortage`` slots of rows in no cut, those that left their cut first."""
        ages = self._group[self._group < FREE]
        count = min(max(shortage, int((1 - self._keep_share) * self.capacity)), len(ages))
        if not count:
            return np.zeros(0, np.int64)
        ages.partition(len(ages) - count)  # a full sort would take five times the memory
        border = ages[len(ages) - count]
        del ages
        older = np.flatnonzero((self._group > border) & (self._group < FREE))
        return np.append(older, np.flatnonzero(self._group == border)[: count - len(older)])

    def _evict(self, slots: np.ndarray) -> None:
        self._write(slots[self._dirty[slots]])
        self._slot[self._row[slots]] = -1
        self._group[slots] = FREE
        self._free[self._room : self._room + len(slots)] = slots
        self._room += len(slots)

    def _write(self, slots: np.ndarray) -> None:
        """Write the records in slots to disk, in the order of their rows."""
        slots = slots[np.argsort(self._row[slots])]
        for first in range(0, len(slots), self._batch_rows):
            batch = slots[first : first + self._batch_rows]
            source = (self.records, batch) if self._on_host else (self.get(batch).cpu(), None)
            self.rows.write(self._row[batch], *source)
            self._dirty[batch] = False

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return a checkpoint of the rows (see ``RowFile.state_dict``) and of the cached cuts."""
        self.write_back()
        groups = sorted(self._cuts)
        slots = [self._cuts[group] for group in groups]
        return {
            "rows": self.rows.state_dict(),
            "groups": torch.tensor(groups, dtype=torch.int64),
            "counts": torch.tensor([len(cut) for cut in slots], dtype=torch.int64),
            "here": torch.from_numpy(self._row[np.concatenate(slots)] if slots else self._row[:0].copy()),
            "distance": torch.from_numpy(self._distance.copy()),
            "used": torch.from_numpy(self._used.copy()),
            "clock": self._clock,
            "budget": self.budget,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a checkpoint. The budget may differ.

        Raises:
            ValueError: the rows cannot be read.
        """
        self.rows.load_state_dict(state["rows"])
        groups, counts, rows, distance, used = (
            state[name].cpu().numpy().copy() for name in ("groups", "counts", "here", "distance", "used")
        )
        self._reset(len(used))
        if len(rows) > self.capacity:
            return
        if len(groups):
            self._load(groups, rows, counts)
        self._distance = distance
        self._used = used
        self._clock = state["clock"]
