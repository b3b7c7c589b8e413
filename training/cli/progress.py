"""Trainings that are part of a command: their progress is printed in lines that people read."""

from __future__ import annotations

import io
import json
import sys
from typing import IO, TYPE_CHECKING, Any, cast

from ..errors import DISK, SYSTEM, SystemProblem

if TYPE_CHECKING:
    from ..runs.job import Job


def notify(sentence: str) -> None:
    """Print a sentence about progress to standard error."""
    print(sentence, file=sys.stderr, flush=True)


def train(job: Job, text: str) -> str:
    """Train or resume a job, and print its steps after a text.

    Returns:
        Reason of a failure, or "" if the run is finished.

    Raises:
        KeyboardInterrupt: training was cancelled.
        SystemProblem: the disk is full or the computer failed, which would end further trainings, too.
    """
    from ..runs.failures import CANCELLED, DONE
    from ..runs.train import train

    notify(text)
    events = _Events(text)
    code = train(job, cast("IO[str]", events))
    if code == CANCELLED:
        raise KeyboardInterrupt
    if code == DONE:
        return ""
    problem, remedy = (str(events.last.get(key, "")) for key in ("what", "remedy"))
    if events.last.get("cause") in (DISK, SYSTEM):
        raise SystemProblem(problem, remedy)
    return problem or "Training crashed."


class _Events(io.TextIOBase):
    """Stream of a run's events that prints the steps, in one line of a terminal or in a hundred of a log.

    Attributes:
        last: the newest event.
    """

    def __init__(self, text: str) -> None:
        self.last: dict[str, Any] = {}
        self._text = text
        self._percent = -1

    def write(self, text: str, /) -> int:
        if text.strip():
            self.last = json.loads(text)
            if self.last["event"] == "progress":
                self._print(self.last["step"], self.last["of"])
        return len(text)

    def _print(self, step: int, steps: int) -> None:
        percent = 100 * step // max(steps, 1)
        terminal = sys.stderr.isatty()
        if terminal or percent > self._percent:
            self._percent = percent
            end = "\r" if terminal and step < steps else "\n"
            print(f"{self._text}, step {step} of {steps}", end=end, file=sys.stderr, flush=True)
