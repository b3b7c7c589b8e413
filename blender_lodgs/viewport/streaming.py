"""Streaming of splats larger than memory, in background threads.

One thread reads the pages that the camera needs (``training.lod.query.Pager``). The worker thread of
``arrangement`` copies them, so that the drawing thread only uploads drawn splats. This module does not use
bpy.
"""

from __future__ import annotations

import threading
import time

import numpy as np

from ...training.errors import LodgsError
from ...training.lod.blocks import SIZE
from ...training.lod.on_disk import open_paged
from ...training.lod.query import LodQuery, Pager
from ...training.lod.rule import resolve_rule
from ...training.splats.gaussians import Splats
from ..data.streams import Source
from .records import empty_records, records_of

Direction = tuple[float, float, float]

PAUSE = 0.02
"""Seconds between two checks for new pages while the stream is not ready."""


class Stream:
    """The part of a file that the camera needs, as records (``records``).

    Attributes:
        source: the file.
        ready: at least as many splats are in memory as the scene has; until then the scene's are drawn.
        problem: error that ended streaming; empty if there is none.
        records: (rows, 4 * texels) float32 of all slots in memory.
        columns: (rows,) float32 by name, of the rule. Empty slots are never selected.
        higher: number of SH coefficients beyond the first.
        copied_updates: number of copied updates.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.ready = False
        self.problem = ""
        self.records = np.zeros((0, 0), np.float32)
        self.columns: dict[str, np.ndarray] = {}
        self.higher = 0
        self.copied_updates = 0
        self._pager: Pager | None = None
        self._request: tuple[LodQuery, Direction | None] | None = None
        self._stopping = False
        threading.Thread(target=self._open, name="lodgs-stream", daemon=True).start()

    @property
    def arrived(self) -> int:
        """Number of available updates so far."""
        return 0 if self._pager is None else self._pager.arrived

    @property
    def splats(self) -> int:
        """Number of splats in memory."""
        return 0 if self._pager is None else self._pager.splats

    @property
    def short(self) -> bool:
        """True if the camera needs more splats than the budget allows."""
        return self._pager is not None and self._pager.short

    @property
    def busy(self) -> bool:
        """True while pages are being read or wait to be copied."""
        if self.problem:
            return self.arrived != self.copied_updates
        return self._pager is None or not self.ready or not self._pager.idle

    def request(self, query: LodQuery, direction: Direction | None) -> None:
        """Request the pages of a query. Returns at once.

        Args:
            direction: view direction in the splats' space; None means all directions.
        """
        if (query, direction) != self._request:
            self._request = query, direction
            self._forward_request()

    def take(self) -> np.ndarray:
        """Copy an update. Nobody may read the arrays meanwhile.

        Returns:
            Slots (M,) int32 with other splats than before.
        """
        update = None if self._pager is None else self._pager.take()
        if update is None:
            return np.zeros(0, np.int32)
        starts = np.array([begin for begin, _ in update.pages])
        counts = np.array([len(splats) for _, splats in update.pages])
        splats = Splats.concatenated([splats for _, splats in update.pages])
        rows = np.repeat(starts - (np.cumsum(counts) - counts), counts) + np.arange(len(splats))
        self.records[rows] = records_of(splats)
        for name in self.columns.keys() - update.columns.keys():
            self.columns[name][rows] = splats.extras[name]
        self.columns |= update.columns
        self.copied_updates += 1
        return (starts[:, None] + np.arange(SIZE)).reshape(-1).astype(np.int32)

    def stop(self) -> None:
        """Stop the threads."""
        self._stopping = True
        if self._pager is not None:
            self._pager.stop()

    def _forward_request(self) -> None:
        if self._pager is not None and self._request is not None:
            self._pager.ask(*self._request)

    def _open(self) -> None:
        """Open the file and wait in a separate thread until the stream is ready."""
        try:
            file = open_paged(self.source.path)
            pager = file.pager(self.source.budget)
            if file.total != self.source.total:
                raise LodgsError(
                    f"Cannot stream {self.source.path.name}: it has {file.total:,} splats instead of "
                    f"{self.source.total:,} as the imported file.",
                    "Import the file again.",
                )
            self.higher = (pager.sh_degree + 1) ** 2 - 1
            self.records = empty_records(pager.rows, self.higher)
            names = resolve_rule(file.bundle.rule).columns
            self.columns = {name: np.zeros(pager.rows, np.float32) for name in names}
            self._pager = pager
            self._forward_request()
            pager.start()
            while not self._stopping and not pager.problem and not self._is_ready(pager):
                self.take()
                time.sleep(PAUSE)
            self.problem = pager.problem
            self.ready = not self.problem
        except Exception as error:  # the splats of the scene stay visible
            self.problem = str(error) or type(error).__name__

    def _is_ready(self, pager: Pager) -> bool:
        return (
            self._request is not None
            and self.copied_updates > 0
            and (pager.idle or pager.splats >= self.source.scene_splats)
        )
