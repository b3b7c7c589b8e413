"""pycolmap in a process of its own: it may end the process, and Pillow corrupts memory beside it.

A module that is such a program begins with :func:`read_request` and says what it has to say in :func:`send`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_ROOM = 1 << 18  # bytes that are still free on a disk that is not full
CHECK_SECONDS = 2.0
"""Seconds between two looks at whether the disk is full."""


def run_program(module: str, request: dict, work: Path, hear: Callable[[dict], object] | None = None) -> str:
    """Runs a module of this folder as a program to its end.

    It ends as soon as this process does, however that comes, and where the disk is full.

    Args:
        module: its name.
        request: what it is to do.
        work: folder that it writes to.
        hear: gets each object that it says.

    Returns:
        Why it could not do it; empty where it did.

    Raises:
        OSError: there is no room on the disk, or it could not be started.
    """
    package = Path(__file__).resolve().parents[1]  # training, or lodgs where pip has installed it
    with subprocess.Popen(
        [sys.executable, "-m", f"{package.name}.scenes.{module}"],
        cwd=package.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
    ) as child:
        assert child.stdin is not None and child.stdout is not None and child.stderr is not None
        threading.Thread(target=_end_without_room, args=(child, work), daemon=True).start()
        problems: list[str] = []
        errors = child.stderr
        reader = threading.Thread(target=lambda: problems.extend(errors), daemon=True)
        reader.start()
        try:
            with suppress(OSError):  # it has ended already, and said why
                child.stdin.write(json.dumps(request) + "\n")
                child.stdin.flush()  # and stays open: the program ends when it is closed
            for line in child.stdout:
                if hear is not None and line.startswith("{"):
                    hear(json.loads(line))
            child.wait()
            reader.join()
            with suppress(OSError):
                child.stdin.close()
        except BaseException:
            child.kill()
            raise
    _require_room(work)
    if not child.returncode:
        return ""
    lines = [line.strip() for line in problems if line.strip()] or [f"exit code {child.returncode}"]
    return lines[-1]


def read_request() -> dict:
    """What this program is to do; from then on it ends when who started it does."""
    found = json.loads(sys.stdin.readline())

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    return found


def load_pycolmap():
    """pycolmap, which says what goes wrong on standard error and writes no log files; ends the program where
    there is none."""
    try:
        import pycolmap
    except ImportError as error:
        sys.exit(f"pycolmap cannot be loaded: {error}.")
    pycolmap.logging.logtostderr = True
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    return pycolmap


def send(**values: object) -> None:
    """An object for whoever started this program."""
    print(json.dumps(values), flush=True)


def _end_without_room(child: subprocess.Popen[str], folder: Path) -> None:
    """Ends a program when the disk that it writes to is full: COLMAP's threads may wait for good then."""
    while child.poll() is None:
        try:
            _require_room(folder)
        except OSError:
            child.kill()
        time.sleep(CHECK_SECONDS)


def _require_room(folder: Path) -> None:
    """Raises OSError where a disk is full: COLMAP crashes then, or hangs, or writes half a photograph."""
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(os.urandom(_ROOM))
        file.flush()
        os.fsync(file.fileno())
