"""Trainings from Blender: start, follow, cancel, resume and find again.

A run goes on when Blender closes, and is found again by its folder when the .blend is opened.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.lod.selection import complete
from ...training.methods import method_info, parameters_of
from ...training.optimize.parameters import Parameters
from ...training.runs.folder import RunFolder
from ...training.runs.job import CHANGEABLE, DOME, Job
from ...training.scenes.cameras import write_camera
from ...training.splats.bundle import write_bundle
from .. import extension
from ..data import cells, crops, scenes, viewpoints
from ..data.training import chooses_distances, hold_out, level_distances, offered
from . import environment, processes
from .watch import Watch, begin, root_by_uid, watch_of, watches

if TYPE_CHECKING:
    from ..data.training import TrainingSettings

LOG = "LODGS trainer log"
"""Name of the text block that shows a trainer's log."""


@dataclass(frozen=True)
class KnownRun:
    """A run on disk: its folder, its job, and its state as ``RunFolder.state``."""

    folder: RunFolder
    job: Job
    state: str


def run_folder(root: bpy.types.Object) -> RunFolder | None:
    """The folder of the root's newest run, whether or not it is followed."""
    run = root.lodgs.training.run
    return RunFolder(bpy.path.abspath(run)) if run else None


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
    run = RunFolder(Path(bpy.path.abspath(folder)).resolve()) if folder else RunFolder(new_folder(root))
    return _begin(root, run, make_job(root, run.path, parameters or {}))


def _begin(root: bpy.types.Object, run: RunFolder, job: Job) -> Watch:
    watch, state = watch_of(root), _state(run)
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
    state = "empty" if run is None else _state(run)
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
    state = _state(run)
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
    if _state(run) == "empty":
        raise LodgsError(f"{run.path} holds no run.", "Choose a folder that has a job.toml in it.")
    if again:
        root.lodgs.training.read = 0
    _link_run(root, run)
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


def cost_plot(root: bpy.types.Object) -> Path | None:
    """The picture of what finding the levels' distances has told, where the root's run has one."""
    run = run_folder(root)
    return run.costs if run is not None and run.costs.is_file() else None


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
        LodgsError: the root has no COLMAP folder, nothing to start from, or a setting is impossible.
    """
    settings = root.lodgs.training
    values = {
        **(_captured(root, out) if viewpoints.alone(root) else _photographed(root, out)),
        "out": str(out),
        "method": settings.method,
        "preset": settings.preset,
        "seed": settings.seed,
        "test_every": hold_out(root),
        "image_scale": _as_typed(settings.image_scale),
        "backend": extension.preferences().backend,
        "cells": "" if viewpoints.alone(root) else settings.grid,
        "polish": settings.polish,
        "region": crops.as_text(root, settings.region) if settings.region in crops.crops_of(root) else "",
        "parameters": changes(settings) | parameters,
    }
    return Job.from_dict(values)


def _photographed(root: bpy.types.Object, out: Path) -> dict:
    """What a job says of a scene that was imported from photographs."""
    settings = root.lodgs.training
    if not root.lodgs.scene_folder:
        raise LodgsError(
            f"'{root.name}' was not imported from photographs, so there is nothing to train on.",
            "Import a COLMAP folder.",
        )
    base = base_of(root, out)
    if base and settings.grid:
        raise LodgsError(
            "Cells begin with the scene's points, not with splats.",
            "Choose Points in Start From, or train one cell.",
        )
    return {
        "scene": bpy.path.abspath(root.lodgs.scene_folder),
        "model": bpy.path.abspath(settings.model),
        "images": bpy.path.abspath(settings.images),
        "base": base,
    }


def _captured(root: bpy.types.Object, out: Path) -> dict:
    """What a job says of splats alone."""
    settings, run = root.lodgs.training, RunFolder(out)
    info = method_info(settings.method)
    if not info.from_base:
        raise LodgsError(
            f"{info.label} needs photographs, and '{root.name}' has none.", "Choose the method LODGE."
        )
    return {
        "base": str(run.base),
        "capture": DOME if settings.views_from == "DOME" else str(run.cameras),
        "views": settings.views,
        "view_width": settings.view_width,
    }


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


def changes(settings: TrainingSettings) -> dict:
    """The method's parameters that are set in the panel, by name; all others are the preset's."""
    group = settings.parameters
    found = {
        f.name: _as_typed(getattr(group, f.name))
        for f in offered(settings.method)
        if group.is_property_set(f.name)
    }
    if chooses_distances(settings.method) and not settings.find_distances:
        places = [place for _, place in level_distances(settings)]
        found["distances"] = (*(_as_typed(settings.distances[place]) for place in places), 0.0)
    return found


def parameters(settings: TrainingSettings) -> Parameters:
    """The parameters of the training that the panel describes; found anew only when a choice changes.

    Raises:
        LodgsError: a choice is impossible.
    """
    return _parameters(settings.method, settings.preset, tuple(changes(settings).items()))


@lru_cache
def _parameters(method: str, preset: str, changes: tuple[tuple[str, Any], ...]) -> Parameters:
    return parameters_of(method, preset, dict(changes))


def _as_typed(value):
    """A number as its artist typed it, such as 0.65: Blender keeps the nearest one of 32 bits."""
    return float(str(np.float32(value))) if isinstance(value, float) else value


def show(settings: TrainingSettings, job: Job) -> None:
    """Set the panel to what a job says, as far as the panel offers it."""
    alike = {field.name for field in fields(Job)} - {"region"}
    for name in alike.intersection(settings.bl_rna.properties.keys()):
        setattr(settings, name, getattr(job, name))
    settings.region = crops.as_object(settings.id_data, job.crop) if job.crop else None
    settings.start_from = "FILE" if job.base else "POINTS"
    settings.columns, settings.rows = job.grid if job.cells else (1, 1)
    preset, own = method_info(job.method).preset(job.preset), job.resolved_parameters()
    for f in offered(job.method):
        settings.parameters.property_unset(f.name)
        if getattr(own, f.name) != getattr(preset, f.name):
            setattr(settings.parameters, f.name, getattr(own, f.name))
    settings.property_unset("distances")
    settings.find_distances = not any(getattr(own, "distances", ()))
    if chooses_distances(job.method) and not settings.find_distances:
        for number, place in level_distances(settings):
            settings.distances[place] = own.distances[number - 1]


def base_of(root: bpy.types.Object, out: Path) -> str:
    """What the root's next training begins with, as a job's ``base``; "" for the scene's points.

    Args:
        out: the folder of its run.

    Raises:
        LodgsError: the root has no finished run, or no file is chosen.
    """
    settings = root.lodgs.training
    if not method_info(settings.method).from_base or settings.start_from == "POINTS":
        return ""
    if settings.start_from == "FILE":
        if not settings.base:
            raise LodgsError(
                "No splats are chosen to start from.", "Choose a PLY or a run's folder, or start from points."
            )
        return bpy.path.abspath(settings.base)
    if settings.start_from == "SCENE":
        return str(RunFolder(out).base)
    run = run_folder(root)
    if run is None or _state(run) != "done":
        raise LodgsError(
            f"'{root.name}' has no finished run to start from.", "Finish one first, or start from points."
        )
    return str(run.path)


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
    _link_run(root, run)
    return begin(Watch(run, root.session_uid, process=process, offset=root.lodgs.training.read))


def _state(run: RunFolder) -> str:
    try:
        return run.state()
    except OSError as error:
        raise LodgsError(
            f"The run folder {run.path} cannot be read: {error.strerror}.", "Choose another folder."
        ) from error


def _link_run(root: bpy.types.Object, run: RunFolder) -> None:
    path = str(run.path)
    if bpy.data.is_saved:
        with suppress(ValueError):  # another drive
            path = bpy.path.relpath(path)
    root.lodgs.training.run = path


def runs_folder(root: bpy.types.Object) -> Path:
    """What holds the folders of a root's runs: where the settings say, else beside the .blend or at home."""
    if root.lodgs.training.output:
        return Path(bpy.path.abspath(root.lodgs.training.output)).resolve()
    if bpy.data.is_saved:
        return Path(bpy.path.abspath("//lodgs_runs"))
    return Path.home() / "lodgs_runs"


def runs_of(root: bpy.types.Object) -> list[KnownRun]:
    """The runs of a root's photographs, or of its base, by name: where new ones would lie, and beside its
    newest one."""
    mine = run_folder(root)
    places = {runs_folder(root), *([mine.path.parent] if mine else [])}
    scene = Path(bpy.path.abspath(root.lodgs.scene_folder)) if root.lodgs.scene_folder else None
    found = {}
    for place in places:
        for file in place.glob("*/job.toml"):
            with suppress(LodgsError, OSError):
                run = RunFolder(file.parent)
                job = Job.from_file(file)
                here = mine is not None and run.path == mine.path
                if here or (scene is not None and job.scene and Path(job.scene) == scene):
                    found[run.path] = KnownRun(run, job, run.state())
    return [found[path] for path in sorted(found)]


def new_folder(root: bpy.types.Object) -> Path:
    """A folder for a run, not there yet."""
    parent = runs_folder(root)
    name = bpy.path.clean_name(root.name)
    names = itertools.chain([name], (f"{name}-{n}" for n in itertools.count(2)))
    return next(parent / n for n in names if not (parent / n).exists())


def _far(folder: str) -> bool:
    """Whether a folder is on another computer than the .blend: it is looked for there on request only.

    Opening somebody's file must not make Windows introduce itself to a computer of their choice.
    """
    share = PureWindowsPath(folder).drive
    return share.startswith(("\\\\", "//")) and share != PureWindowsPath(bpy.data.filepath).drive


def reattach() -> None:
    """Attach to the run of every scene root that has one and is not watched: after loading, undo and redo."""
    for root in [obj for obj in bpy.data.objects if obj.lodgs.training.run and obj.is_editable]:
        if watch_of(root) is None and not _far(bpy.path.abspath(root.lodgs.training.run)):
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
            _link_run(root, watch.folder)  # undo must not lose a run
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
