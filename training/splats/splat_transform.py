"""Conversion of splat files to PLY by PlayCanvas' splat-transform (MIT, from npm)."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import LodgsError

PROGRAM = "splat-transform"
INSTALL_HINT = (
    "Install Node.js 22 or newer (nodejs.org), then run in a terminal: npm install --global "
    "@playcanvas/splat-transform. Then restart this program."
)
# npm's program folders that a desktop's PATH lacks: those of Homebrew and of the installer.
_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin")


def run_splat_transform(arguments: Sequence[str]) -> None:
    """Run splat-transform. A run that fails on the graphics card is repeated on the CPU.

    Args:
        arguments: arguments of the program, the last of them the file to write.

    Raises:
        LodgsError: the program is missing or fails.
    """
    path = shutil.which(PROGRAM, path=_search_path())
    if path is None:
        raise LodgsError(f"Cannot convert splats: {PROGRAM} is not installed.", INSTALL_HINT)
    for device in ((), ("-g", "cpu")):
        process = subprocess.run(
            [path, "-w", "--no-tty", *device, *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, encoding="utf-8", errors="replace", check=False,
            env=os.environ | {"PATH": _search_path()},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )  # fmt: skip
        if process.returncode == 0 and Path(arguments[-1]).exists():
            return
    errors = [line.split("Error:")[-1] for line in process.stdout.splitlines() if "Error:" in line]
    failure = f"exit code {process.returncode}: {(errors or [process.stdout[-200:]])[-1].strip()}"
    raise LodgsError(
        f"Cannot convert splats: {PROGRAM} failed ({failure if process.returncode else 'no output'}).",
        "Check that its version is 3 or newer, and the version of Node.js 22 or newer.",
    )


def _search_path() -> str:
    folders = [os.environ.get("PATH", "")]
    return os.pathsep.join(folders if sys.platform == "win32" else [*folders, *_FOLDERS])
