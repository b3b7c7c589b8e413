"""Observation of training runs: a :class:`Watch` reads the events of a run and updates the scene.

A level of splats becomes an object as soon as its file exists. All permanent data is in the run folder.
"""

from __future__ import annotations

import subprocess
import time
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import bpy

from ...training.errors import LodgsError
from ...training.lod.rule import resolve_rule
from ...training.runs.folder import RunFolder
from ...training.runs.outcome import run_outcome
from ...training.splats.bundle import read_header, read_tables
from ...training.splats.levels import Bundle, Level
from ...training.splats.ply import read_ply
from .. import extension
from ..data import cells, importing, scenes
from . import notices

UNRESPONSIVE_AFTER = 60.0
"""Seconds without an event after which the panel reports that the trainer does not respond."""

IN_USE = "Another program already trains this run. Its progress and levels appear here."
"""Warning of a Blender whose own trainer was refused."""


@dataclass(frozen=True)
class RunPart:
    """Training state of one cell of a scene, or of the coarse levels that all cells share.

    Attributes:
        folder: run folder of the part.
        number: number of the cell, or 0 for the coarse levels.
        kind: current kind of training, one of ``PART_KINDS`` of ``progress`` events.
        state: one of ``PART_STATES``, or ``stopped`` if the run was stopped during this part.
        fraction: progress including border steps, 0 to 1.
    """

    folder: RunFolder
    number: int
    kind: str
    state: str
    fraction: float


@dataclass
class Watch:
    """State of one run, read from its events.

    Attributes:
        folder: run folder.
        root: ``session_uid`` of the scene root that receives the levels. It survives undo and renaming.
        process: trainer process, if this Blender started it.
        state: see ``RunFolder.state``.
        message: current step of the trainer, or the end of the run.
        fraction: progress of the current step, 0 to 1.
        problem: reason of a failure with its remedy. Empty otherwise.
        progress: newest ``progress`` event.
        parts: state of each part of a scene in cells, from ``progress`` events. See :meth:`part`.
        levels: newest ``level`` event of each level.
        summary: ``done`` event of a finished run, with its quality.
        warnings: warnings of the run.
        view_warnings: those of them that Blender added, such as those about exported views.
        cancel_requested: whether the run was asked to stop.
        stopping: (kind, cell number) of parts that were asked to stop.
        method: name of the trained method.
        last_event: time of the last event, in seconds since the epoch.
        offset: number of bytes read from the event file.
        reading: coarsest splats of a finished run, being read. Set only if it does not fit into memory.
    """

    folder: RunFolder
    root: int
    process: subprocess.Popen | None = None
    state: str = "running"
    message: str = "Starting the trainer"
    fraction: float = 0.0
    problem: str = ""
    progress: dict = field(default_factory=dict)
    parts: list[dict] = field(default_factory=list)
    levels: dict[int, dict] = field(default_factory=dict)
    summary: dict = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    view_warnings: list[str] = field(default_factory=list)
    cancel_requested: bool = False
    stopping: set[tuple[str, int]] = field(default_factory=set)
    method: str = ""
    last_event: float = field(default_factory=time.time)
    offset: int = 0
    reading: Future[importing.SplatsFile] | None = None

    @property
    def running(self) -> bool:
        return self.state == "running"

    @property
    def unresponsive(self) -> bool:
        """Return whether a running trainer has sent no event for :data:`UNRESPONSIVE_AFTER` seconds."""
        return self.running and time.time() - self.last_event > UNRESPONSIVE_AFTER

    @property
    def cells(self) -> int:
        """Return the number of cells, or 0 if the run has not reported it yet."""
        return sum(part["kind"] == "block" for part in self.parts)

    def part(self, number: int) -> RunPart | None:
        """Return the current or last training of a cell, or of the coarse levels (number 0).

        None if the run has not reported this part.
        """
        parts = [part for part in self.parts if part["block"] == number]
        if not parts:
            return None
        current = next((part for part in parts if part["state"] != "done"), parts[-1])
        state = "stopped" if current["state"] == "running" and not self.running else current["state"]
        fraction = sum(part["step"] for part in parts) / max(sum(part["of"] for part in parts), 1)
        run = self.folder
        paths = {"coarse": run.coarse, "block": run.blocks / str(number), "seam": run.seams / str(number)}
        path = paths[current["kind"]]
        return RunPart(RunFolder(path), number, current["kind"], state, min(fraction, 1.0))

    def step(self) -> bool:
        """Handle the new events. Return whether more may come.

        This method never raises: errors become ``problem``.
        """
        root = root_by_uid(self.root)
        if watches.get(self.root) is not self:
            return False
        if root is None:  # deleted or undone; redo attaches to the run again
            del watches[self.root]
            return False
        alive = True
        try:
            alive = self._alive()  # before reading, so that the last events are not missed
            events, self.offset = self.folder.events(self.offset)
            for event in events:
                self._handle_event(root, event)
            if self.reading is not None:
                self._show_coarsest(root, self.reading)
                return True
            if not alive:
                self._set_end()
                if self.process is not None:  # this Blender started it
                    notices.notify(f"{root.name}: {self.problem or self.message}")
            if events or not alive:
                extension.redraw()
        except Exception as error:
            self.problem = self._describe(error)
            if not alive:
                self.state, self.message = "interrupted", "Stopped"
        return alive

    def _handle_event(self, root: bpy.types.Object, event: dict) -> None:
        self.last_event = time.time()
        try:
            self._apply(root, event)
        except Exception as error:  # continue with the next events
            self.problem = self._describe(error)

    def _describe(self, error: Exception) -> str:
        if isinstance(error, LodgsError):
            return str(error)
        if isinstance(error, OSError):
            return f"Cannot read the run folder {self.folder.path}: {error.strerror or error}."
        traceback.print_exc()
        return f"Cannot show the trainer's output: {error}."

    def _alive(self) -> bool:
        if self.process is not None and self.process.poll() is None:
            return True
        running = self.folder.running
        if running and self.process is not None and self.process.returncode == 2:
            self.process = None  # both started at once: another program's trainer has the run's lock
            self.view_warnings.append(IN_USE)
            self.warnings.append(IN_USE)
        return running

    def _apply(self, root: bpy.types.Object, event: dict) -> None:
        match event["event"]:
            case "hello":
                self.problem, self.message = "", "Reading the scene"
                self.method = event.get("method", "")
                self.warnings = list(self.view_warnings)
            case "status":
                self.message = event["message"]
                self.fraction = _fraction(event)
            case "progress":
                event = _with_parts(event, self.parts)
                self.progress = event
                self.message = event.get("stage", "").capitalize()
                self.fraction = _fraction(event)
                if "blocks" in event:
                    self._set_parts(root, event["blocks"])
            case "warning":
                self.warnings.append(event["message"])
            case "level":
                self._add_level(root, event)
            case "done":
                self.summary = event
                self._finish(root)

    def _set_parts(self, root: bpy.types.Object, parts: list[dict]) -> None:
        self.parts = parts
        self.stopping &= {
            (part["kind"], part["block"]) for part in parts if part["state"] in ("waiting", "running")
        }
        cells.resize_cells(root.lodgs.training, self.cells)

    def _add_level(self, root: bpy.types.Object, event: dict) -> None:
        if self._stays_in_file(root, event):
            self.levels[event["level"]] = event
            return
        level = self._read_level(event)
        with extension.in_window():
            if not root.lodgs.training.read:  # never mix levels of two runs
                scenes.prepare_refill(root, [event["level"]])
            if "meta" in event:
                scenes.set_bundle_facts(root, self._bundle_facts(event))
            scenes.set_level(root, level)
            root.lodgs.training.read = self.offset
            if not event.get("more"):  # levels that arrive together are one undo step
                extension.undo_step(f"Level {event['level']}")
        self.levels[event["level"]] = event

    def _stays_in_file(self, root: bpy.types.Object, event: dict) -> bool:
        """Return whether a level's scene exceeds the memory budget and is read in pages."""
        rule = resolve_rule(event.get("rule", ""))
        return rule.exceeds_budget(event["splats"], root.lodgs.stream.budget)

    def _read_level(self, event: dict) -> Level:
        splats = read_ply(self.folder.find_file(event["path"]))
        return Level(event["level"], splats, event.get("facts", {}))

    def _bundle_facts(self, event: dict) -> Bundle:
        """Return the facts of a ``level`` event as a bundle without levels."""
        return Bundle(
            self.method, [], event.get("rule", ""), event.get("scene_facts", {}),
            event.get("controls", {}), event.get("cumulative", False), event["meta"],
        )  # fmt: skip

    def _show_coarsest(self, root: bpy.types.Object, reading: Future[importing.SplatsFile]) -> None:
        """Show the coarsest splats of a finished run when they have been read."""
        if not reading.done():
            return
        self.reading = None
        try:
            with extension.in_window():
                importing.refill(root, reading.result())
                root.lodgs.training.read = self.offset
                extension.undo_step("Training finished")
        except Exception as error:
            self.problem = self._describe(error)

    def _finish(self, root: bpy.types.Object) -> None:
        if any(self._stays_in_file(root, event) for event in self.levels.values()):
            reader = ThreadPoolExecutor(1, "lodgs-run")
            self.reading = reader.submit(
                importing.read_splats_file, self.folder.bundle, root.lodgs.stream.budget
            )
            reader.shutdown(wait=False)
            return
        head = read_header(self.folder.bundle)
        head.tables = read_tables(self.folder.bundle)
        with extension.in_window():
            existing = {item.number for item in root.lodgs.existing_levels}
            for number in {level.number for level in head.levels} & self.levels.keys() - existing:
                scenes.set_level(root, self._read_level(self.levels[number]))  # removed by an undo
            scenes.set_bundle_facts(root, head)
            scenes.set_tables(root, head.tables)
            root.lodgs.training.read = self.offset
            extension.undo_step("Training finished")

    def _set_end(self) -> None:
        """Set the state, message and problem of a run that has ended."""
        code = None if self.process is None else self.process.poll()
        if self.cancel_requested:
            with suppress(OSError):
                self.folder.take_cancel()  # a request that came too late
        self.state, problem = run_outcome(self.folder, code)
        self.problem = problem or self.problem
        self.message = {
            "done": "Finished",
            "cancelled": "Cancelled; can be resumed",
        }.get(self.state, "Stopped; can be resumed")


def _fraction(event: dict) -> float:
    return min(event.get("step", 0) / max(event.get("of", 0), 1), 1.0)


watches: dict[int, Watch] = {}
"""Newest run of each scene root by its ``session_uid``."""


def watch_of(root: bpy.types.Object | None) -> Watch | None:
    """Return the watch of a scene root, including a finished one."""
    return None if root is None else watches.get(root.session_uid)


def _with_parts(event: dict, parts: list[dict]) -> dict:
    """Add the last known state of each part to a ``progress`` event without it."""
    return {"blocks": parts, **event} if parts else event


def start_watching(watch: Watch) -> Watch:
    """Register a watch for its root, with the progress, levels and summary from past events."""
    for event in watch.folder.events()[0]:
        if event["event"] == "progress":
            watch.progress = _with_parts(event, watch.parts)
            watch.parts = watch.progress.get("blocks", watch.parts)
        elif event["event"] == "level":
            watch.levels[event["level"]] = event
        elif event["event"] == "done":
            watch.summary = event
    watches[watch.root] = watch
    return watch


def root_by_uid(uid: int) -> bpy.types.Object | None:
    """Return the object of a ``session_uid``, or None if it was deleted or undone."""
    return next((obj for obj in bpy.data.objects if obj.session_uid == uid), None)
