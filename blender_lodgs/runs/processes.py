"""Starting and following programs that run outside Blender."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy

from ...training.files import open_regular
from ...training.runs.processes import parent_variable
from .. import extension

if sys.platform != "win32":
    import fcntl

INTERVAL = 0.1
"""Seconds between two polls of a program."""

LOG_END = 1 << 14
"""Bytes that are read from the end of a log."""

MARK = "lodgs-in-use"
"""Lock file in a managed environment. Programs that use the environment hold its lock."""


def environment() -> dict[str, str]:
    """Return environment variables for another Python, without those that Blender set for its own.

    Python's compiled files go to the user's folder, because the extension's folder may be read-only. Programs
    of a Blender without a window stop when Blender ends.
    """
    values = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "__PYVENV_LAUNCHER__"))}
    if bpy.app.background:
        values |= parent_variable()
    compiled = extension.user_folder("cache") / "pycache"
    return values | {"PYTHONPYCACHEPREFIX": str(compiled), "PYTHONUTF8": "1"}


def spawn(command: list[str], log: Path, output: Path) -> subprocess.Popen:
    """Start a program that may outlive Blender's window, in the extension's folder.

    Args:
        command: program and arguments.
        log: file to which standard error is appended.
        output: file for standard output, emptied first. Two programs that share it overwrite no lines.

    Raises:
        OSError: the program or a file cannot be opened.
    """
    open(output, "wb").close()
    with open(log, "ab") as errors, open(output, "ab") as stdout:
        return _start(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=errors)


def spawn_piped(command: list[str], log: Path) -> subprocess.Popen[str]:
    """Start a program in the extension's folder with text pipes for standard input and output.

    The program must exit when its standard input is closed, which also happens if Blender crashes.

    Args:
        command: program and arguments.
        log: file to which standard error is appended.

    Raises:
        OSError: the program or the file cannot be opened.
    """
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with open(log, "ab") as errors:
        return _start(command, **pipes, stderr=errors, text=True, encoding="utf-8")


@contextmanager
def hold_environment(folder: Path) -> Iterator[tuple[int, ...]]:
    """Hold the lock of a managed environment within the block, so that it is not removed.

    Yields:
        File descriptors that keep the lock in programs that inherit them, even after Blender has ended. Empty
        on Windows, which protects folders of running programs itself, and for folders without a lock file.
    """
    try:
        mark = os.open(folder / MARK, os.O_RDONLY)
    except OSError:
        yield ()
        return
    try:
        if sys.platform == "win32":
            yield ()
        else:
            fcntl.flock(mark, fcntl.LOCK_SH)
            yield (mark,)
    finally:
        os.close(mark)


def is_in_use(folder: Path) -> bool:
    """Return whether a program holds the lock of an environment. On Windows always False."""
    if sys.platform == "win32":
        return False
    try:
        with open(folder / MARK, "rb") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # no lock file: an incomplete environment
        return False
    return False


def last_lines(log: Path) -> list[str]:
    """Return the lines of a log, or of its last LOG_END bytes. A missing log has no lines."""
    try:
        with open_regular(log) as file:
            file.seek(max(file.seek(0, 2) - LOG_END, 0))
            return file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return []


def failure_reason(log: Path, code: int) -> str:
    """Return why a LODGS program failed: its last error line, or else its exit code and log."""
    errors = [line for line in last_lines(log) if line.lower().startswith("error: ")]
    return errors[-1][7:] if errors else f"The program ended with exit code {code}. See {log}."


def follow(step: Callable[[], bool]) -> None:
    """Call ``step`` about ten times a second until it returns False.

    With a window, a timer calls it, and survives undo and the loading of files. In background, where Blender
    runs no timers, this function blocks until ``step`` returns False.
    """
    if bpy.app.background:
        while step():
            time.sleep(INTERVAL)
    else:
        bpy.app.timers.register(lambda: INTERVAL if step() else None, persistent=True)


def _start(command: list[str], **streams: Any) -> subprocess.Popen:
    """Start a program that Ctrl-C does not reach, so that Blender can cancel it cleanly."""
    detached: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        detached = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    with hold_environment(Path(command[0]).parent.parent) as inherited:
        return subprocess.Popen(
            command, cwd=extension.FOLDER, env=environment(), pass_fds=inherited, **streams, **detached
        )
