"""Programs that work beside Blender: how they are started, and how Blender looks after them."""

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

from .. import extension

if sys.platform != "win32":
    import fcntl

INTERVAL = 0.1
"""Seconds between two looks at a program."""

LOG_END = 1 << 14
"""Bytes of a log that are looked at."""

MARK = "lodgs-in-use"
"""File in an environment that the extension makes: locked by whatever is at work in it."""


def environment() -> dict[str, str]:
    """This process's environment for another Python: without what Blender set for its own.

    Compiled code goes to the user's folder, because the extension's may be read-only.
    """
    values = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "__PYVENV_LAUNCHER__"))}
    cache = extension.user_folder("cache")
    values.setdefault("NUMBA_CACHE_DIR", str(cache / "numba"))
    return values | {"PYTHONPYCACHEPREFIX": str(cache / "pycache"), "PYTHONUTF8": "1"}


def spawn(command: list[str], log: Path, output: Path) -> subprocess.Popen:
    """Start a program that outlives Blender, in the extension's folder.

    Args:
        command: program and arguments.
        log: file to which its standard error is appended.
        output: file that takes its standard output; what was there before is dropped.

    Raises:
        OSError: the program or a file cannot be opened.
    """
    with open(log, "ab") as errors, open(output, "wb") as stdout:
        return _start(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=errors)


def converse(command: list[str], log: Path) -> subprocess.Popen[str]:
    """Start a program that ends with Blender, in the extension's folder, and speak with it line by line.

    It must end when its standard input does: that happens however Blender ends.

    Args:
        command: program and arguments.
        log: file to which its standard error is appended.

    Raises:
        OSError: the program or the file cannot be opened.
    """
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with open(log, "ab") as errors:
        return _start(command, **pipes, stderr=errors, text=True, encoding="utf-8")


@contextmanager
def using(folder: Path) -> Iterator[tuple[int, ...]]:
    """Hold the mark of an environment that the extension made, so that it is not removed.

    Yields:
        Descriptors that hold it as well for as long as a program lives that inherits them, also when Blender
        has ended: none on Windows, which by itself keeps folders where a program runs or a file is open, and
        none for a folder without the mark.
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


def in_use(folder: Path) -> bool:
    """Whether anything holds an environment's mark; not on Windows, where it cannot be renamed then."""
    if sys.platform == "win32":
        return False
    try:
        with open(folder / MARK, "rb") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # it has none: a part of one
        return False
    return False


def last_lines(log: Path) -> list[str]:
    """Lines of a program's log, or of its end where that is long; none where there is none yet."""
    try:
        with open(log, "rb") as file:
            file.seek(max(file.seek(0, 2) - LOG_END, 0))
            return file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return []


def problem_of(log: Path, code: int) -> str:
    """Why a program of ours that ended with a code did so, by what it said last."""
    errors = [line for line in last_lines(log) if line.lower().startswith("error: ")]
    return errors[-1][7:] if errors else f"It has ended with {code}; {log} tells more."


def follow(step: Callable[[], bool]) -> None:
    """Call ``step`` about ten times a second until it returns False.

    In a window a timer does that while the user works on, and goes on over undo and the loading of files; in
    background, where Blender runs no timers, it happens here and this returns when all is over.
    """
    if bpy.app.background:
        while step():
            time.sleep(INTERVAL)
    else:
        bpy.app.timers.register(lambda: INTERVAL if step() else None, persistent=True)


def _start(command: list[str], **streams: Any) -> subprocess.Popen:
    """A program beside Blender: Ctrl-C is for Blender, which may cancel politely."""
    detached: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        detached = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    with using(Path(command[0]).parent.parent) as inherited:
        return subprocess.Popen(
            command, cwd=extension.FOLDER, env=environment(), pass_fds=inherited, **streams, **detached
        )
