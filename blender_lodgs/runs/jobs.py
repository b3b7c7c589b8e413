"""Trainings from Blender: start, follow, cancel, resume and find again.

A run goes on when Blender closes, and is found again by its folder when the .blend is opened.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...training.errors import LodgsError
from ...training.lod.selection import complete
from ...training.runs.folder import RunFolder
from ...training.runs.job import CHANGEABLE, Job
from ...training.scenes.cameras import write_camera
from ...training.splats.bundle import write_bundle
from .. import extension
from ..data import cells, scenes, viewpoints
from . import environment, processes
from .job_settings import make_job
from .run_folders import is_on_other_computer, link_run, new_run_folder, run_folder, run_state
from .watch import Watch, begin, root_by_uid, watch_of, watches

if TYPE_CHECKING:
    pass


def start(root: bpy.types.Object, folder: str = "", parameters: dict | None = None) -> Watch:
    """Train a scene root with its settings (``root.lodgs.training``) in a new run folder.

    Args:
        root: a scene root that was imported from a COLMAP folder; or one with splats alone, which are handed
            over as they are here, with the views of them that the settings ask for.
        folder: the run's folder; empty makes a new one where the settings say.
        parameters: further parameters of the method by name (``training.optimize.parameters``).

    Raises:
        LodgsError: no trainer, no scene, an impossible setting, or a folder that is taken.
    """
    run = RunFolder(Path(bpy.path.abspath(folder)).resolve()) if folder else RunFolder(new_run_folder(root))
    return _begin(root, run, make_job(root, run.path, parameters or {}))


def _begin(root: bpy.types.Object, run: RunFolder, job: Job) -> Watch:
    watch, state = watch_of(root), run_state(run)
    if watch is not None and watch.running:
        raise LodgsError(f"'{root.name}' is being trained already.", "Wait for that, or cancel it.")
    if state == "running":
        raise LodgsError(
            f"Another training is already at work in {run.path}.",
            "Wait for it, cancel it, or choose another run folder.",
        )
    if state != "empty":
        raise LodgsError(
            f"{run.path} already holds a run.", "Choose another folder, or open it as a run and resume it."
        )
    root.lodgs.training.read = 0
    return _launch(root, run, job, write=True, hand_over=Path(job.base) == run.base)


def resume(root: bpy.types.Object) -> Watch:
    """Go on with the root's newest run, with the settings that it was started with, on what trains now.

    Raises:
        LodgsError: there is no such run, or it is at work or finished.
    """
    run = run_folder(root)
    state = "empty" if run is None else run_state(run)
    if run is None or state == "empty":
        raise LodgsError(f"'{root.name}' has no run to resume.", "Press Train, or open a run folder.")
    if state == "running":
        raise LodgsError(f"The run in {run.path} is already at work.", "Wait for it or cancel it.")
    if state == "done":
        raise LodgsError(f"The run in {run.path} is finished.", "Press Train for a new one.")
    return _resume(root, run)


def _resume(root: bpy.types.Object, run: RunFolder) -> Watch:
    job = replace(Job.from_file(run.job), out=str(run.path))
    backend = extension.preferences().backend  # what this computer has, and what its user wants now
    return _launch(root, run, replace(job, backend=backend), write=job.backend != backend)


def start_or_resume(root: bpy.types.Object, job: Job) -> Watch:
    """Begin a job, or go on with what the same job began: command lines are simply given again.

    A finished run is loaded.

    Raises:
        LodgsError: as :func:`start` and :func:`resume`, or the run was begun with other settings.
    """
    run = RunFolder(Path(job.out))
    state = run_state(run)
    if state in {"empty", "running"}:
        return _begin(root, run, job)
    before, now = Job.from_file(run.job).resolved(), job.resolved()
    names = [f.name for f in fields(Job) if f.name not in CHANGEABLE]
    changed = [name for name in names if getattr(before, name) != getattr(now, name)]
    if changed:
        raise LodgsError(
            f"The run in {run.path} was begun with other settings ({', '.join(changed)}).",
            "Give the same ones to go on with it, or choose another folder.",
        )
    if state == "done":
        return attach(root, job.out)
    root.lodgs.training.read = 0
    same = all(getattr(before, name) == getattr(job, name) for name in CHANGEABLE if name != "out")
    return _launch(root, run, job, write=not same)


def cancel(root: bpy.types.Object) -> None:
    """Ask the trainer to save and stop; asked again, end it (it can be resumed from its last checkpoint).

    Raises:
        LodgsError: nothing is running.
    """
    watch = watch_of(root)
    if watch is None or not watch.running:
        raise LodgsError(f"No training of '{root.name}' is at work.")
    if not watch.cancel_requested:
        watch.cancel_requested = True
        watch.message = "Saving and stopping"
        try:
            watch.folder.request_cancel()
        except OSError as error:
            raise LodgsError(
                f"{watch.folder.path} cannot be written: {error.strerror}.",
                "Cancel again to end the trainer.",
            ) from error
    else:
        if watch.process is not None:
            watch.process.kill()
        else:
            watch.folder.kill()
        for number in {each["block"] for each in watch.blocks}:  # with nobody to begin them again
            part = watch.part(number)
            with suppress(LodgsError, OSError):
                if part is not None:
                    part.folder.kill()
    extension.redraw()


def cancel_block(root: bpy.types.Object, number: int) -> None:
    """Ask the training of one cell to save and stop, while the others go on.

    Raises:
        LodgsError: it is not at work, nor to begin.
    """
    watch = watch_of(root)
    part = watch.part(number) if watch is not None and watch.running else None
    if watch is None or part is None or part.state not in {"waiting", "running"}:
        raise LodgsError(f"Cell {number} of '{root.name}' is not being trained.")
    _ask(part.folder.request_cancel)
    watch.stopping.add((part.kind, number))
    extension.redraw()


def resume_block(root: bpy.types.Object, number: int) -> Watch:
    """Go on with the training of one cell: beside the others where they are at work, else alone.

    Raises:
        LodgsError: there is no such cell, or it is at work or finished.
    """
    watch = watch_of(root)
    part = watch.part(number) if watch is not None else None
    if (
        watch is None
        or part is None
        or part.state in ({"waiting", "running", "done"} if watch.running else {"done"})
    ):
        raise LodgsError(f"Cell {number} of '{root.name}' has nothing to go on with.")
    _ask(part.folder.request_resume)
    return watch if watch.running else _resume(root, watch.folder)


def _ask(request: Callable[[], None]) -> None:
    try:
        request()
    except OSError as error:
        raise LodgsError(
            f"{error.filename} cannot be written: {error.strerror}.", "Cancel the whole training."
        ) from error


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
    if run_state(run) == "empty":
        raise LodgsError(f"{run.path} holds no run.", "Choose a folder that has a job.toml in it.")
    if again:
        root.lodgs.training.read = 0
    link_run(root, run)
    watch = begin(Watch(run, root.session_uid, offset=root.lodgs.training.read))
    if watch.blocks and not root.lodgs.training.planned_for:
        cells.require(root.lodgs.training, watch.cells)
    return watch


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
        root = root_by_uid(watch.root)
        if root is not None and watch.running:
            cancel(root)
        processes.follow(step)


def _hand_over(root: bpy.types.Object, run: RunFolder, job: Job) -> None:
    """Write into a run what it takes of this file: splats as they are now, and the views of them."""
    bundle = scenes.read_levels(root)
    views = []
    if job.capture:
        views = viewpoints.placed(bpy.context, root, complete(bundle, bundle.levels[-1]))
    run.create()
    write_bundle(run.base, bundle)
    for number, (camera, near) in enumerate(views):
        write_camera(run.cameras / f"{number:04d}.json", camera, near)


def _launch(
    root: bpy.types.Object, run: RunFolder, job: Job, *, write: bool, hand_over: bool = False
) -> Watch:
    python, at_once = environment.trainer_python(), root.lodgs.training.at_once if job.cells else 1
    environment.require(python, at_once)
    if hand_over:
        _hand_over(root, run, job)
    run.create()
    if write:
        job.resolved().write(run.job)
    what = ["train", str(run.job), "--out", str(run.path)]
    if job.cells:
        what = ["blocks", "run", str(run.path), "--on", f"local:{at_once}" if at_once > 1 else "here"]
    try:
        run.take_cancel()  # what was asked of an earlier trainer; from now on it is for this one
        process = processes.spawn([str(python), "-m", "training", *what], log=run.log, output=run.output)
    except OSError as error:
        raise LodgsError(
            f"The trainer's Python {python} cannot be started: {error.strerror or error}.",
            "Check it in the preferences of LODGS.",
        ) from error
    link_run(root, run)
    return begin(Watch(run, root.session_uid, process=process, offset=root.lodgs.training.read))


def reattach() -> None:
    """Attach to the run of every scene root that has one and is not watched: after loading, undo and redo."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.training.run and obj.is_editable]:
        if watch_of(root) is None and not is_on_other_computer(bpy.path.abspath(root.lodgs.training.run)):
            with suppress(LodgsError):  # the folder is gone: the panel says so
                watch = attach(root, root.lodgs.training.run, again=False)
                if bpy.app.background:
                    watch.step()  # what is there; waiting for more is not what opening a file is for
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


def unregister() -> None:
    handlers = bpy.app.handlers
    handlers.load_post.remove(_on_load)
    handlers.undo_post.remove(_on_undo)
    handlers.redo_post.remove(_on_undo)
    watches.clear()
