"""Train the parts of a divided run on any workers, and merge them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path

from ...errors import LodgsError, error_cause
from ..failures import BAD_INPUT, CANCELLED, DONE
from ..outcome import run_outcome
from .merge import merge, write_surroundings
from .plan import CELL, Division, Part
from .workers import Pending, Submit

POLL_SECONDS = 0.5
"""Seconds between checks of the parts' progress."""
MAX_PROGRESS_SECONDS = 20.0
"""Maximum seconds between ``progress`` events."""
START_SECONDS = 10.0
"""Seconds in which a worker starts a submitted part and can then be asked to stop."""
MAX_ATTEMPTS = 3
"""Number of lost trainers of a part without progress before the run fails."""

Report = Callable[..., object]
"""Called with an event's kind and values."""


class CellsStopped(Exception):
    """Some parts were cancelled, as listed in the message; all others are finished."""


def prepare_part(division: Division, part: Part) -> None:
    """Write the base of a part from the finished parts of earlier stages.

    Raises:
        LodgsError: a required part is not finished, or the disk is full.
    """
    if part.region is not None and part.region.seam:
        write_surroundings(division, part)


def train_cells(division: Division, path: Path, submit: Submit, report: Report) -> None:
    """Train all unfinished parts, stage by stage, and write the merged bundle.

    Progress is read from the run folders of the parts. An interrupt first stops all parts cleanly. A part
    that was cancelled resumes on request (``RunFolder.request_resume``). If the request precedes this call,
    only the requested parts of its kind are trained.

    Args:
        division: the parts.
        path: merged bundle to write.
        submit: starts the training of a part.
        report: called with events.

    Raises:
        CellsStopped: single parts were cancelled.
        LodgsError: a part could not be trained.
    """
    if path.exists():
        return
    stages = [[_PartWatch(part, division) for part in stage] for stage in division.stages]
    watches = [watch for stage in stages for watch in stage]
    requested = [watch.part for watch in watches if watch.part.folder.take_resume()]
    kinds = {part.kind for part in requested}
    for watch in watches:
        if watch.code is None and watch.part not in requested and watch.part.kind in kinds:
            watch.code = CANCELLED
    for stage in stages:
        _train_stage(stage, watches, submit, report)
    report("status", message=f"Merging {len(division.cells)} cells")
    counts = merge(division, path)
    for seam in division.seams:
        seam.folder.base.unlink(missing_ok=True)
    for cell, (inside, total) in zip(division.cells, counts, strict=True):
        report("status", message=f"Cell {cell.number}: keeps {inside:,} of {total:,} splats, those inside")


def _train_stage(
    stage: Sequence[_PartWatch], watches: Sequence[_PartWatch], submit: Submit, report: Report
) -> None:
    """Train the parts of a stage in parallel and report the progress of all parts.

    Raises:
        CellsStopped: some parts were cancelled; the others are finished.
        LodgsError: a part could not be trained.
    """
    try:
        for watch in stage:
            watch.start(submit)
        started = last_report = last_part_report = time.monotonic()
        states: list[str] = []
        while not all([watch.poll(submit) for watch in stage]):
            now = time.monotonic()
            if now - last_report >= min(max((now - started) / 1000, POLL_SECONDS), MAX_PROGRESS_SECONDS):
                values = _progress(watches)
                last_report = now
                changed = states != (states := [watch.state for watch in watches])
                if changed or now - last_part_report >= (now - started) / 30:  # many parts are long lines
                    last_part_report = now
                else:
                    del values["blocks"]
                report("progress", **values)
            time.sleep(POLL_SECONDS)
    except BaseException:
        _stop_stage(stage)
        raise
    if stage:
        report("progress", **_progress(watches))
    for watch in stage:
        if watch.code not in (DONE, CANCELLED):
            raise watch.error()
    if stopped := [watch.part.name for watch in stage if watch.code == CANCELLED]:
        raise CellsStopped(f"Stopped: {', '.join(stopped)}. The run can be resumed.")


def _stop_stage(stage: Sequence[_PartWatch]) -> None:
    """Cancel all parts: running trainers save first, submitted ones do not start."""
    unfinished = [watch for watch in stage if not watch.finished]
    for watch in unfinished:
        watch.part.folder.request_cancel()
    deadline = time.monotonic() + START_SECONDS
    while not all(watch.finished for watch in unfinished):
        time.sleep(POLL_SECONDS)
        if time.monotonic() > deadline:
            for watch in unfinished:
                watch.abandon()
    for watch in unfinished:
        watch.part.folder.take_cancel()  # no trainer has consumed it


class _PartWatch:
    """A submitted part and its progress.

    Attributes:
        code: exit code of the last trainer; None while training continues or is retried.
    """

    def __init__(self, part: Part, division: Division) -> None:
        self.part = part
        self._division = division
        part.folder.take_cancel()  # meant for an earlier trainer
        self._pending: Pending | None = None
        self.code: int | None = None
        if part.folder.bundle.exists() and part.folder.state() == "done":
            self.code = DONE
        self._attempts = 0
        self._last_step = -1
        self.progress = part.folder.last_event("progress") or {}
        self._offset = part.folder.events()[1]
        self._started = False
        self.steps = part.job.resolved_parameters().total_steps
        self._worker_error = ""
        self._start_error: LodgsError | None = None

    def start(self, submit: Submit) -> None:
        """Submit the part unless it is finished."""
        if self.code is None:
            prepare_part(self._division, self.part)
            self._started = False
            self._pending = submit(self.part.folder.path)

    def abandon(self) -> None:
        """Cancel the submission if no worker has started it."""
        if self._pending is not None:
            self._pending.cancel()

    @property
    def finished(self) -> bool:
        """True if no trainer is running, not even one whose worker was lost."""
        return self._pending is None or (self._pending.done() and not self.part.folder.running)

    def poll(self, submit: Submit) -> bool:
        """Read progress; restart after a lost worker or on a resume request; return whether it has ended."""
        if self.code == CANCELLED and self.part.folder.take_resume():
            self.code = None
            self.start(submit)
        if self.code is not None:
            return True
        events, self._offset = self.part.folder.events(self._offset)
        for event in events:
            self._started = True
            if event["event"] == "progress":
                self.progress = event
        assert self._pending is not None
        if not self._pending.done():
            return False
        try:
            code = self._pending.result()
        except CancelledError:  # the scheduler and its workers were lost; the trainer may still run
            self.start(submit)
            return False
        except LodgsError as error:  # no worker can start it
            self._start_error, code = error, BAD_INPUT
        except Exception as error:  # the worker failed, not the trainer
            code = -1
            self._worker_error = str(error)
        if code in (DONE, BAD_INPUT, CANCELLED):
            self.code = code
            return True
        self._attempts = self._attempts + 1 if self.step <= self._last_step else 1
        self._last_step = max(self.step, self._last_step)
        if self._attempts < MAX_ATTEMPTS:
            self.start(submit)
            return False
        self.code = code
        return True

    @property
    def step(self) -> int:
        """Number of completed steps."""
        return self.steps if self.code == DONE else self.progress.get("step", 0)

    @property
    def state(self) -> str:
        """``waiting``, ``running``, ``done``, ``cancelled`` or ``failed``."""
        if self.code is None:
            return "running" if self._started else "waiting"
        return {DONE: "done", CANCELLED: "cancelled"}.get(self.code, "failed")

    def error(self) -> LodgsError:
        """Return the reason for the failure."""
        if self._start_error is not None:
            error = self._start_error
            return LodgsError(f"{self._name}: {error.what}", error.remedy, error_cause(error))
        if self.code == BAD_INPUT:
            end = self.part.folder.end_event()
            if end is not None and end["event"] == "error":
                return LodgsError(f"{self._name}: {end['what']}", end.get("remedy", ""), end.get("cause"))
            return LodgsError(f"{self._name}: {run_outcome(self.part.folder, self.code)[1]}")
        reason = f" ({self._worker_error})" if self._worker_error else ""
        return LodgsError(
            f"The trainer of {self.part.name} was lost {MAX_ATTEMPTS} times at step {self.step}{reason}.",
            f"Read its log, {self.part.folder.log}.",
        )

    @property
    def _name(self) -> str:
        return self.part.name[0].upper() + self.part.name[1:]


def _progress(watches: Sequence[_PartWatch]) -> dict:
    """Return the values of a ``progress`` event for all parts together, with the state of each."""
    reports = [watch.progress for watch in watches if watch.progress]
    step = sum(watch.step for watch in watches)
    steps = sum(watch.steps for watch in watches)
    speed = sum(watch.progress.get("steps_per_s", 0.0) for watch in watches if watch.code is None)
    cells = [watch for watch in watches if watch.part.kind == CELL]
    done = sum(watch.code == DONE for watch in cells)

    def mean(name: str) -> float:
        return round(sum(report.get(name, 0.0) for report in reports) / max(len(reports), 1), 5)

    return {
        "stage": f"{done} of {len(cells)} cells", "level": 1, "levels": 1, "step": step, "of": steps,
        "loss": mean("loss"), "psnr": mean("psnr"),
        "splats": sum(report.get("splats", 0) for report in reports),
        "steps_per_s": round(speed, 2), "eta_s": round((steps - step) / speed, 1) if speed else 0.0,
        "blocks": [
            {
                "block": watch.part.number, "kind": watch.part.kind, "state": watch.state,
                "step": watch.step, "of": watch.steps,
            }
            for watch in watches
        ],
    }  # fmt: skip
