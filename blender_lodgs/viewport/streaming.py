"""Trees of splats larger than memory: what an eye needs of a file is read beside Blender's own thread.

A thread reads pages of the file (``training.lod.tree.paging``), that of ``arranging`` takes them over, so that the
thread that draws has nothing of it but the upload of splats that it is to draw. Nothing of Blender in here.
"""

from __future__ import annotations

import threading
import time

import numpy as np

from ...training.errors import LodgsError
from ...training.lod.query import LodQuery
from ...training.lod.rules.cut import NODE_SIZE, PARENT, PARENT_SIZE, detail_of
from ...training.lod.tree.paging import SIZE, Pager
from ...training.splats.gaussians import Splats
from ..data.streams import Source

Direction = tuple[float, float, float]

PAUSE = 0.02
"""Seconds between two looks at what has come, until there is as much as the scene itself holds."""


class Stream:
    """Of a tree in a file what an eye needs, as ``resident`` brings it to the graphics card.

    Attributes:
        source: see there.
        ready: whether there is as much of it as the scene itself holds, which is drawn until then.
        problem: why nothing comes any more; empty where it does.
        records: (rows, 4 * texels) float32 of each place in memory, see ``resident.read_records``.
        columns: (rows,) float32 by name, of the rule ``cut``; no eye is shown a place whose parent size is 0.
        higher: how many coefficients beyond the first splats have.
        taken: how many updates have been taken over.
    """

    def __init__(self, source: Source) -> None:
        self.source, self.ready, self.problem = source, False, ""
        self.records, self.columns, self.higher, self.taken = np.zeros((0, 0), np.float32), {}, 0, 0
        self._pager: Pager | None = None
        self._asked: tuple[LodQuery, Direction | None] | None = None
        self._stopping = False
        threading.Thread(target=self._open, name="lodgs-stream", daemon=True).start()

    @property
    def arrived(self) -> int:
        """How many updates there have been to take over."""
        return 0 if self._pager is None else self._pager.arrived

    @property
    def splats(self) -> int:
        """How many splats of the file are in memory."""
        return 0 if self._pager is None else self._pager.splats

    @property
    def short(self) -> bool:
        """Whether the eye needs more of them than there is room for."""
        return self._pager is not None and self._pager.short

    @property
    def busy(self) -> bool:
        """Whether something is on its way."""
        if self.problem:
            return self.arrived != self.taken
        return self._pager is None or not self.ready or not self._pager.idle

    def ask(self, choice: LodQuery, direction: Direction | None) -> None:
        """Says by what splats are chosen from now on. Returns at once.

        Args:
            direction: in which the eye looks, in the splats' own space; None: everywhere.
        """
        if (choice, direction) != self._asked:
            self._asked = choice, direction
            self._ask()

    def take(self) -> np.ndarray:
        """Takes over what has come; the places (M,) int32 at which other splats are than before.

        Nobody must be reading.
        """
        update = None if self._pager is None else self._pager.take()
        if update is None:
            return np.zeros(0, np.int32)
        starts = np.array([begin for begin, _ in update.pages])
        counts = np.array([len(splats) for _, splats in update.pages])
        splats = Splats.concatenated([splats for _, splats in update.pages])
        rows = np.repeat(starts - (np.cumsum(counts) - counts), counts) + np.arange(len(splats))
        self.records[rows] = records_of(splats)
        for name in PARENT:
            self.columns[name][rows] = splats.extras[name]
        self.columns[NODE_SIZE], self.columns[PARENT_SIZE] = update.sizes
        self.taken += 1
        return (starts[:, None] + np.arange(SIZE)).reshape(-1).astype(np.int32)

    def stop(self) -> None:
        """Ends reading."""
        self._stopping = True
        if self._pager is not None:
            self._pager.stop()

    def _ask(self) -> None:
        if self._pager is not None and self._asked is not None:
            choice, direction = self._asked
            k = detail_of(choice.focal_px, dict(choice.values)["pixels"])
            self._pager.ask(np.array(choice.eye), k, None if direction is None else np.array(direction))

    def _open(self) -> None:
        """In a thread of its own, which ends when there is something to show."""
        try:
            pager = Pager(self.source.path, self.source.budget)
            if pager.file.total != self.source.total:
                raise LodgsError(
                    f"{self.source.path.name} is not the file that was imported: it has "
                    f"{pager.file.total:,} splats instead of {self.source.total:,}.",
                    "Import it again.",
                )
            self.higher = (pager.sh_degree + 1) ** 2 - 1
            self.records = np.zeros((pager.rows, 4 * record_texels(self.higher)), np.float32)
            self.columns = {
                name: np.zeros(pager.rows, np.float32) for name in (NODE_SIZE, PARENT_SIZE, *PARENT)
            }
            self._pager = pager
            self._ask()
            pager.start()
            while not self._stopping and not pager.problem and not self._enough(pager):
                self.take()
                time.sleep(PAUSE)
            self.problem = pager.problem
            self.ready = not self.problem
        except Exception as error:  # what is shown then is what the scene holds
            self.problem = str(error) or type(error).__name__

    def _enough(self, pager: Pager) -> bool:
        return self._asked is not None and self.taken > 0 and (pager.idle or pager.splats >= self.source.here)


def record_texels(higher: int) -> int:
    """How many texels of four floats a splat's record has: see ``resident.read_records``."""
    return -(-(14 + 3 * higher) // 4)


def records_of(splats: Splats) -> np.ndarray:
    """The records of splats (M,), see ``resident.read_records``, (M, 4 * texels) float32."""
    higher = splats.sh.shape[1] - 1
    records = np.zeros((len(splats), 4 * record_texels(higher)), np.float32)
    records[:, 0:3] = splats.means
    with np.errstate(over="ignore"):
        records[:, 3] = 1 / (1 + np.exp(-splats.opacity_logits))
        records[:, 8:11] = np.exp(splats.log_scales)
    lengths = np.linalg.norm(splats.quats, axis=1, keepdims=True)
    records[:, 4:8] = splats.quats / np.maximum(lengths, np.float32(1e-30))
    records[:, 11 : 14 + 3 * higher] = splats.sh.reshape(len(splats), -1)
    return records
