"""Notice the end of the process that started this one, such as a killed run of blocks."""

from __future__ import annotations

import os
import threading
from contextlib import suppress

VARIABLE = "LODGS_STOP_WITH_INPUT"
"""Environment variable of a trainer that stops when its standard input ends."""

ended = threading.Event()
"""Set when the process that started this one has ended; only after :func:`watch`."""


def watch() -> None:
    """Start to watch standard input if the environment asks for it."""
    if os.environ.pop(VARIABLE, None):  # not for the programs that this process starts
        threading.Thread(target=_wait, daemon=True).start()


def _wait() -> None:
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    ended.set()
