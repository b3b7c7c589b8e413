"""Programs that work beside Blender: how they are started, and how Blender looks after them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from .. import extension

INTERVAL = 0.1
"""Seconds between two looks at a program."""


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
    detached: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        detached = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    with open(log, "ab") as errors, open(output, "wb") as stdout:
        return subprocess.Popen(
            command,
            cwd=extension.FOLDER,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=errors,
            **detached,
        )


def converse(command: list[str], log: Path) -> subprocess.Popen[str]:
    """Start a program that ends with Blender, in the extension's folder, and speak with it line by line.

    It must end when its standard input does: that happens however Blender ends.

    Args:
        command: program and arguments.
        log: file to which its standard error is appended.

    Raises:
        OSError: the program or the file cannot be opened.
    """
    detached: dict[str, Any] = {"start_new_session": True}  # Ctrl-C is for Blender, which may cancel politely
    if sys.platform == "win32":
        detached = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    with open(log, "ab") as errors:
        return subprocess.Popen(
            command,
            cwd=extension.FOLDER,
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            encoding="utf-8",
            **detached,
        )


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
