"""What Blender knows of the runs that it follows: a :class:`Watch` reads a run's events as they come.

Everything that must last is in the run's folder; a level of splats becomes an object as soon as its file is
there.
"""

from __future__ import annotations

import subprocess
import time
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import bpy

from ...training.errors import LodgsError
from ...training.lod.rules.cut import RULE as CUT
from ...training.runs.folder import RunFolder
from ...training.runs.outcome import run_outcome
from ...training.splats.bundle import Bundle, Level, read_header, read_tables
from ...training.splats.ply import read_ply
from .. import extension
from ..data import cells, scenes

UNRESPONSIVE_AFTER = 60.0
"""Seconds without an event after which the panel says that the trainer does not answer."""


@dataclass(frozen=True)
class Part:
    """What of a scene in cells is trained now: of the whole, or of one cell.

    Attributes:
        folder: of its run.
        number: of the cell; 0 for the whole.
        kind, state: as ``progress`` events have them (``BLOCK_KINDS``, ``BLOCK_STATES``); ``stopped`` with
            the run that it was trained by.
        share: how much is done, 0 to 1, of a cell with its borders.
    """

    folder: RunFolder
    number: int
    kind: str
    state: str
    share: float


@dataclass
class Watch:
    """What Blender knows of one run.

    Attributes:
        folder: the run's folder.
        root: ``session_uid`` of the scene root that receives the levels; it survives undo and renaming.
        process: the trainer, when this Blender started it.
        state: as ``RunFolder.state``.
        message: what the trainer is doing, or how the run ended.
        share: how much of that is done, 0 to 1.
        problem: why the run failed, as a sentence with its remedy; empty when it did not.
        progress: the newest ``progress`` event.
        blocks: how each part of a scene in cells gets on, as a ``progress`` event says; see :meth:`part`.
        levels: the newest ``level`` event of each level.
        summary: of a finished run the ``done`` event, with what it is worth.
        warnings: the warnings of this run.
        cancel_requested: whether it was asked to stop.
        stopping: kinds and cells' numbers of parts that were asked to stop by themselves.
        method: what it trains.
        last_event: when an event came last, in seconds since the epoch.
        offset: bytes of the run's events that have been read.
        reading: a finished tree that is larger than it may be in memory, while its top is read.
    """

    folder: RunFolder
    root: int
    process: subprocess.Popen | None = None
    state: str = "running"
    message: str = "Starting the trainer"
    share: float = 0.0
    problem: str = ""
    progress: dict = field(default_factory=dict)
    blocks: list[dict] = field(default_factory=list)
    levels: dict[int, dict] = field(default_factory=dict)
    summary: dict = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    cancel_requested: bool = False
    stopping: set[tuple[str, int]] = field(default_factory=set)
    method: str = ""
    last_event: float = field(default_factory=time.time)
    offset: int = 0
    reading: Future[scenes.SplatsFile] | None = None

    @property
    def running(self) -> bool:
        return self.state == "running"

    @property
    def unresponsive(self) -> bool:
        """Whether a running trainer has sent no event for :data:`UNRESPONSIVE_AFTER` seconds."""
        return self.running and time.time() - self.last_event > UNRESPONSIVE_AFTER

    @property
    def cells(self) -> int:
        """How many cells the run has, as far as it has said so."""
        return sum(each["kind"] == "block" for each in self.blocks)

    def part(self, number: int) -> Part | None:
        """What is trained of a cell now, or last; or with 0 of the whole scene, before its cells. None where
        nothing is known of such a part."""
        mine = [each for each in self.blocks if each["block"] == number]
        if not mine:
            return None
        now = next((each for each in mine if each["state"] != "done"), mine[-1])
        state = "stopped" if now["state"] == "running" and not self.running else now["state"]
        share = sum(each["step"] for each in mine) / max(sum(each["of"] for each in mine), 1)
        run = self.folder
        places = {"coarse": run.coarse, "block": run.blocks / str(number), "seam": run.seams / str(number)}
        return Part(RunFolder(places[now["kind"]]), number, now["kind"], state, min(share, 1.0))

    def step(self) -> bool:
        """Handle the events since the last step; return whether there may be more.

        A level becomes an object at once. Never raises: what goes wrong becomes ``problem``.
        """
        root = root_by_uid(self.root)
        if watches.get(self.root) is not self:
            return False
        if root is None:  # deleted or undone; redo finds the run again
            del watches[self.root]
            return False
        alive = True
        try:
            alive = self._alive()  # asked first: the events before the end are then read below
            events, self.offset = self.folder.events(self.offset)
            for event in events:
                self._handle_event(root, event)
            if self.reading is not None:
                self._place(root, self.reading)
                return True
            if not alive:
                self._set_end()
            if events or not alive:
                extension.redraw()
        except Exception as error:
            self.problem = self._trouble(error)
            if not alive:  # nothing will say how it ended
                self.state, self.message = "interrupted", "Stopped"
        return alive

    def _handle_event(self, root: bpy.types.Object, event: dict) -> None:
        self.last_event = time.time()
        try:
            self._apply(root, event)
        except Exception as error:  # the next events are worth as much without this one
            self.problem = self._trouble(error)

    def _trouble(self, error: Exception) -> str:
        if isinstance(error, LodgsError):
            return str(error)
        if isinstance(error, OSError):
            return f"The run folder {self.folder.path} cannot be read: {error.strerror or error}."
        traceback.print_exc()
        return f"What the trainer sent could not be shown: {error}."

    def _alive(self) -> bool:
        if self.process is not None and self.process.poll() is None:
            return True
        return self.folder.running

    def _apply(self, root: bpy.types.Object, event: dict) -> None:
        match event["event"]:
            case "hello":
                self.problem, self.message = "", "Reading the scene"
                self.method = event.get("method", "")
                self.warnings.clear()
            case "status":
                self.message, self.share = event["message"], _share(event)
            case "progress":
                event = _with_blocks(event, self.blocks)
                self.progress, self.message = event, event.get("stage", "").capitalize()
                self.share = _share(event)
                if "blocks" in event:
                    self._take_blocks(root, event["blocks"])
            case "warning":
                self.warnings.append(event["message"])
            case "level":
                self._add_level(root, event)
            case "done":
                self.summary = event
                self._finish(root)

    def _take_blocks(self, root: bpy.types.Object, blocks: list[dict]) -> None:
        self.blocks = blocks
        self.stopping &= {
            (each["kind"], each["block"]) for each in blocks if each["state"] in ("waiting", "running")
        }
        cells.require(root.lodgs.training, self.cells)

    def _add_level(self, root: bpy.types.Object, event: dict) -> None:
        if self._stays_in_file(root, event):
            self.levels[event["level"]] = event
            return
        level = self._read_level(event)
        with extension.in_window():
            if not root.lodgs.training.read:  # what is here is not this run's, and two never mix
                scenes.make_room(root, event["level"])
            if "meta" in event:
                scenes.set_bundle_facts(root, self._described(event))
            scenes.set_level(root, level)
            root.lodgs.training.read = self.offset
            if not event.get("more"):  # levels that come together are one step
                extension.undo_step(f"Level {event['level']}")
        self.levels[event["level"]] = event

    def _stays_in_file(self, root: bpy.types.Object, event: dict) -> bool:
        """Whether a level is of a tree larger than may be in memory, of which half are leaves."""
        return event.get("rule") == CUT.name and 2 * event["splats"] >= root.lodgs.stream.budget

    def _read_level(self, event: dict) -> Level:
        splats = read_ply(self.folder.find_file(event["path"]))
        return Level(event["level"], splats, event.get("facts", {}))

    def _described(self, event: dict) -> Bundle:
        """What a level's event says of all levels, without them."""
        return Bundle(
            self.method, [], event.get("rule", ""), event.get("scene_facts", {}),
            event.get("controls", {}), event.get("cumulative", False), event["meta"],
        )  # fmt: skip

    def _place(self, root: bpy.types.Object, reading: Future[scenes.SplatsFile]) -> None:
        """Shows a finished tree as soon as its top has been read."""
        if not reading.done():
            return
        self.reading = None
        try:
            with extension.in_window():
                scenes.refill(root, reading.result())
                root.lodgs.training.read = self.offset
                extension.undo_step("Training finished")
        except Exception as error:
            self.problem = self._trouble(error)

    def _finish(self, root: bpy.types.Object) -> None:
        if any(self._stays_in_file(root, event) for event in self.levels.values()):
            reader = ThreadPoolExecutor(1, "lodgs-run")
            self.reading = reader.submit(
                scenes.read_splats_file, self.folder.bundle, root.lodgs.stream.budget
            )
            reader.shutdown(wait=False)
            return
        head = read_header(self.folder.bundle)
        head.tables = read_tables(self.folder.bundle)
        with extension.in_window():
            there = {item.number for item in root.lodgs.levels if item.exists}
            for number in {level.number for level in head.levels} & self.levels.keys() - there:
                scenes.set_level(root, self._read_level(self.levels[number]))  # an undo took it away
            scenes.set_bundle_facts(root, head)
            scenes.set_tables(root, head.tables)
            root.lodgs.training.read = self.offset
            extension.undo_step("Training finished")

    def _set_end(self) -> None:
        """Say how the run ended."""
        code = None if self.process is None else self.process.poll()
        self.state, problem = run_outcome(self.folder, code)
        self.problem = problem or self.problem
        self.message = {
            "done": "Finished",
            "cancelled": "Cancelled; it can be resumed",
        }.get(self.state, "Stopped; it can be resumed")


def _share(event: dict) -> float:
    return min(event.get("step", 0) / max(event.get("of", 0), 1), 1.0)


watches: dict[int, Watch] = {}
"""The newest run of each scene root, by the root's ``session_uid``."""


def watch_of(root: bpy.types.Object | None) -> Watch | None:
    """The run of a scene root that this Blender follows or followed, for the panel."""
    return None if root is None else watches.get(root.session_uid)


def _with_blocks(event: dict, blocks: list[dict]) -> dict:
    """A ``progress`` event with how each part of a scene in cells was last, where it leaves that out."""
    return {"blocks": blocks, **event} if blocks else event


def begin(watch: Watch) -> Watch:
    """Follows a run from now on, with what is known of it already."""
    for event in watch.folder.events()[0]:
        if event["event"] == "progress":
            watch.progress = _with_blocks(event, watch.blocks)
            watch.blocks = watch.progress.get("blocks", watch.blocks)
        elif event["event"] == "level":
            watch.levels[event["level"]] = event
        elif event["event"] == "done":
            watch.summary = event
    watches[watch.root] = watch
    return watch


def root_by_uid(uid: int) -> bpy.types.Object | None:
    """The object of a ``session_uid``; None where it was deleted or undone."""
    return next((obj for obj in bpy.data.objects if obj.session_uid == uid), None)
