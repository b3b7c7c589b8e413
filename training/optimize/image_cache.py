"""Photographs for the steps that need them: read ahead by threads, and kept within a number of bytes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from math import inf
from pathlib import Path

from ..rasterize import Target
from ..scenes.cameras import Camera
from .memory import MAX_BYTES, TARGET_BYTES, free_memory

READERS = 2
"""Threads that read: a step has its own."""
READ_AHEAD = 8
"""Photographs of so many steps are read ahead."""
WINDOW = 4096
"""It is known of so many coming steps what they need."""

CameraPlan = Callable[[int], Camera | None]
"""The view of a step, as far as is known before it, at its size; None: it needs none, or there is no step."""

_Key = tuple[Path, int, int]


def default_budget() -> int:
    """Bytes that are kept if nothing is said: a quarter of the free memory, MOST_BYTES at most."""
    return min(MAX_BYTES, free_memory() // 4)


class ImageCache:
    """Photographs by their views: those that are needed soonest stay, and are read before they are needed.

    What is kept, and when it is read, changes how long a step takes and nothing else: a plan may be wrong.
    Every photograph counts with the moments that losses keep beside it, but without its mask and its alpha,
    which take 4 bytes a pixel each. No more than the budget is held, besides a
    photograph that has no room in it and is in use. For one thread to ask; others only read.

    Args:
        read: a view's photograph; called in threads, with one view by one thread at a time.
        budget: bytes.

    Attributes:
        held: bytes of the photographs that are kept or being read.
    """

    def __init__(self, read: Callable[[Camera], Target], budget: int) -> None:
        self._read, self._budget, self.held_bytes = read, budget, 0
        self._kept: dict[_Key, Future[Target]] = {}  # least recently used first
        self._readers: ThreadPoolExecutor | None = None
        self._plan: CameraPlan | None = None
        self._begin = 0  # the step that the window begins with
        self._window: deque[_Key | None] = deque()
        self._uses: dict[_Key, deque[int]] = {}  # the steps in the window that need a photograph

    def target(self, camera: Camera) -> Target:
        """The photograph of a view, at the view's size.

        Raises:
            LodgsError: it cannot be read.
        """
        key = _key(camera)
        reading = self._kept.pop(key, None)
        if reading is not None and not reading.cancel():  # it has begun to be read
            try:
                target = reading.result()
            except Exception:  # told by the step that needs it, and only if it is still so
                pass
            else:
                self._kept[key] = reading
                return target
        if reading is not None:
            self.held_bytes -= _bytes(key)
        target = self._read(camera)
        if self._make_room(_bytes(key), self._next_use(key)):
            self._kept[key] = done = Future()
            done.set_result(target)
            self.held_bytes += _bytes(key)
        return target

    def prefetch(self, step: int, plan: CameraPlan) -> None:
        """Tells that a step begins; what it and the next ones need is read, while there is room.

        Args:
            plan: what steps need; it may be asked about steps that never come, and say something else later.
        """
        self._advance(step, plan)
        for use, key in enumerate(islice(self._window, READ_AHEAD), step):
            if key is None or key in self._kept:
                continue
            camera = plan(use)
            if camera is None or _key(camera) != key or not self._make_room(_bytes(key), use):
                break
            if self._readers is None:
                self._readers = ThreadPoolExecutor(READERS, "lodgs-photographs")
            self._kept[key] = self._readers.submit(self._read, camera)
            self.held_bytes += _bytes(key)

    def _make_room(self, size: int, use: float) -> bool:
        """Drops what is needed last, and later than at the step ``use``, until so many bytes are free.

        Of what is not known to be needed the least recently used goes first.
        """
        if size > self._budget:
            return False
        while self.held_bytes + size > self._budget:
            key = max(
                (key for key, reading in self._kept.items() if not reading.running()),
                key=self._next_use,
                default=None,
            )
            if key is None or (self._next_use(key) <= use and self._next_use(key) < inf):
                return False
            if self._kept[key].cancel() or self._kept[key].done():
                del self._kept[key]
                self.held_bytes -= _bytes(key)
        return True

    def _next_use(self, key: _Key) -> float:
        """The step that needs a photograph next, as far as is known."""
        return self._uses[key][0] if key in self._uses else inf

    def _advance(self, step: int, plan: CameraPlan) -> None:
        """Moves the window to begin with a step."""
        while self._window and self._begin < step:
            key = self._window.popleft()
            if key is not None:
                self._uses[key].popleft()
                if not self._uses[key]:
                    del self._uses[key]
            self._begin += 1
        if (
            plan != self._plan
            or self._begin != step
            or not self._window
            or self._window[0] != _of(plan(step))
        ):
            self._plan, self._begin = plan, step
            self._window, self._uses = deque(), {}
        while len(self._window) < WINDOW:
            key = _of(plan(step + len(self._window)))
            if key is not None:
                self._uses.setdefault(key, deque()).append(step + len(self._window))
            self._window.append(key)


def _key(camera: Camera) -> _Key:
    assert camera.image is not None
    return camera.image, camera.width, camera.height


def _of(camera: Camera | None) -> _Key | None:
    return None if camera is None else _key(camera)


def _bytes(key: _Key) -> int:
    return TARGET_BYTES * key[1] * key[2]
