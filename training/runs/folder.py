"""Run folders: paths, state and events, readable at any time. Imports no torch: Blender polls runs.

    run/  job.toml  events.jsonl  checkpoints/  levels/level_1.ply ..  bundle.ply  metrics.json
          levels.png (image of all levels from a held-out view)
          costs.png (plot of the costs measured to choose the levels' distances)
          model.npz (networks of a method that has them)
          views.json (views and photo sizes with which the run began)
          undistorted/ (photos without lens distortion, if the scene folder is read-only)
          triangulated/ (points of a scene without points, if the scene folder is read-only; parts of a
          divided run use those of the divided run)
          blocks/ (runs of the parts of a scene in cells, and their merged bundle)
          captured/ (COLMAP scene rendered from splats that have no photos)
          base.ply, cameras/ (splats and views that Blender exported for the run)
          trainer.log, trainer.out (output of a trainer that Blender or a worker started)
          lock  cancel  resume  reserve

A run folder can be moved. ``events.jsonl`` holds one JSON object per line, the same lines that the trainer
prints. A running trainer holds an operating-system lock on ``lock``, which ends with its process, and
stores the process's identity there.
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

from ..documents import read_json
from ..errors import LodgsError
from ..files import name_errors, open_regular, remove_temporaries, try_lock
from . import processes
from .events import read_events

_STARTED = time.time()
_STALE_SECONDS = 10.0
"""Cancel requests older than this at process start were meant for an earlier trainer."""
_LOG_TAIL = 1 << 16  # bytes
MAX_METRICS_BYTES = 1 << 24
"""Maximum size of metrics.json."""


class RunFolder:
    """Paths and state of a run."""

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
        self.sheet = self.path / "levels.png"
        self.log = self.path / "trainer.log"
        self.output = self.path / "trainer.out"
        self.views = self.path / "views.json"
        self.undistorted = self.path / "undistorted"
        self.triangulated = self.path / "triangulated"
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
        self._lock_file: IO[bytes] | None = None

    def create(self) -> None:
        """Create the folder and its subfolders; a finished run needs none for checkpoints.

        Raises:
            LodgsError: the folder cannot be written; or see ``reject_links``.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self.reject_links()
            self.levels_folder.mkdir(exist_ok=True)
            end = self.end_event()
            if end is None or end["event"] != "done" or not self.bundle.exists():
                self.checkpoints.mkdir(exist_ok=True)
        except OSError as error:
            raise LodgsError(
                f"Cannot create run folder {self.path}: {error.strerror}.",
                "Choose a writable folder.",
            ) from error

    def level_file(self, number: int) -> Path:
        """Return the path of a level's splats."""
        return self.levels_folder / f"level_{number}.ply"

    @property
    def points_cache(self) -> Path:
        """Cache of triangulated points if the scene folder is read-only; parts share the divided run's."""
        for parent in self.path.parents[:2]:
            divided = RunFolder(parent.parent)
            if parent == divided.blocks and divided.job.exists():
                return divided.triangulated
        return self.triangulated

    def reject_links(self) -> None:
        """Reject links in a run folder, which would redirect writes outside of it.

        Raises:
            LodgsError: one of the run's files is a link or a special file.
            OSError: the folder cannot be read.
        """
        paths = [path for path in vars(self).values() if isinstance(path, Path) and path != self.path]
        for folder in (self.checkpoints, self.levels_folder, self.cameras):
            if folder.is_dir() and not folder.is_symlink():
                paths += folder.iterdir()
        for path in paths:
            if os.path.lexists(path) and stat.S_IFMT(path.lstat().st_mode) not in (
                stat.S_IFREG,
                stat.S_IFDIR,
            ):
                raise LodgsError(
                    f"Cannot use run folder: {path} is a link or a special file.",
                    "Remove it, or choose another run folder.",
                )

    @property
    def started(self) -> bool:
        """True if training has started in this folder."""
        return self.events_file.exists() or any(self.checkpoints.glob("step_*.pt"))

    @property
    def has_results(self) -> bool:
        """True if the folder has more than the records of trainings that failed at their start."""
        records = {
            self.job, self.events_file, self.log, self.output, self.reserve, self.views, self._lock,
        }  # fmt: skip
        paths = self.path.iterdir() if self.path.is_dir() else ()
        return any(path not in records and (not path.is_dir() or any(path.iterdir())) for path in paths)

    # -- reading ---------------------------------------------------------------------------------------

    def events(self, since: int = 0) -> tuple[list[dict], int]:
        """Return the events after byte ``since`` and the offset for the next call, see ``runs.events``.

        Raises:
            LodgsError: the file is too large for the events of a run.
            OSError: the path is unreadable or not a file.
        """
        return read_events(self.events_file, since)

    def find_file(self, path: str) -> Path:
        """Return the file at a relative path given by an event or a checkpoint.

        Raises:
            LodgsError: the path does not exist, is not a file or leads out of the run folder.
        """
        file = self.path / path
        if not file.is_file() or not file.resolve().is_relative_to(self.path.resolve()):
            raise LodgsError(f"The run {self.path} has no file {path}.", "Resume the run, or train it again.")
        return file

    def last_event(self, *kinds: str) -> dict | None:
        """Return the newest event of these kinds, or None."""
        return next((e for e in reversed(self.events()[0]) if e["event"] in kinds), None)

    def end_event(self) -> dict | None:
        """Return the event that gives the state of a run without a trainer; None if it never started."""
        return self.last_event("hello", "error", "cancelled", "done")

    def levels(self) -> list[dict]:
        """Return the newest ``level`` event of each level, coarse to fine."""
        newest = {e["level"]: e for e in self.events()[0] if e["event"] == "level"}
        return [newest[level] for level in sorted(newest)]

    def read_metrics(self) -> dict:
        """Return the last evaluation of the bundle; {} if it is older than the bundle, missing or damaged."""
        with suppress(OSError, LodgsError):
            if self.metrics.stat().st_mtime >= self.bundle.stat().st_mtime:
                return read_json(self.metrics, max_bytes=MAX_METRICS_BYTES)
        return {}

    @property
    def running(self) -> bool:
        """True if a trainer is running in this folder."""
        try:
            try:
                file = open_regular(self._lock, writing=True)
            except OSError:  # another user's
                file = open_regular(self._lock)
            with file:
                return not try_lock(file)
        except OSError:
            return False

    def state(self) -> str:
        """Return the run's state.

        - ``empty``: not started
        - ``running``: a trainer is running
        - ``done``: finished
        - ``cancelled``: stopped on request, can be resumed
        - ``failed``: stopped with an ``error`` event, can be resumed once the cause is fixed
        - ``interrupted``: the trainer ended without an event (killed, power cut), can be resumed
        """
        if self.running:
            return "running"
        last = self.end_event()
        if last is None:
            return "interrupted" if self.job.exists() else "empty"
        return {"error": "failed", "cancelled": "cancelled", "done": "done"}.get(last["event"], "interrupted")

    def log_tail(self, lines: int = 20) -> str:
        """Return the last lines of the trainer's standard error."""
        try:
            with open_regular(self.log) as file:
                file.seek(max(file.seek(0, os.SEEK_END) - _LOG_TAIL, 0))
                text = file.read().decode("utf-8", "replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-lines:])

    # -- requests and locking --------------------------------------------------------------------------

    def request_cancel(self) -> None:
        """Ask the trainer to save and stop, which takes one or two steps."""
        self._cancel.touch()

    def take_cancel(self) -> bool:
        """Return whether a stop was requested since the last call, and clear the request."""
        return _take(self._cancel)

    def request_resume(self) -> None:
        """Ask the trainer of a scene in cells to resume this cancelled part."""
        self._resume.touch()

    def take_resume(self) -> bool:
        """Return whether resuming was requested since the last call, and clear the request."""
        return _take(self._resume)

    def kill(self) -> None:
        """Kill the trainer of this run if it is a process of this computer.

        Raises:
            LodgsError: the trainer is not identified as a process of this computer.
        """
        holder = self._holder() if self.running else {}
        pid, identity = holder.get("pid"), holder.get("identity")
        if type(pid) is not int or not isinstance(identity, str) or not processes.kill(pid, identity):
            raise LodgsError(
                f"Cannot kill the trainer of {self.path}: it is not a known process of this computer.",
                "Stop it on the computer that started it.",
            )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run's lock, and delete incomplete files of killed trainers. Used by the trainer.

        Raises:
            LodgsError: another trainer holds the lock.
            OSError: the lock cannot be written.
        """
        with self._lock.open("a+b", buffering=0) as file:
            for _ in range(10):  # reading the state holds the lock for a moment
                if try_lock(file):
                    break
                time.sleep(0.1)
            else:
                raise LodgsError(
                    f"Cannot train in {self.path}: another trainer is running there.",
                    "Wait for it, cancel it, or choose another run folder.",
                )
            holder = {"pid": os.getpid(), "identity": processes.identity(os.getpid())}
            file.truncate(0)
            with name_errors(self._lock):
                file.write(json.dumps(holder).encode())
            self._clean()
            self._lock_file = file
            try:
                yield
            finally:
                self._lock_file = None

    def require_lock(self) -> None:
        """Check that the folder was not moved and still contains the lock file. Used by the trainer.

        Raises:
            LodgsError: the folder or its lock file was moved or deleted.
        """
        assert self._lock_file is not None, "only within locked()"
        with suppress(OSError):
            if os.path.samestat(os.stat(self._lock), os.fstat(self._lock_file.fileno())):
                return
        raise LodgsError(
            f"Training stopped: the run folder {self.path} or its lock was moved or deleted.",
            "Resume the run in its new folder, or train it again.",
        )

    def _clean(self) -> None:
        for folder in (self.path, self.checkpoints, self.levels_folder):
            remove_temporaries(folder)
        self.reserve.unlink(missing_ok=True)
        for cache in (self.undistorted, self.triangulated):
            for temporary in cache.glob("*ing-*"):
                shutil.rmtree(temporary, ignore_errors=True)
        with suppress(FileNotFoundError):
            if self._cancel.stat().st_mtime < _STARTED - _STALE_SECONDS:
                self._cancel.unlink()

    def _holder(self) -> dict:
        """Return the trainer's process ID and identity from the lock file."""
        try:
            with open_regular(self._lock) as file:
                holder = json.loads(file.read(1000))
        except (OSError, ValueError):
            return {}
        return holder if isinstance(holder, dict) else {}


def find_splats(path: Path) -> Path:
    """Return the bundle of a finished run, or the path itself if it is not a run folder.

    Raises:
        LodgsError: the run is not finished.
    """
    run = RunFolder(path)
    if not run.job.exists():
        return path
    if not run.bundle.exists():
        raise LodgsError(
            f"Cannot read {path}: the run is not finished (no bundle.ply).", "Train it to the end."
        )
    return run.bundle


def _take(request: Path) -> bool:
    """Delete a request file; return whether it existed."""
    try:
        request.unlink()
    except FileNotFoundError:
        return False
    return True
