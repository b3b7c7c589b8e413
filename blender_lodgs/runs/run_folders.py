"""Run folders of a scene root: the current run, new folders, and the search for runs."""

from __future__ import annotations

import itertools
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.runs.folder import RunFolder
from ...training.runs.job import Job
from ..data.paths import absolute_path, automatic_path, library_of, relative_path

LOG = "LODGS trainer log"
"""Name of the text block that shows a trainer's log."""


@dataclass(frozen=True)
class RunRecord:
    """A run on disk: its folder, its job, and its ``RunFolder.state``."""

    folder: RunFolder
    job: Job
    state: str


def run_folder(root: bpy.types.Object) -> RunFolder | None:
    """Return the folder of the root's newest run, watched or not.

    Raises:
        LodgsError: its path names a device.
    """
    run = root.lodgs.training.run
    return RunFolder(absolute_path(run).resolve()) if run else None


def automatic_run(root: bpy.types.Object) -> RunFolder | None:
    """Return the folder of the root's newest run, or None as ``automatic_path``."""
    path = automatic_path(root.lodgs.training.run, library_of(root))
    return RunFolder(path.resolve()) if path else None


def cost_plot(root: bpy.types.Object) -> Path | None:
    """Return the image file with the cost curve of the root's run, if it exists."""
    run = automatic_run(root)
    return run.costs if run is not None and run.costs.is_file() else None


def level_sheet(root: bpy.types.Object) -> Path | None:
    """Return the image of all levels of the root's finished run, if it exists."""
    run = automatic_run(root)
    return run.sheet if run is not None and run.sheet.is_file() else None


def log_text(root: bpy.types.Object) -> bpy.types.Text:
    """Return the last lines of the trainer's log as a text block.

    Raises:
        LodgsError: the root has no run, or its log is empty.
    """
    run = run_folder(root)
    tail = run.log_tail(200) if run else ""
    if not tail.strip():
        raise LodgsError(
            "Cannot show the log: the trainer has not written one.", "Wait until the trainer has started."
        )
    text = bpy.data.texts.get(LOG) or bpy.data.texts.new(LOG)
    text.from_string(tail)
    return text


def run_state(run: RunFolder) -> str:
    """Return ``RunFolder.state``.

    Raises:
        LodgsError: the folder cannot be read.
    """
    try:
        return run.state()
    except OSError as error:
        raise LodgsError(
            f"Cannot read the run folder {run.path}: {error.strerror}.", "Choose another folder."
        ) from error


def link_run(root: bpy.types.Object, run: RunFolder) -> None:
    """Store a run as the root's newest run, relative to the .blend file if possible."""
    root.lodgs.training.run = relative_path(str(run.path.absolute()))


def runs_parent(root: bpy.types.Object) -> Path:
    """Return the parent of the root's run folders: from the settings, next to the .blend file, or at home."""
    if root.lodgs.training.output:
        return absolute_path(root.lodgs.training.output).resolve()
    if bpy.data.is_saved:
        return absolute_path("//lodgs_runs")
    return Path.home() / "lodgs_runs"


def find_runs(root: bpy.types.Object) -> list[RunRecord]:
    """Return the root's own run and all runs of its photos, sorted by path.

    The parent of new run folders and the parent of the newest run are searched, but not automatically unsafe
    paths, see ``automatic_path``.
    """
    current = automatic_run(root)
    output = root.lodgs.training.output
    parents = {current.path.parent} if current else set()
    if not output or automatic_path(output):
        parents.add(runs_parent(root).resolve())
    scene = automatic_path(root.lodgs.scene_folder)
    records = {}
    for parent in parents:
        for file in parent.glob("*/job.toml"):
            with suppress(LodgsError, OSError):
                run = RunFolder(file.parent)
                job = Job.from_file(file)
                is_current = current is not None and run.path == current.path
                if is_current or (scene and job.scene and Path(job.scene).resolve() == scene.resolve()):
                    records[run.path] = RunRecord(run, job, run.state())
    return [records[path] for path in sorted(records)]


def new_run_folder(root: bpy.types.Object) -> Path:
    """Return an unused path for a run folder."""
    parent = runs_parent(root)
    name = bpy.path.clean_name(root.name)
    names = itertools.chain([name], (f"{name}-{n}" for n in itertools.count(2)))
    return next(parent / n for n in names if not (parent / n).exists())
