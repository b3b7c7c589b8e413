"""A run's folder and what can be read from it, by anyone, at any time. No torch: Blender polls it.

    run/  job.toml  events.jsonl  checkpoints/  levels/level_1.ply ..  bundle.ply  metrics.json
          costs.png (what finding the distances of levels has told)
          model.npz (what a method with networks has beside its levels)
          undistorted/ (photographs without their lens's distortion, where the scene may not be written to)
          blocks/ (the runs of cells of a scene that is trained in cells, and what they are together)
      captured/ (the pictures of splats that had no photographs, as a COLMAP scene)
          base.ply, cameras/ (the splats, and the views of them, that Blender has handed over)
          trainer.log, trainer.out (what a trainer that Blender started printed)
          lock  cancel  resume  reserve

A run is its folder, wherever that lies. ``events.jsonl`` holds one JSON object a line, the same lines that
the trainer prints. While a trainer runs, it holds an operating-system lock on ``lock``, which vanishes with
its process however that ends, and says there which process it is.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from ..errors import LodgsError
from ..files import open_regular, remove_temporaries, try_lock
from . import processes
from .events import read_events

_BEGUN = time.time()
_LATE = 10.0
"""Seconds before this process: whoever cancelled earlier meant another one, that ended without hearing it."""
_LOG_TAIL = 1 << 16  # bytes


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
        self.costs = self.path / "costs.png"
        self.log = self.path / "trainer.log"
        self.output = self.path / "trainer.out"
        self.undistorted = self.path / "undistorted"
        self.captured = self.path / "captured"
        self.base = self.path / "base.ply"
        self.cameras = self.path / "cameras"
        self.blocks = self.path / "blocks"
        self.coarse = self.blocks / "coarse"
        self.seams = self.blocks / "seams"
        self.merged = self.blocks / "whole.ply"
        self.reserve = self.path / "reserve"
        self._lock = self.path / "lock"
        self._cancel = self.path / "cancel"
        self._resume = self.path / "resume"
        self._held: IO[bytes] | None = None

    def create(self) -> None:
        """Makes the folder and those inside it, to write there.

        Raises:
            LodgsError: if it cannot be written, or as ``reject_links``.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self.reject_links()
            for folder in (self.checkpoints, self.levels_folder):
                folder.mkdir(exist_ok=True)
        except OSError as error:
            raise LodgsError(
                f"The run folder {self.path} cannot be made: {error.strerror}.",
                "Choose a folder that you may write to.",
            ) from error

    def reject_links(self) -> None:
        """Makes sure that what is written here is written here: whoever sends a run may have put links in it.

        Raises:
            LodgsError: one of the run's files is a link or a special file.
            OSError: the folder cannot be read.
        """
        places = [place for place in vars(self).values() if isinstance(place, Path) and place != self.path]
        for folder in (self.checkpoints, self.levels_folder, self.cameras):
            if folder.is_dir() and not folder.is_symlink():
                places += folder.iterdir()
        for place in places:
            if os.path.lexists(place) and stat.S_IFMT(place.lstat().st_mode) not in (
                stat.S_IFREG,
                stat.S_IFDIR,
            ):
                raise LodgsError(
                    f"{place} is a link or a special file, which a run does not have.",
                    "Remove it, or choose another run folder.",
                )

    @property
    def started(self) -> bool:
        """Whether a trainer has been at work here."""
        return self.events_file.exists() or any(self.checkpoints.glob("step_*.pt"))

    # -- reading ---------------------------------------------------------------------------------------

    def events(self, since: int = 0) -> tuple[list[dict], int]:
        """The whole lines after byte ``since``, as objects, and the byte to go on from next time.

        What they look like, and what is passed over, is said in ``runs.events``.

        Raises:
            LodgsError: the file is too long to be a run's.
            OSError: it cannot be read, or is no file.
        """
        return read_events(self.events_file, since)

    def find_file(self, path: str) -> Path:
        """A file of the run by the path that an event or a checkpoint gives, relative to the run.

        Raises:
            LodgsError: it is not there, is no file, or does not lie in the run's folder.
        """
        place = self.path / path
        if not place.is_file() or not place.resolve().is_relative_to(self.path.resolve()):
            raise LodgsError(f"The run {self.path} holds no file {path}.", "Resume it, or train it anew.")
        return place

    def last_event(self, *kinds: str) -> dict | None:
        """The newest event of one of these kinds, or None."""
        return next((e for e in reversed(self.events()[0]) if e["event"] in kinds), None)

    def end_event(self) -> dict | None:
        """The event that tells how the run stands where no trainer is at work; None before the first one."""
        return self.last_event("hello", "error", "cancelled", "done")

    def levels(self) -> list[dict]:
        """The newest ``level`` event of each level, coarse to fine."""
        newest = {e["level"]: e for e in self.events()[0] if e["event"] == "level"}
        return [newest[level] for level in sorted(newest)]

    @property
    def running(self) -> bool:
        """Whether a trainer is at work here."""
        try:
            try:
                file = open_regular(self._lock, writing=True)
            except OSError:  # somebody else's
                file = open_regular(self._lock)
            with file:
                return not try_lock(file)
        except OSError:
            return False

    def state(self) -> str:
        """One of

        - ``empty``: nothing was started here
        - ``running``: a trainer is at work
        - ``done``: finished
        - ``cancelled``: stopped on request, can be resumed
        - ``failed``: stopped with an ``error`` event, can be resumed when its cause is gone
        - ``interrupted``: the trainer ended without a word (killed, power cut), can be resumed
        """
        if self.running:
            return "running"
        last = self.end_event()
        if last is None:
            return "interrupted" if self.job.exists() else "empty"
        return {"error": "failed", "cancelled": "cancelled", "done": "done"}.get(last["event"], "interrupted")

    def log_tail(self, lines: int = 20) -> str:
        """The last lines of what the trainer wrote outside the protocol (its standard error)."""
        try:
            with open_regular(self.log) as file:
                file.seek(max(file.seek(0, os.SEEK_END) - _LOG_TAIL, 0))
                text = file.read().decode("utf-8", "replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-lines:])

    # -- asking and holding ----------------------------------------------------------------------------

    def request_cancel(self) -> None:
        """Asks the trainer to save and stop; it does so within a step or two."""
        self._cancel.touch()

    def take_cancel(self) -> bool:
        """For the trainer, and for who starts one: whether it was asked to stop since the last call."""
        return _take(self._cancel)

    def request_resume(self) -> None:
        """Asks whoever trains the blocks of a scene to go on with this one, which was stopped."""
        self._resume.touch()

    def take_resume(self) -> bool:
        """Whether that was asked since the last call."""
        return _take(self._resume)

    def kill(self) -> None:
        """Ends the trainer that is at work here by force, if it is a process of this computer.

        Raises:
            LodgsError: it is not, or nothing tells.
        """
        holder = self._holder() if self.running else {}
        pid, identity = holder.get("pid"), holder.get("identity")
        if type(pid) is not int or not isinstance(identity, str) or not processes.kill(pid, identity):
            raise LodgsError(
                f"The trainer in {self.path} cannot be ended from here: it is not known as a process of this "
                "computer.",
                "End it where it was started.",
            )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """For the trainer: holds the run's lock, and removes what killed trainers left half-done.

        Raises:
            LodgsError: if another trainer holds it.
            OSError: if it cannot be written.
        """
        with self._lock.open("a+b", buffering=0) as file:
            for _ in range(10):  # somebody who asks for the state holds the lock for an instant
                if try_lock(file):
                    break
                time.sleep(0.1)
            else:
                raise LodgsError(
                    f"Another training is already at work in {self.path}.",
                    "Wait for it, cancel it, or choose another run folder.",
                )
            file.truncate(0)
            file.write(json.dumps({"pid": os.getpid(), "identity": processes.identity(os.getpid())}).encode())
            self._clean()
            self._held = file
            try:
                yield
            finally:
                self._held = None

    def require_lock(self) -> None:
        """For the trainer: makes sure that the folder is still where it was, and its own.

        Raises:
            LodgsError: it was moved or deleted, or its lock was.
        """
        assert self._held is not None, "only within locked()"
        with suppress(OSError):
            if os.path.samestat(os.stat(self._lock), os.fstat(self._held.fileno())):
                return
        raise LodgsError(
            f"The run folder {self.path} was moved or deleted, or its lock was, while it was trained.",
            "Resume the run where it lies now, or train it anew.",
        )

    def _clean(self) -> None:
        for folder in (self.path, self.checkpoints, self.levels_folder):
            remove_temporaries(folder)
        self.reserve.unlink(missing_ok=True)
        for left in self.undistorted.glob("undistorting-*"):
            shutil.rmtree(left, ignore_errors=True)
        with suppress(FileNotFoundError):
            if self._cancel.stat().st_mtime < _BEGUN - _LATE:
                self._cancel.unlink()

    def _holder(self) -> dict:
        """What the trainer says of itself in the lock."""
        try:
            with open_regular(self._lock) as file:
                holder = json.loads(file.read(1000))
        except (OSError, ValueError):
            return {}
        return holder if isinstance(holder, dict) else {}


def _take(request: Path) -> bool:
    """Whether a request was there, which it is not any more."""
    try:
        request.unlink()
    except FileNotFoundError:
        return False
    return True
