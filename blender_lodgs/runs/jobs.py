"""Training runs from Blender: start, follow, cancel, resume and attach.

A run continues when Blender's window closes. Opening the .blend file attaches to it again by its folder. In
background, the trainer saves and stops when Blender ends.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import bpy

from ...training.errors import LodgsError, system_reason
from ...training.lod.selection import complete_splats
from ...training.runs.folder import RunFolder
from ...training.runs.job import CHANGEABLE, Job
from ...training.scenes.cameras import Camera, write_camera
from ...training.splats.bundle import write_bundle
from ...training.splats.levels import Bundle
from .. import extension
from ..data import cells, roots, scenes, viewpoints
from ..data.paths import absolute_path, automatic_path
from . import environment, processes
from .job_settings import make_job
from .run_folders import link_run, new_run_folder, run_folder, run_state
from .watch import Watch, root_by_uid, start_watching, watch_of, watches


def start(root: bpy.types.Object, folder: str = "", parameters: dict | None = None) -> Watch:
    """Train a scene root with its settings (``root.lodgs.training``) in a new run folder.

    Args:
        root: scene root with photos, or with splats only. Splats only are exported to the run, with the views
            that the settings define.
        folder: run folder. Empty for a new folder in the location of the settings.
        parameters: additional method parameters by name (``training.optimize.parameters``).

    Raises:
        LodgsError: the trainer is missing, a setting is invalid, or the folder is in use.
    """
    run = RunFolder(absolute_path(folder).resolve()) if folder else RunFolder(new_run_folder(root))
    return _start(root, run, make_job(root, run.path, parameters or {}))


def _start(root: bpy.types.Object, run: RunFolder, job: Job) -> Watch:
    watch = watch_of(root)
    state = run_state(run)
    if watch is not None and watch.running:
        raise LodgsError(
            f"Cannot train '{root.name}': it is already being trained.", "Wait for the training or cancel it."
        )
    if state == "running":
        raise LodgsError(
            f"Cannot train in {run.path}: another training is running there.",
            "Wait for it, cancel it, or choose another run folder.",
        )
    if state != "empty":
        raise LodgsError(
            f"Cannot train in {run.path}: the folder contains a run.",
            "Choose another folder, or open this run and resume it.",
        )
    root.lodgs.training.read = 0
    return _launch(root, run, job, write_job=True, export=Path(job.base) == run.base)


def resume(root: bpy.types.Object) -> Watch:
    """Resume the root's newest run with its own settings, on the training device of the preferences.

    Raises:
        LodgsError: the root has no run, or the run is running or finished.
    """
    run = run_folder(root)
    state = "empty" if run is None else run_state(run)
    if run is None or state == "empty":
        raise LodgsError(
            f"Cannot resume the training: '{root.name}' has no run.", "Press Train, or open a run folder."
        )
    if state == "running":
        raise LodgsError(f"Cannot resume the run in {run.path}: it is running.", "Wait for it or cancel it.")
    if state == "done":
        raise LodgsError(
            f"Cannot resume the run in {run.path}: it is finished.", "Press Train for a new run."
        )
    return _resume(root, run)


def _resume(root: bpy.types.Object, run: RunFolder) -> Watch:
    job = replace(Job.from_file(run.job), out=str(run.path))
    backend = extension.preferences().backend  # the run may come from another computer
    return _launch(root, run, replace(job, backend=backend), write_job=job.backend != backend)


def start_or_resume(root: bpy.types.Object, job: Job) -> Watch:
    """Start a job, or resume its run, so that a command can be repeated. A finished run is loaded.

    Raises:
        LodgsError: see :func:`start` and :func:`resume`, or the run has other settings.
    """
    run = RunFolder(Path(job.out))
    state = run_state(run)
    if state in {"empty", "running"}:
        return _start(root, run, job)
    previous = Job.from_file(run.job).resolved()
    current = job.resolved()
    names = [f.name for f in fields(Job) if f.name not in CHANGEABLE]
    changed = [name for name in names if getattr(previous, name) != getattr(current, name)]
    if changed:
        raise LodgsError(
            f"Cannot resume the run in {run.path}: these settings have changed: {', '.join(changed)}.",
            "Use the same settings, or choose another folder.",
        )
    if state == "done":
        return attach(root, job.out)
    root.lodgs.training.read = 0
    unchanged = all(getattr(previous, name) == getattr(job, name) for name in CHANGEABLE if name != "out")
    return _launch(root, run, job, write_job=not unchanged)


def cancel(root: bpy.types.Object) -> None:
    """Ask the trainer to save and stop. The second call kills it: its last checkpoint can be resumed.

    Raises:
        LodgsError: no training is running.
    """
    watch = watch_of(root)
    if watch is None or not watch.running:
        raise LodgsError(
            f"Cannot cancel the training: no training of '{root.name}' is running.",
            "Select the scene that is being trained.",
        )
    if not watch.cancel_requested:
        watch.cancel_requested = True
        watch.message = "Saving and stopping"
        try:
            watch.folder.request_cancel()
        except OSError as error:
            raise LodgsError(
                f"Cannot cancel the run in {watch.folder.path}: {system_reason(error)}.",
                "Cancel again to kill the trainer.",
            ) from error
    else:
        if watch.process is not None:
            watch.process.kill()
        else:
            watch.folder.kill()
        for number in {part["block"] for part in watch.parts}:
            part = watch.part(number)
            with suppress(LodgsError, OSError):
                if part is not None:
                    part.folder.kill()
    extension.redraw()


def cancel_cell(root: bpy.types.Object, number: int) -> None:
    """Ask the training of one cell to save and stop. Other cells continue.

    Raises:
        LodgsError: the cell is neither running nor waiting.
    """
    watch = watch_of(root)
    part = watch.part(number) if watch is not None and watch.running else None
    if watch is None or part is None or part.state not in {"waiting", "running"}:
        raise LodgsError(
            f"Cannot cancel cell {number} of '{root.name}': it is not being trained.",
            "Choose a cell that is being trained.",
        )
    _request(part.folder.request_cancel)
    watch.stopping.add((part.kind, number))
    extension.redraw()


def resume_cell(root: bpy.types.Object, number: int) -> Watch:
    """Resume the training of one cell. If no other cell is running, only this cell is trained.

    Raises:
        LodgsError: the cell does not exist, or it is running or finished.
    """
    watch = watch_of(root)
    part = watch.part(number) if watch is not None else None
    if (
        watch is None
        or part is None
        or part.state in ({"waiting", "running", "done"} if watch.running else {"done"})
    ):
        raise LodgsError(
            f"Cannot resume cell {number} of '{root.name}': it is not stopped.", "Choose a stopped cell."
        )
    _request(part.folder.request_resume)
    return watch if watch.running else _resume(root, watch.folder)


def _request(request: Callable[[], None]) -> None:
    try:
        request()
    except OSError as error:
        raise LodgsError(
            f"Cannot write {error.filename}: {error.strerror}.", "Cancel the whole training."
        ) from error


def attach(root: bpy.types.Object, folder: str, *, reload: bool = True) -> Watch:
    """Make a run the root's newest run. Its levels are loaded by :func:`follow`.

    Args:
        root: scene root.
        folder: run folder, possibly of a run that another Blender or a command started.
        reload: load every level, or else only the levels that this .blend file has not read yet.

    Raises:
        LodgsError: the folder contains no run.
    """
    run = RunFolder(absolute_path(folder).resolve())
    if run_state(run) == "empty":
        raise LodgsError(
            f"Cannot open {run.path}: it contains no run.", "Choose a folder that contains a job.toml file."
        )
    if reload:
        root.lodgs.training.read = 0
    link_run(root, run)
    watch = start_watching(Watch(run, root.session_uid, offset=root.lodgs.training.read))
    if watch.parts and not root.lodgs.training.planned_for:
        cells.resize_cells(root.lodgs.training, watch.cells)
    return watch


def follow(
    watch: Watch,
    show: Callable[[Watch], None] | None = None,
    interrupted: Callable[[], bool] = lambda: False,
) -> None:
    """Read the events of a run until it ends: by a timer with a window, blocking in background.

    In background, Ctrl-C asks the trainer to save and stop, and waits for it.

    Args:
        watch: result of :func:`start`, :func:`resume` or :func:`attach`.
        show: function called after each step, for example to print progress.
        interrupted: function that returns whether Ctrl-C was pressed since its last call. Blender hides
            exceptions of its callbacks.
    """

    def step() -> bool:
        unfinished = watch.step()
        if show:
            show(watch)
        if interrupted():
            raise KeyboardInterrupt
        return unfinished

    try:
        processes.follow(step)
    except KeyboardInterrupt:
        interrupted()
        root = root_by_uid(watch.root)
        if root is not None and watch.running:
            cancel(root)
        processes.follow(step)


class TrainingInputs(NamedTuple):
    """Splats to train from, the views to render them from, as (camera, near), and warnings."""

    bundle: Bundle
    views: list[tuple[Camera, float]]
    warnings: list[str]

    @classmethod
    def of(cls, root: bpy.types.Object, job: Job) -> TrainingInputs:
        """Return the inputs of a job from the current splats of a root."""
        inputs = cls(scenes.read_levels(root), [], [])
        if job.capture:
            splats = complete_splats(inputs.bundle, inputs.bundle.levels[-1])
            inputs.views.extend(viewpoints.training_views(bpy.context, root, splats, inputs.warnings.append))
        return inputs

    def write(self, run: RunFolder) -> None:
        """Write the splats and the views to a run."""
        write_bundle(run.base, self.bundle)
        for number, (camera, near) in enumerate(self.views):
            write_camera(run.cameras / f"{number:04d}.json", camera.moved(self.bundle.origin), near)


def _launch(
    root: bpy.types.Object, run: RunFolder, job: Job, *, write_job: bool, export: bool = False
) -> Watch:
    """Start the trainer, after writing the job and exporting the inputs if asked for.

    Raises:
        LodgsError: the trainer is missing, or another Blender uses the run.
    """
    python = environment.trainer_python()
    at_once = root.lodgs.training.at_once if job.cells else 1
    environment.require(python, at_once)
    state = run_state(run)
    inputs = TrainingInputs.of(root, job) if export else None  # an error leaves no folder
    run.create()
    with run.locked():
        if state == "empty" and run.job.exists():
            raise LodgsError(
                f"Cannot train in {run.path}: another Blender has started a run there.",
                "Open this run, or choose another folder.",
            )
        if inputs is not None:
            inputs.write(run)
        if write_job:
            job.resolved().write(run.job)
    arguments = ["train", str(run.job), "--out", str(run.path)]
    if job.cells:
        workers = f"local:{at_once}" if at_once > 1 else "here"
        arguments = ["blocks", "run", str(run.path), "--on", workers]
    try:
        run.take_cancel()  # clear a request to an earlier trainer
        command = [str(python), "-m", "training", *arguments]
        process = processes.spawn(command, log=run.log, output=run.output)
    except OSError as error:
        raise LodgsError(
            f"Cannot start the trainer with {python}: {error.strerror or error}.",
            "Check the trainer's Python in the preferences of LODGS.",
        ) from error
    link_run(root, run)
    offset, warnings = root.lodgs.training.read, [] if inputs is None else inputs.warnings
    return start_watching(
        Watch(run, root.session_uid, process=process, view_warnings=warnings, offset=offset)
    )


def reattach() -> None:
    """Attach to the runs of all scene roots that are not watched: after enabling, loading, undo and redo."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.training.run and roots.is_local(obj)]:
        if watch_of(root) is None and automatic_path(root.lodgs.training.run):
            with suppress(LodgsError):  # the panel reports a missing folder
                watch = attach(root, root.lodgs.training.run, reload=False)
                if bpy.app.background:
                    watch.step()  # read existing events only: opening a file must not wait for a training
                else:
                    follow(watch)


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    watches.clear()
    reattach()


@bpy.app.handlers.persistent
def _on_undo(*_) -> None:
    for watch in list(watches.values()):
        root = root_by_uid(watch.root)
        if root is not None and watch.running:
            link_run(root, watch.folder)  # undo must not lose a run
    reattach()


def register() -> None:
    handlers = bpy.app.handlers
    handlers.load_post.append(_on_load)
    handlers.undo_post.append(_on_undo)
    handlers.redo_post.append(_on_undo)
    bpy.app.timers.register(reattach, first_interval=0)  # an update of the extension ends no training


def unregister() -> None:
    handlers = bpy.app.handlers
    handlers.load_post.remove(_on_load)
    handlers.undo_post.remove(_on_undo)
    handlers.redo_post.remove(_on_undo)
    if bpy.app.timers.is_registered(reattach):
        bpy.app.timers.unregister(reattach)
    watches.clear()
