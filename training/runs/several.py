"""Several trainings in turn, with the time left."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import LodgsError, printable
from ..evaluate.messages import format_duration
from ..methods import method_info
from ..scenes.check import SMALL_SIDE
from ..scenes.colmap import read_scene
from .estimate import estimate
from .folder import RunFolder
from .job import Job, default_image_scale

MAX_DENSITY = 2.0
"""Maximum number of splats per pixel of an image at an effort below 1. FLoD's paper has 2 on Mip-NeRF360."""

Train = Callable[[Job, str], str]
"""Trains or resumes a job, with a text for its progress; returns the reason of a failure, or ""."""


class NamedJob(NamedTuple):
    """A job with its name in texts about progress."""

    name: str
    job: Job


def check_different_names(scenes: Sequence[Path]) -> None:
    """Check scenes whose runs are in folders with the scenes' names.

    Raises:
        LodgsError: two scenes have the same name.
    """
    names = [scene.resolve().name for scene in scenes]
    for name in names:
        if names.count(name) > 1:
            raise LodgsError(
                f"Cannot use these scenes: several folders are named {printable(name)}.",
                "Rename one of them.",
            )


class ReducedJobs:
    """Jobs on a scene that do a fraction of a preset's work.

    The effort multiplies the numbers of steps. Below 1, it also multiplies the pixels of an image, but the
    longer side keeps SMALL_SIDE pixels; gradient thresholds and parameters in pixels follow the size of the
    images, and MAX_DENSITY limits the splats. An image scale among the keys remains.

    Args:
        scene: COLMAP scene.
        effort: fraction of the work.
        keys: further keys of the jobs.

    Raises:
        LodgsError: the scene cannot be read.
    """

    def __init__(self, scene: Path, preset: str, effort: float, keys: Mapping[str, Any]) -> None:
        self.preset, self.effort = preset, effort
        self._keys = {"scene": str(scene), "preset": preset, **keys}
        scale = keys.get("image_scale", default_image_scale(preset))
        self._max_splats, self._pixel_ratio = 0, 1.0
        if effort < 1:
            sizes = np.array([(camera.width, camera.height) for camera in read_scene(scene).cameras])
            if "image_scale" not in keys:
                min_scale = min(SMALL_SIDE / sizes.max(), scale)
                scale = round(max(scale * effort**0.5, min_scale), 4)
            self._pixel_ratio = scale / default_image_scale(preset)
            self._max_splats = round(MAX_DENSITY * float(np.median(sizes.prod(axis=1))) * scale**2)
        self._keys["image_scale"] = scale

    def job(self, method: str, out: Path, changes: Mapping[str, Any] | None = None, base: str = "") -> Job:
        """Return the job of a method.

        Args:
            changes: parameters that differ from the preset; their steps are multiplied, too.

        Raises:
            LodgsError: a key or a parameter is invalid.
        """
        info = method_info(method)
        parameters = info.scaled_steps(self.preset, self.effort, changes or {})
        if self._pixel_ratio < 1:
            preset = info.preset(self.preset)
            parameters |= {
                f.name: max(self._pixel_ratio * getattr(preset, f.name), f.metadata["low"])
                for f in info.fields
                if f.metadata["unit"] == "px" and f.name not in parameters
            }
        if self._max_splats:
            limit = info.preset(self.preset).max_splats or self._max_splats
            parameters |= {"max_splats": min(limit, self._max_splats), "scale_threshold": True}
        keys = {"method": method, "out": str(out), "base": base, "parameters": parameters}
        return Job.from_dict(self._keys | keys)


def train_in_turn(jobs: Sequence[NamedJob], train: Train, notify: Callable[[str], object]) -> Iterator[str]:
    """Train or resume jobs, and yield the reason of each one's failure, or "".

    Before, it estimates the durations. Each text for progress has the time left, corrected by the durations
    so far, in which the caller's work between the jobs counts.

    Args:
        notify: receives sentences about progress.
    """
    unfinished = [job for _, job in jobs if RunFolder(job.out).state() != "done"]
    expected_seconds = _estimate(unfinished, notify)
    elapsed = estimated = 0.0  # seconds of the finished trainings
    for number, (name, job) in enumerate(jobs, 1):
        remaining = sum(expected_seconds) * (elapsed / estimated if estimated else 1.0)
        end = f", about {format_duration(remaining)} left" if remaining else ""
        begin = time.monotonic()
        yield train(job, f"Training {name} ({number} of {len(jobs)}{end})")
        if expected_seconds and job in unfinished:
            elapsed += time.monotonic() - begin
            estimated += expected_seconds.pop(0)


def _estimate(jobs: Sequence[Job], notify: Callable[[str], object]) -> list[float]:
    """Return the estimated seconds of jobs, and report their sum; nothing if one has no estimate.

    Steps of one job of each method and scene are measured. A training from splats is assumed to have steps
    as long as one from points.
    """
    if not jobs:
        return []
    trainings = f"{len(jobs)} training{'s' * (len(jobs) != 1)}"
    notify(f"Estimating the time of {trainings}.")
    per_step: dict[tuple[str, str], float] = {}
    seconds = []
    try:
        with tempfile.TemporaryDirectory(prefix="lodgs-") as scratch:
            for job in jobs:
                kind = (job.scene, job.method)
                if kind not in per_step:
                    costs = estimate(replace(job, base=""), Path(scratch))
                    per_step[kind] = costs.seconds / costs.steps
                seconds.append(per_step[kind] * job.steps)
    except LodgsError as error:
        notify(f"No estimate: {error.what}")
        return []
    verb = "takes" if len(jobs) == 1 else "take"
    notify(f"{trainings} {verb} about {format_duration(sum(seconds))}.")
    return seconds
