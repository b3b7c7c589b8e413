"""Trainings as Blender sees them: start, follow, cancel, resume and find again.

Everything that must last is in the run's folder; a :class:`Watch` is what Blender has read of it so far. A
run goes on when Blender closes, and is found again by its folder when the .blend is opened.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ..training.errors import LodgsError
from ..training.runs.folder import RunFolder
from ..training.runs.job import Job
from ..training.splats.bundle import Facts, Level, read_facts
from ..training.splats.ply import read_ply
from . import environment, extension, processes, scenes

if TYPE_CHECKING:
    from .properties import TrainingSettings

SILENCE = 60.0
"""Seconds without a word after which the panel says that the trainer does not answer."""


NUMBERS = {
    "progress": ("level", "levels", "step", "of", "loss", "psnr", "splats", "steps_per_s", "eta_s"),
    "level": ("level", "splats"),
}
"""What an event must hold as numbers to be shown."""

OUTPUT = "trainer.out"
"""File in the run's folder that takes the trainer's standard output, for what it says outside its events."""

LOG = "LODGS trainer log"
"""Name of the text block that shows a trainer's log."""


@dataclass
class Watch:
    """What Blender knows of one run.

    Attributes:
        folder: the run's folder.
        root: ``session_uid`` of the scene root that receives the levels; it survives undo and renaming.
        process: the trainer, when this Blender started it.
        state: as ``RunFolder.state``.
        message: what the trainer is doing, or how the run ended.
        problem: why the run failed, as a sentence with its remedy; empty when it did not.
        progress: the newest ``progress`` event.
        levels: the newest ``level`` event of each level.
        warnings: the warnings of this run.
        asked: whether it was asked to stop.
        method: what it trains.
    """

    folder: RunFolder
    root: int
    process: subprocess.Popen | None = None
    state: str = "running"
    message: str = "Starting the trainer"
    problem: str = ""
    progress: dict = field(default_factory=dict)
    levels: dict[int, dict] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    asked: bool = False
    method: str = ""
    heard: float = field(default_factory=time.time)
    read: int = 0

    @property
    def running(self) -> bool:
        return self.state == "running"

    @property
    def silent(self) -> bool:
        """Whether a running trainer has said nothing for :data:`SILENCE` seconds."""
        return self.running and time.time() - self.heard > SILENCE

    def step(self) -> bool:
        """Take what the trainer has said since the last step; return whether there may be more.

        A level becomes an object at once. Never raises: what goes wrong becomes ``problem``.
        """
        root = _object(self.root)
        if _watches.get(self.root) is not self:
            return False
        if root is None:  # deleted or undone; redo finds the run again
            del _watches[self.root]
            return False
        alive = True
        try:
            alive = self._alive()  # asked first: what was said before the end is then read below
            events, self.read = self.folder.events(self.read)
            for event in events:
                self._hear(root, event)
            if not alive:
                self._end()
            if events or not alive:
                processes.redraw()
        except OSError as error:
            self.problem = f"The run folder {self.folder.path} cannot be read: {error.strerror}."
        return alive

    def _hear(self, root: bpy.types.Object, event: dict) -> None:
        self.heard = time.time()
        if not _whole(event):
            self.problem = f"The trainer sent a '{event['event']}' that this version does not understand."
            return
        try:
            self._take(root, event)
        except LodgsError as error:
            self.problem = str(error)

    def _alive(self) -> bool:
        if self.process is not None and self.process.poll() is None:
            return True
        return self.folder.state() == "running"

    def _take(self, root: bpy.types.Object, event: dict) -> None:
        match event["event"]:
            case "hello":
                self.problem, self.message = "", "Reading the scene"
                self.method = str(event.get("method", ""))
                self.warnings.clear()
            case "status":
                self.message = str(event.get("message", ""))
            case "progress":
                self.progress, self.message = event, str(event.get("stage", "")).capitalize()
            case "warning":
                self.warnings.append(str(event.get("message", "")))
            case "level":
                self._add_level(root, event)
            case "done":
                self._finish(root)

    def _add_level(self, root: bpy.types.Object, event: dict) -> None:
        splats = read_ply(self.folder.path / str(event.get("path")))
        with _in_window():
            if event["level"] == 1 and not event.get("again"):
                scenes.remove_finer_levels(root)  # they are of an earlier run: two runs never mix
            if "meta" in event:
                facts = Facts(self.method, [], event["meta"], bool(event.get("cumulative")))
                scenes.set_bundle_facts(root, facts)
            scenes.set_level(root, Level(event["level"], splats, event.get("s_min")))
            root.lodgs.training.read = self.read
            if not event.get("more"):  # levels that come together are one step
                _undo_step(f"Level {event['level']}")
        self.levels[event["level"]] = event

    def _finish(self, root: bpy.types.Object) -> None:
        facts = read_facts(self.folder.bundle)
        with _in_window():
            scenes.set_bundle_facts(root, facts)
            root.lodgs.training.read = self.read
            _undo_step("Training finished")

    def _end(self) -> None:
        """Say how the run ended."""
        self.state = self.folder.state()
        code = None if self.process is None else self.process.poll()
        error = self.folder.last("error") if self.state == "failed" else None
        if code == 2 and error is None:  # it could not even open its run
            error = _last_said(self.folder.path / OUTPUT)
        if error:
            self.state = "failed"
            self.problem = f"{error.get('what', '')} {error.get('remedy', '')}".strip()
        elif self.state in {"interrupted", "empty"} or code not in {None, 0, 3}:
            self.state = "interrupted"
            self.problem = _death(code, self.folder.log_tail(1))
        self.message = {
            "done": "Finished",
            "cancelled": "Cancelled; it can be resumed",
        }.get(self.state, "Stopped; it can be resumed")


_watches: dict[int, Watch] = {}
"""The newest run of each scene root, by the root's ``session_uid``."""


def watch_of(root: bpy.types.Object | None) -> Watch | None:
    """The run of a scene root that this Blender follows or followed, for the panel."""
    return None if root is None else _watches.get(root.session_uid)


def run_folder(root: bpy.types.Object) -> RunFolder | None:
    """The folder of the root's newest run, whether or not it is followed."""
    run = root.lodgs.training.run
    return RunFolder(bpy.path.abspath(run)) if run else None


def start(root: bpy.types.Object, folder: str = "", parameters: dict | None = None) -> Watch:
    """Train a scene root with its settings (``root.lodgs.training``) in a new run folder.

    Args:
        root: a scene root that was imported from a COLMAP folder.
        folder: the run's folder; empty makes a new one where the settings say.
        parameters: further parameters of the method by name (``training.methods.parameters``).

    Raises:
        LodgsError: no trainer, no scene, an impossible setting, or a folder that is taken.
    """
    run = RunFolder(Path(bpy.path.abspath(folder)).resolve()) if folder else RunFolder(_new_folder(root))
    state = _state(run)
    if state == "running":
        raise LodgsError(
            f"Another training is already at work in {run.path}.",
            "Wait for it, cancel it, or choose another run folder.",
        )
    if state != "empty":
        raise LodgsError(
            f"{run.path} already holds a run.", "Choose another folder, or open it as a run and resume it."
        )
    job = make_job(root, run.path, parameters or {})
    root.lodgs.training.read = 0
    return _launch(root, run, job)


def resume(root: bpy.types.Object) -> Watch:
    """Go on with the root's newest run, with the settings that it was started with, on what trains now.

    Raises:
        LodgsError: there is no such run, or it is at work or finished.
    """
    run = run_folder(root)
    state = "empty" if run is None else _state(run)
    if run is None or state == "empty":
        raise LodgsError(f"'{root.name}' has no run to resume.", "Press Train, or open a run folder.")
    if state == "running":
        raise LodgsError(f"The run in {run.path} is already at work.", "Wait for it or cancel it.")
    if state == "done":
        raise LodgsError(f"The run in {run.path} is finished.", "Press Train for a new one.")
    job = Job.from_file(run.job)
    backend = extension.preferences().backend  # what this computer has, and what its user wants now
    return _launch(root, run, None if job.backend == backend else replace(job, backend=backend))


def start_or_resume(root: bpy.types.Object, folder: str, parameters: dict | None = None) -> Watch:
    """:func:`start`, or go on with what the same settings began: command lines are simply given again.

    A finished run is loaded.

    Raises:
        LodgsError: as theirs, or the run was begun with other settings.
    """
    run = RunFolder(Path(folder).resolve())
    state = _state(run)
    if state in {"empty", "running"}:
        return start(root, folder, parameters)
    before, now = Job.from_file(run.job).resolved(), make_job(root, run.path, parameters or {}).resolved()
    names = [f.name for f in fields(Job) if f.name != "backend"]
    changed = [name for name in names if getattr(before, name) != getattr(now, name)]
    if changed:
        raise LodgsError(
            f"The run in {run.path} was begun with other settings ({', '.join(changed)}).",
            "Give the same ones to go on with it, or choose another folder.",
        )
    if state == "done":
        return attach(root, folder)
    root.lodgs.training.read = 0
    _remember(root, run)
    return resume(root)


def cancel(root: bpy.types.Object) -> None:
    """Ask the trainer to save and stop; asked again, end it (it can be resumed from its last checkpoint).

    Raises:
        LodgsError: nothing is running.
    """
    watch = watch_of(root)
    if watch is None or not watch.running:
        raise LodgsError(f"No training of '{root.name}' is at work.")
    if not watch.asked:
        watch.asked = True
        watch.message = "Saving and stopping"
        try:
            watch.folder.request_cancel()
        except OSError as error:
            raise LodgsError(
                f"{watch.folder.path} cannot be written: {error.strerror}.",
                "Cancel again to end the trainer.",
            ) from error
    elif watch.process is not None:
        watch.process.kill()
    elif (hello := watch.folder.last("hello")) and watch.folder.state() == "running":
        with suppress(OSError):
            os.kill(int(hello["pid"]), signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL)
    processes.redraw()


def attach(root: bpy.types.Object, folder: str, *, again: bool = True) -> Watch:
    """Make the run in ``folder`` the root's own: load its levels, and follow it if it is at work.

    Args:
        root: the scene root.
        folder: a run's folder, also one that another Blender or a command line started.
        again: load every level; False only those that came since this .blend last saw the run.

    Raises:
        LodgsError: there is no run in the folder.
    """
    run = RunFolder(Path(bpy.path.abspath(folder)).resolve())
    if _state(run) == "empty":
        raise LodgsError(f"{run.path} holds no run.", "Choose a folder that has a job.toml in it.")
    if again:
        root.lodgs.training.read = 0
    _remember(root, run)
    return _watch(Watch(run, root.session_uid, read=root.lodgs.training.read))


def follow(watch: Watch, show: Callable[[Watch], None] | None = None) -> None:
    """Look after a run: by a timer in a window, here and now until it ends in background.

    Ctrl-C in background asks the trainer to save and stop, and waits for that.

    Args:
        watch: what :func:`start`, :func:`resume` or :func:`attach` returned.
        show: called after each look, to print progress.
    """

    def step() -> bool:
        more = watch.step()
        if show:
            show(watch)
        return more

    try:
        processes.follow(step)
    except KeyboardInterrupt:
        root = _object(watch.root)
        if root is not None and watch.running:
            cancel(root)
        processes.follow(step)


def log_text(root: bpy.types.Object) -> bpy.types.Text:
    """The end of the trainer's log, as a text block.

    Raises:
        LodgsError: there is no run, or it has written no log.
    """
    run = run_folder(root)
    tail = run.log_tail(200) if run else ""
    if not tail.strip():
        raise LodgsError("The trainer has written no log.")
    text = bpy.data.texts.get(LOG) or bpy.data.texts.new(LOG)
    text.from_string(tail)
    return text


def make_job(root: bpy.types.Object, out: Path, parameters: dict) -> Job:
    """The job that the root's settings describe.

    Raises:
        LodgsError: the root has no COLMAP folder, or a setting is impossible.
    """
    settings = root.lodgs.training
    if not root.lodgs.scene_folder:
        raise LodgsError(
            f"'{root.name}' was not imported from photographs, so there is nothing to train on.",
            "Import a COLMAP folder.",
        )
    values = {
        "scene": bpy.path.abspath(root.lodgs.scene_folder),
        "out": str(out),
        "model": bpy.path.abspath(settings.model),
        "images": bpy.path.abspath(settings.images),
        "method": settings.method,
        "preset": settings.preset,
        "seed": settings.seed,
        "test_every": settings.test_every,
        "image_scale": round(settings.image_scale, 4),
        "backend": extension.preferences().backend,
        "parameters": changes(settings) | parameters,
    }
    return Job.from_dict(values)


def changes(settings: TrainingSettings) -> dict:
    """The method's parameters that the panel changes from the preset's, by name."""
    return {name: value for name in offered(settings.method) if (value := getattr(settings, name))}


def offered(method: str) -> tuple[str, ...]:
    """The parameters of a method that the panel offers, beside the presets."""
    return {"3dgs": ("max_splats",), "flod": ("levels", "footprint", "max_splats")}.get(
        method, ("levels", "max_splats")
    )


def _launch(root: bpy.types.Object, run: RunFolder, job: Job | None) -> Watch:
    python = environment.trainer_python()
    environment.require(python)
    run.make()
    if job is not None:
        job.resolved().write(run.job)
    try:
        command = [str(python), "-m", "training", "train", str(run.job)]
        process = processes.spawn(command, log=run.log, output=run.path / OUTPUT)
    except OSError as error:
        raise LodgsError(
            f"The trainer's Python {python} cannot be started: {error.strerror or error}.",
            "Check it in the preferences of LODGS.",
        ) from error
    _remember(root, run)
    return _watch(Watch(run, root.session_uid, process=process, read=root.lodgs.training.read))


def _state(run: RunFolder) -> str:
    try:
        return run.state()
    except OSError as error:
        raise LodgsError(
            f"The run folder {run.path} cannot be read: {error.strerror}.", "Choose another folder."
        ) from error


def _watch(watch: Watch) -> Watch:
    """Begin to watch a run, with what is known of it already."""
    for event in watch.folder.events()[0]:
        if not _whole(event):
            continue
        if event["event"] == "progress":
            watch.progress = event
        elif event["event"] == "level":
            watch.levels[event["level"]] = event
    _watches[watch.root] = watch
    return watch


def _remember(root: bpy.types.Object, run: RunFolder) -> None:
    path = str(run.path)
    if bpy.data.is_saved:
        with suppress(ValueError):  # another drive
            path = bpy.path.relpath(path)
    root.lodgs.training.run = path


def _new_folder(root: bpy.types.Object) -> Path:
    """A folder for a run, not there yet: where the settings say, else beside the .blend or at home."""
    if root.lodgs.training.output:
        parent = Path(bpy.path.abspath(root.lodgs.training.output)).resolve()
    elif bpy.data.is_saved:
        parent = Path(bpy.path.abspath("//lodgs_runs"))
    else:
        parent = Path.home() / "lodgs_runs"
    name = bpy.path.clean_name(root.name)
    names = itertools.chain([name], (f"{name}-{n}" for n in itertools.count(2)))
    return next(parent / n for n in names if not (parent / n).exists())


def _last_said(output: Path) -> dict | None:
    """The ``error`` event that ends a trainer's standard output, if one does."""
    try:
        event = json.loads(output.read_bytes().splitlines()[-1])
    except (OSError, ValueError, IndexError):
        return None
    return event if isinstance(event, dict) and event.get("event") == "error" else None


def _whole(event: dict) -> bool:
    numbers = NUMBERS.get(str(event["event"]), ())
    return all(isinstance(event.get(name), int | float) for name in numbers)


def _death(code: int | None, last_line: str) -> str:
    """Why a trainer that said nothing has ended, as far as one can know."""
    if code is not None and code < 0:
        how = f"was killed (signal {-code}); often that means too little memory"
    elif code:
        how = f"stopped with exit code {code}"
    else:
        how = "stopped without a word: killed, or the computer was switched off"
    said = f" Its last words: {last_line.strip()}" if last_line.strip() else ""
    return f"The trainer {how}.{said}"


def _in_window():
    """A context with a window, which a timer lacks; as it is where there are none (in background)."""
    windows = bpy.context.window_manager.windows
    if bpy.context.window is not None or not windows:
        return nullcontext()
    return bpy.context.temp_override(window=windows[0])


def _undo_step(message: str) -> None:
    """Make what came by itself an undo step, so that undoing the user's next one does not take it away."""
    bpy.ops.ed.undo_push(message=message)


# -- finding runs again ------------------------------------------------------------------------------------


def _object(uid: int) -> bpy.types.Object | None:
    return next((thing for thing in bpy.data.objects if thing.session_uid == uid), None)


def find_again() -> None:
    """Attach to the run of every scene root that has one and is not watched: after loading, undo and redo."""
    for root in [thing for thing in bpy.data.objects if thing.lodgs.training.run]:
        if watch_of(root) is None:
            with suppress(LodgsError):  # the folder is gone: the panel says so
                watch = attach(root, root.lodgs.training.run, again=False)
                if bpy.app.background:
                    watch.step()  # what is there; waiting for more is not what opening a file is for
                else:
                    follow(watch)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    _watches.clear()
    find_again()


@bpy.app.handlers.persistent
def _on_undo(*_) -> None:
    for watch in list(_watches.values()):
        root = _object(watch.root)
        if root is not None and watch.running:
            _remember(root, watch.folder)  # undo must not lose a run
    find_again()


def register() -> None:
    handlers = bpy.app.handlers
    handlers.load_post.append(_on_load)
    handlers.undo_post.append(_on_undo)
    handlers.redo_post.append(_on_undo)


def unregister() -> None:
    handlers = bpy.app.handlers
    handlers.load_post.remove(_on_load)
    handlers.undo_post.remove(_on_undo)
    handlers.redo_post.remove(_on_undo)
    _watches.clear()
