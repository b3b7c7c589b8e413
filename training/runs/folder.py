"""A run's folder and what can be read from it, by anyone, at any time. No torch: Blender polls it.

    run/  job.toml  events.jsonl  checkpoints/  levels/level_1.ply ..  bundle.ply  metrics.json
          model.npz (what a method with networks has beside its levels)
          trainer.log, trainer.out (what a trainer that Blender started printed)  lock  cancel

``events.jsonl`` holds one JSON object a line, the same lines that the trainer prints. While a trainer runs,
it holds an operating-system lock on ``lock``, which vanishes with its process however that ends.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..errors import LodgsError

PROTOCOL = 1
"""Version of the events; raised when a reader of older ones would misunderstand."""


class RunFolder:
    """The paths of a run, and the state that they tell."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.job = self.path / "job.toml"
        self.events_file = self.path / "events.jsonl"
        self.checkpoints = self.path / "checkpoints"
        self.levels_folder = self.path / "levels"
        self.bundle = self.path / "bundle.ply"
        self.metrics = self.path / "metrics.json"
        self.model = self.path / "model.npz"
        self.log = self.path / "trainer.log"
        self._lock = self.path / "lock"
        self._cancel = self.path / "cancel"

    def make(self) -> None:
        """Makes the folder and those inside it.

        Raises:
            LodgsError: if it cannot be written.
        """
        try:
            for folder in (self.path, self.checkpoints, self.levels_folder):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LodgsError(
                f"The run folder {self.path} cannot be made: {error.strerror}.",
                "Choose a folder that you may write to.",
            ) from error

    # -- reading ---------------------------------------------------------------------------------------

    def events(self, since: int = 0) -> tuple[list[dict], int]:
        """The whole lines after byte ``since``, as objects, and the byte to go on from next time.

        A last line without its end is left for later; a line that is no JSON object (from a killed
        trainer) is passed over.
        """
        try:
            with self.events_file.open("rb") as file:
                file.seek(since)
                data = file.read()
        except FileNotFoundError:
            return [], 0
        whole = data[: data.rfind(b"\n") + 1]
        events = []
        for line in whole.splitlines():
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                events.append(event)
        return events, since + len(whole)

    def last(self, *kinds: str) -> dict | None:
        """The newest event of one of these kinds, or None."""
        return next((e for e in reversed(self.events()[0]) if e["event"] in kinds), None)

    def levels(self) -> list[dict]:
        """The newest ``level`` event of each level, coarse to fine."""
        newest = {e["level"]: e for e in self.events()[0] if e["event"] == "level"}
        return [newest[level] for level in sorted(newest)]

    def state(self) -> str:
        """One of

        - ``empty``: nothing was started here
        - ``running``: a trainer is at work
        - ``done``: finished
        - ``cancelled``: stopped on request, can be resumed
        - ``failed``: stopped with an ``error`` event, can be resumed when its cause is gone
        - ``interrupted``: the trainer ended without a word (killed, power cut), can be resumed
        """
        if self._locked():
            return "running"
        last = self.last("hello", "error", "cancelled", "done")
        if last is None:
            return "interrupted" if self.job.exists() else "empty"
        return {"error": "failed", "cancelled": "cancelled", "done": "done"}.get(last["event"], "interrupted")

    def log_tail(self, lines: int = 20) -> str:
        """The last lines of what the trainer wrote outside the protocol (its standard error)."""
        try:
            text = self.log.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-lines:])

    # -- asking and holding ----------------------------------------------------------------------------

    def request_cancel(self) -> None:
        """Asks the trainer to save and stop; it does so within a step or two."""
        self._cancel.touch()

    def take_cancel(self) -> bool:
        """For the trainer: whether it was asked to stop since the last call."""
        if not self._cancel.exists():
            return False
        self._cancel.unlink(missing_ok=True)
        return True

    @contextmanager
    def hold(self) -> Iterator[None]:
        """For the trainer: holds the run's lock.

        Raises:
            LodgsError: if another trainer holds it.
        """
        with self._lock.open("a+b") as file:
            for _ in range(10):  # somebody who asks for the state holds the lock for an instant
                if _try_lock(file):
                    break
                time.sleep(0.1)
            else:
                raise LodgsError(
                    f"Another training is already at work in {self.path}.",
                    "Wait for it, cancel it, or choose another run folder.",
                )
            self._cancel.unlink(missing_ok=True)
            yield

    def _locked(self) -> bool:
        try:
            with self._lock.open("r+b") as file:
                return not _try_lock(file)
        except OSError:
            return False


def event_line(kind: str, **values) -> str:
    """One event of the protocol as a line of JSON; ``time`` (seconds since 1970) is added."""
    return json.dumps({"event": kind, "time": round(time.time(), 3), **values}, ensure_ascii=False)


class Events:
    """Speaks the protocol: one JSON object a line, to ``events.jsonl`` and to a stream."""

    def __init__(self, folder: RunFolder, stream: IO[str] | None) -> None:
        self._stream = stream
        self._file = folder.events_file.open("a+b")
        self._file.seek(0, os.SEEK_END)
        if self._file.tell():
            self._file.seek(-1, os.SEEK_END)
            if self._file.read(1) != b"\n":  # a killed trainer's last line has no end
                self._file.write(b"\n")

    def __call__(self, kind: str, **values) -> None:
        """Writes one event."""
        line = event_line(kind, **values)
        if self._stream is not None:
            try:
                print(line, file=self._stream, flush=True)
            except OSError:  # the reader is gone; the run goes on without it
                self._stream = None
        self._file.write(line.encode() + b"\n")
        self._file.flush()

    def close(self) -> None:
        """Closes the file; nothing can be said after it."""
        self._file.close()


def _try_lock(file: IO[bytes]) -> bool:
    """Locks the open file for this process if nobody else has; released when it is closed."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
