"""The runs of a splat scene that lie beside its newest one, or where its next one will."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.methods import method_info
from ...training.runs.folder import RunFolder
from ...training.runs.job import Job
from . import jobs

SECONDS = 2.0
"""For how long what was found in a folder is taken to be there: panels ask at each redraw."""


@dataclass(frozen=True)
class FoundRun:
    """A run's folder, and what it says of itself.

    Attributes:
        method: label of what it trains.
        state: as ``RunFolder.state``, never ``empty``.
        levels: how many have come.
        begun: when, in seconds since the epoch.
    """

    path: Path
    method: str
    state: str
    levels: int
    begun: float


def runs_of(root: bpy.types.Object) -> list[FoundRun]:
    """The runs that train a root's photographs, newest first; of splats alone those that its folder's name
    begins with theirs. Folders on other computers are not looked into."""
    run, scene = jobs.run_folder(root), root.lodgs.scene_folder
    places = {jobs.runs_folder(root), *([run.path.parent] if run is not None else [])}
    name = bpy.path.clean_name(root.name)
    found = []
    for place in places:
        if not jobs.is_far(str(place)):
            for each, trained in _found(place, int(time.monotonic() / SECONDS)):
                same = Path(trained) == Path(bpy.path.abspath(scene)) if scene and trained else not trained
                if same and (scene or each.path.name.startswith(name)):
                    found.append(each)
    return sorted(found, key=lambda each: each.begun, reverse=True)


@lru_cache(8)
def _found(folder: Path, _when: int) -> list[tuple[FoundRun, str]]:
    """The runs in a folder, each with the scene that it trains."""
    try:
        jobs_there = sorted(folder.glob("*/job.toml"))
    except OSError:
        return []
    found = []
    for path in jobs_there:
        try:
            stamps = tuple(
                file.stat().st_mtime_ns for file in (path, path.with_name("events.jsonl")) if file.exists()
            )
            found.append(_read(path, stamps, RunFolder(path.parent).running))
        except (LodgsError, OSError):  # of another version, or being removed
            continue
    return found


@lru_cache(256)
def _read(path: Path, stamps: tuple[int, ...], _running: bool) -> tuple[FoundRun, str]:
    run, job = RunFolder(path.parent), Job.from_file(path)
    label = method_info(job.method).label
    return FoundRun(run.path, label, run.state(), len(run.levels()), stamps[0] / 1e9), job.scene
