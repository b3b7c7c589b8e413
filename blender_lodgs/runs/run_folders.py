"""Run folders of a scene root: the current run, new folders, and the search for runs."""

from __future__ import annotations

import itertools
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import bpy

from ...training.errors import LodgsError
from ...training.runs.folder import RunFolder
from ...training.runs.job import Job

LOG = "LODGS trainer log"
"""Name of the text block that shows a trainer's log."""


@dataclass(frozen=True)
class RunRecord:
    """A run on disk: its folder, its job, and its state as ``RunFolder.state``."""

    folder: RunFolder
    job: Job
    state: str


def run_folder(root: bpy.types.Object) -> RunFolder | None:
    """The folder of the root's newest run, whether or not it is followed."""
    run = root.lodgs.training.run
    return RunFolder(bpy.path.abspath(run)) if run else None


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


def run_state(run: RunFolder) -> str:
    try:
        return run.state()
    except OSError as error:
        raise LodgsError(
            f"The run folder {run.path} cannot be read: {error.strerror}.", "Choose another folder."
        ) from error


def link_run(root: bpy.types.Object, run: RunFolder) -> None:
    path = str(run.path)
    if bpy.data.is_saved:
        with suppress(ValueError):  # another drive
            path = bpy.path.relpath(path)
    root.lodgs.training.run = path


def runs_parent(root: bpy.types.Object) -> Path:
    """What holds the folders of a root's runs: where the settings say, else beside the .blend or at home."""
    if root.lodgs.training.output:
        return Path(bpy.path.abspath(root.lodgs.training.output)).resolve()
    if bpy.data.is_saved:
        return Path(bpy.path.abspath("//lodgs_runs"))
    return Path.home() / "lodgs_runs"


def find_runs(root: bpy.types.Object) -> list[RunRecord]:
    """The runs of a root's photographs, or of its base, by name: where new ones would lie, and beside its
    newest one."""
    mine = run_folder(root)
    places = {runs_parent(root), *([mine.path.parent] if mine else [])}
    scene = Path(bpy.path.abspath(root.lodgs.scene_folder)) if root.lodgs.scene_folder else None
    found = {}
    for place in places:
        for file in place.glob("*/job.toml"):
            with suppress(LodgsError, OSError):
                run = RunFolder(file.parent)
                job = Job.from_file(file)
                here = mine is not None and run.path == mine.path
                if here or (scene is not None and job.scene and Path(job.scene) == scene):
                    found[run.path] = RunRecord(run, job, run.state())
    return [found[path] for path in sorted(found)]


def new_run_folder(root: bpy.types.Object) -> Path:
    """A folder for a run, not there yet."""
    parent = runs_parent(root)
    name = bpy.path.clean_name(root.name)
    names = itertools.chain([name], (f"{name}-{n}" for n in itertools.count(2)))
    return next(parent / n for n in names if not (parent / n).exists())


def is_on_other_computer(folder: str) -> bool:
    """Whether a folder is on another computer than the .blend: it is looked for there on request only.

    Opening somebody's file must not make Windows introduce itself to a computer of their choice.
    """
    share = PureWindowsPath(folder).drive
    return share.startswith(("\\\\", "//")) and share != PureWindowsPath(bpy.data.filepath).drive
