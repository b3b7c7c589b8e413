"""Requests to stop a training: signals, the file ``cancel`` and the end of the parent process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from . import processes
from .folder import RunFolder


@contextmanager
def interrupt_on_cancel(folder: RunFolder) -> Iterator[None]:
    """Raise KeyboardInterrupt in the block on a cancel request, before the training loop looks for it."""
    finished = threading.Event()

    def watch() -> None:
        while not finished.wait(0.1):
            with suppress(OSError):
                if processes.parent_ended.is_set() or folder.take_cancel():
                    processes.interrupt()
                    return

    previous = None
    with suppress(ValueError):  # not in the main thread
        # shells start background programs with SIGINT ignored
        previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    watcher = threading.Thread(target=watch, daemon=True)
    try:
        watcher.start()
        yield
    finally:
        try:
            finished.set()
            watcher.join()
        finally:  # also if the interruption arrives while this waits
            if previous is not None:
                signal.signal(signal.SIGINT, previous)


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Yield a list that receives the numbers of stop signals."""
    received: list[int] = []
    names = ("SIGINT", "SIGTERM", "SIGBREAK")  # the last is Windows' CTRL_BREAK_EVENT
    previous = {}
    for name in names:
        if hasattr(signal, name):
            with suppress(ValueError):  # not in the main thread
                number = getattr(signal, name)
                previous[number] = signal.signal(number, lambda number, _: received.append(number))
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
