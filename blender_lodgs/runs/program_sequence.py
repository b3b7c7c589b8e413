"""Programs that run in the background, one after the other."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from .. import extension
from . import processes

_PROGRESS = re.compile(r"(.*?) (\d+) of (\d+)$")


class ProgramSequence:
    """Background programs that run one after the other, with their progress for the panel.

    The last line of the log gives the progress if it ends in "NUMBER of NUMBER".

    Args:
        log: log file. Standard output of the programs is written beside it.
        commands: programs with their arguments.
        finish: called after the last program. Its LodgsError becomes ``problem``.
        message: first message.

    Attributes:
        message: current step, or the result.
        fraction: progress of the current step, 0 to 1.
        problem: reason of a failure. Empty otherwise.
        running: whether a program is running.
        root: scene root that the work belongs to, if any.
        warnings: one sentence per warning.
        results: last output line of each finished program, without the folder name.
    """

    def __init__(
        self, log: Path, commands: list[list[str]], finish: Callable[[ProgramSequence], None], message: str
    ) -> None:
        self.message = message
        self.fraction = 0.0
        self.problem = ""
        self.running = True
        self.warnings: list[str] = []
        self.results: list[str] = []
        self.root: bpy.types.Object | None = None
        self._log = log
        self._commands = commands
        self._finish = finish
        self._cancelled = False
        self._log.unlink(missing_ok=True)
        self._process = self._next()

    def cancel(self) -> None:
        """Stop the current program. Starting the same programs again continues."""
        self._cancelled = True
        self._process.terminate()

    def step(self) -> bool:
        """Update the progress. Return whether a program is running, for ``processes.follow``."""
        code = self._process.poll()
        last = processes.last_lines(self._log)[-1:]
        if code == 0:
            output = processes.last_lines(self._log.with_suffix(".out"))
            self.results.append(output[-1].partition(": ")[2] if output else "")
        if code == 0 and self._commands and not self._cancelled:
            self._process, code = self._next(), None
        self.running = code is None
        if code is None and last and (progress := _PROGRESS.match(last[0])):
            self.message = last[0]
            self.fraction = int(progress[2]) / max(int(progress[3]), 1)
        elif code == 0:
            self.fraction = 1.0
            try:
                with extension.in_window():
                    self._finish(self)
            except LodgsError as error:
                self.problem = str(error)
        elif code is not None:
            self.message = "Stopped; start it again to continue"
            self.problem = "" if self._cancelled else processes.failure_reason(self._log, code)
        extension.redraw()
        return self.running

    def _next(self) -> subprocess.Popen:
        return processes.spawn(self._commands.pop(0), self._log, self._log.with_suffix(".out"))
