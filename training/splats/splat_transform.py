"""Conversion of splat files by PlayCanvas' splat-transform (MIT, from npm).

SPZ and compressed PLY change with the versions of their programs, so splat-transform reads and writes
them. It reads SOG and streamed levels, too. The existing Python packages (gaussforge, gsply) do not run in
Blender, because they are compiled for one version of Python each.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import temporary_folder
from .gaussians import SplatRows, Splats

PROGRAM = "splat-transform"
INSTALL_HINT = (
    "Install Node.js 22 or newer (nodejs.org), then run in a terminal: npm install --global "
    "@playcanvas/splat-transform. Then restart this program."
)
# npm's program folders that a desktop's PATH lacks: those of Homebrew and of the installer.
_FOLDERS = ("/opt/homebrew/bin", "/usr/local/bin")
_POLL_SECONDS = 0.05
"""Interval between checks of the running program."""
_CPU_ROUNDS = 3
"""Rounds of clustering harmonics on the CPU, instead of 10. Time is proportional to rounds; on a trained
scene (3,000 splats of degree 3) the colour error after 3 rounds was 0.3 % larger than after 10."""


_MIN_LOG_SCALE = -20.0
_MAX_LOGIT = 40.0
"""Limits of values for splat-transform; the sigmoid of the logit is 1 in float32."""


class FiniteRows:
    """Rows of splats with finite scales and opacities, which splat-transform below 3 needs."""

    def __init__(self, rows: SplatRows) -> None:
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Return the splats of a range of rows, or of ascending rows (M,)."""
        splats = self._rows.select(index)
        return replace(
            splats,
            log_scales=np.maximum(splats.log_scales, np.float32(_MIN_LOG_SCALE)),
            opacity_logits=np.clip(splats.opacity_logits, np.float32(-_MAX_LOGIT), np.float32(_MAX_LOGIT)),
        )


def run_splat_transform(arguments: Sequence[str]) -> None:
    """Run splat-transform to the end; raises as :func:`splat_transform_steps`."""
    for _ in splat_transform_steps(arguments):
        pass


def splat_transform_steps(arguments: Sequence[str]) -> Iterator[str]:
    """Run splat-transform, and yield its last line of output while it runs.

    A run that fails on the graphics card is repeated on the CPU. Closing the generator ends the program.

    Args:
        arguments: arguments of the program, the last of them the file to write.

    Raises:
        LodgsError: the program is missing or fails.
    """
    command = find_splat_transform()
    output = ""
    environment = os.environ | {"PATH": _search_path()}
    for device in ((), ("-g", "cpu", "-i", str(_CPU_ROUNDS))):
        with temporary_folder() as folder:
            log = folder / "log"
            with open(log, "wb") as stream:
                process = subprocess.Popen(
                    [command, "-w", "--no-tty", *device, *arguments],
                    stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, env=environment,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )  # fmt: skip
            try:
                while process.poll() is None:
                    yield _last_line(log)
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(_POLL_SECONDS)
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
            if process.returncode == 0 and Path(arguments[-1]).exists():
                return
            output = log.read_text("utf-8", "replace")
    errors = [line.split("Error:")[-1] for line in output.splitlines() if "Error:" in line]
    failure = f"exit code {process.returncode}: {(errors or [output[-200:]])[-1].strip()}"
    raise LodgsError(
        f"Cannot convert splats: {PROGRAM} failed ({failure if process.returncode else 'no output'}).",
        "Check that its version is 3 or newer, and the version of Node.js 22 or newer.",
    )


def find_splat_transform() -> str:
    """Return the path of splat-transform.

    Raises:
        LodgsError: it is not installed.
    """
    path = shutil.which(PROGRAM, path=_search_path())
    if path is None:
        raise LodgsError(f"Cannot convert splats: {PROGRAM} is not installed.", INSTALL_HINT)
    return path


def _search_path() -> str:
    folders = [os.environ.get("PATH", "")]
    return os.pathsep.join(folders if sys.platform == "win32" else [*folders, *_FOLDERS])


def _last_line(log: Path) -> str:
    """Return the last line of a log without progress symbols."""
    lines = (line.strip(" ·▸") for line in reversed(log.read_text("utf-8", "replace").splitlines()))
    return next(filter(None, lines), "")
