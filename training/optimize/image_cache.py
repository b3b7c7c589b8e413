"""Cache of training images with a memory limit, read ahead by threads."""

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
"""Reader threads, besides the training thread."""
READ_AHEAD = 8
"""Number of steps whose images are read ahead."""
WINDOW = 4096
"""Number of coming steps whose views are known."""

CameraPlan = Callable[[int], Camera | None]
"""Forecast of a step's view at its image size. None if the step needs no image, or does not exist."""

_Key = tuple[Path, int, int]


def default_budget() -> int:
    """Return the default size of the cache in bytes: a quarter of the free memory, at most ``MAX_BYTES``."""
    return min(MAX_BYTES, free_memory() // 4)


class ImageCache:
    """Training images by view. Keeps the images that are needed soonest and reads them ahead.

    The cache affects only the duration of steps, so a forecast may be wrong. Images count without their
    mask and alpha, which take 4 bytes per pixel each. The budget is exceeded only by an image that does not
    fit and is in use. One thread may call; reader threads only read.

    Args:
        read: load a view's image. Called in threads, for each view by one thread at a time.
        budget: bytes.

    Attributes:
        held_bytes: size of the images that are cached or being read.
    """

    def __init__(self, read: Callable[[Camera], Target], budget: int) -> None:
        self._read = read
        self._budget = budget
        self.held_bytes = 0
        self._cached: dict[_Key, Future[Target]] = {}  # least recently used first
        self._readers: ThreadPoolExecutor | None = None
        self._plan: CameraPlan | None = None
        self._begin = 0  # first step of the window
        self._window: deque[_Key | None] = deque()
        self._uses: dict[_Key, deque[int]] = {}  # steps of the window that need an image

    def target(self, camera: Camera) -> Target:
        """Return the image of a view, at the view's size.

        Raises:
            LodgsError: the image cannot be read.
        """
        key = _key(camera)
        reading = self._cached.pop(key, None)
        if reading is not None and not reading.cancel():  # reading has started
            try:
                target = reading.result()
            except Exception:  # read again below, which raises the error if it persists
                pass
            else:
                self._cached[key] = reading
                return target
        if reading is not None:
            self.held_bytes -= _bytes(key)
        target = self._read(camera)
        if self._make_room(_bytes(key), self._next_use(key)):
            self._cached[key] = done = Future()
            done.set_result(target)
            self.held_bytes += _bytes(key)
        return target

    def prefetch(self, step: int, plan: CameraPlan) -> None:
        """Start a step: read the images of this and the next steps ahead, as far as they fit.

        Args:
            plan: forecast of views. It may be called for steps that never come, and may change later.
        """
        self._advance(step, plan)
        for use, key in enumerate(islice(self._window, READ_AHEAD), step):
            if key is None or key in self._cached:
                continue
            camera = plan(use)
            if camera is None or _key(camera) != key or not self._make_room(_bytes(key), use):
                break
            if self._readers is None:
                self._readers = ThreadPoolExecutor(READERS, "lodgs-images")
            self._cached[key] = self._readers.submit(self._read, camera)
            self.held_bytes += _bytes(key)

    def _make_room(self, size: int, use: float) -> bool:
        """Evict images that are needed later than step ``use``, latest first, until ``size`` bytes are free.

        Images without a known use are evicted first, least recently used first.
        """
        if size > self._budget:
            return False
        while self.held_bytes + size > self._budget:
            key = max(
                (key for key, reading in self._cached.items() if not reading.running()),
                key=self._next_use,
                default=None,
            )
            if key is None or (self._next_use(key) <= use and self._next_use(key) < inf):
                return False
            if self._cached[key].cancel() or self._cached[key].done():
                del self._cached[key]
                self.held_bytes -= _bytes(key)
        return True

    def _next_use(self, key: _Key) -> float:
        """Return the next known step that needs an image, or infinity."""
        return self._uses[key][0] if key in self._uses else inf

    def _advance(self, step: int, plan: CameraPlan) -> None:
        """Move the window to begin with a step."""
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
            or self._window[0] != _optional_key(plan(step))
        ):
            self._plan = plan
            self._begin = step
            self._window = deque()
            self._uses = {}
        while len(self._window) < WINDOW:
            key = _optional_key(plan(step + len(self._window)))
            if key is not None:
                self._uses.setdefault(key, deque()).append(step + len(self._window))
            self._window.append(key)


def _key(camera: Camera) -> _Key:
    assert camera.image is not None
    return camera.image, camera.width, camera.height


def _optional_key(camera: Camera | None) -> _Key | None:
    return None if camera is None else _key(camera)


def _bytes(key: _Key) -> int:
    return TARGET_BYTES * key[1] * key[2]
