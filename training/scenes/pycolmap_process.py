"""Run pycolmap in a separate process: it may abort its process, and Pillow corrupts memory next to it.

A module that runs as such a program starts with :func:`read_request`, answers with :func:`send`, and obtains
more data with :func:`ask`.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import ModuleType

from ..files import name_errors

_MIN_FREE_BYTES = 1 << 18
"""Free space below which a disk counts as full."""
CHECK_SECONDS = 2.0
"""Seconds between two checks of the free disk space."""


_replies: queue.SimpleQueue[dict] = queue.SimpleQueue()
"""Replies of the parent process that :func:`ask` has not returned yet."""


def run_program(
    module: str, request: dict, work: Path, on_message: Callable[[dict], object] | None = None
) -> str:
    """Run a module of this package as a program and wait for it.

    The program stops when this process ends for any reason, and when the disk is full.

    Args:
        module: module name.
        request: JSON object that the program receives.
        work: folder that the program writes to.
        on_message: receives each object that the program sends. Its result, unless None, is the reply that
            :func:`ask` returns in the program.

    Returns:
        The error message of the program; "" after success.

    Raises:
        OSError: the disk is full or the program cannot be started.
    """
    package = Path(__file__).resolve().parents[1]  # training, or lodgs after pip install
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
        threading.Thread(target=_kill_on_full_disk, args=(child, work), daemon=True).start()
        problems: list[str] = []
        errors = child.stderr
        reader = threading.Thread(target=lambda: problems.extend(errors), daemon=True)
        reader.start()
        try:
            with suppress(OSError):  # the program may have ended already, with a message
                child.stdin.write(json.dumps(request) + "\n")
                child.stdin.flush()  # stdin stays open, because closing it stops the program
            for line in child.stdout:
                if on_message is not None and line.startswith("{"):
                    reply = on_message(json.loads(line))
                    if reply is not None:
                        with suppress(OSError):  # the program may have ended
                            child.stdin.write(json.dumps(reply) + "\n")
                            child.stdin.flush()
            child.wait()
            reader.join()
            with suppress(OSError):
                child.stdin.close()
        except BaseException:
            child.kill()
            raise
    _require_free_space(work)
    if not child.returncode:
        return ""
    lines = [line.strip() for line in problems if line.strip()] or [f"exit code {child.returncode}"]
    return lines[-1]


def read_request() -> dict:
    """Return the request of this program, and stop the program as soon as its parent process ends."""
    request = json.loads(sys.stdin.readline())

    def wait() -> None:
        received = b""
        while data := os.read(0, 4096):  # a blocked read of sys.stdin would abort Python's exit
            *lines, received = (received + data).split(b"\n")
            for line in lines:
                _replies.put(json.loads(line))
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    return request


def load_pycolmap() -> ModuleType:
    """Import pycolmap with errors on standard error and no log files; exit if it cannot be imported."""
    try:
        import pycolmap
    except ImportError as error:
        sys.exit(f"pycolmap cannot be imported: {error}.")
    pycolmap.logging.logtostderr = True
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR.value)
    return pycolmap


def send(**values: object) -> None:
    """Send an object to the parent process."""
    print(json.dumps(values), flush=True)


def ask(**values: object) -> dict:
    """Send an object to the parent process and return its reply."""
    send(**values)
    return _replies.get()


def _kill_on_full_disk(child: subprocess.Popen[str], folder: Path) -> None:
    """Kill a program when its disk is full: COLMAP's threads may then wait forever."""
    while child.poll() is None:
        try:
            _require_free_space(folder)
        except OSError:
            child.kill()
        time.sleep(CHECK_SECONDS)


def _require_free_space(folder: Path) -> None:
    """Raise OSError if the disk is full: COLMAP would crash, hang or write incomplete images."""
    with name_errors(folder), tempfile.TemporaryFile(dir=folder) as file:
        file.write(os.urandom(_MIN_FREE_BYTES))
        file.flush()
        os.fsync(file.fileno())
