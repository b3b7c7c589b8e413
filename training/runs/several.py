"""Several trainings in turn, with the time left."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..errors import LodgsError
from ..evaluate.messages import format_duration
from ..scenes.check import SMALL_SIDE
from ..scenes.colmap import read_scene
from .estimate import estimate
from .folder import RunFolder
from .job import Job, default_image_scale

Train = Callable[[Job, str], str]
"""Trains or resumes a job, with a text for its progress; returns the reason of a failure, or ""."""


class NamedJob(NamedTuple):
    """A job with its name in texts about progress."""

    name: str
    job: Job


def reduced_image_scale(scene: Path, preset: str, effort: float) -> float:
    """Return the image scale that multiplies the pixels of a preset's images by an effort below 1.

    The longer side keeps SMALL_SIDE pixels.

    Raises:
        LodgsError: the scene cannot be read.
    """
    scale = default_image_scale(preset)
    if effort >= 1:
        return scale
    side = max(max(camera.width, camera.height) for camera in read_scene(scene).cameras)
    return round(min(max(scale * effort**0.5, SMALL_SIDE / side), scale), 4)


def train_in_turn(jobs: Sequence[NamedJob], train: Train, notify: Callable[[str], object]) -> Iterator[str]:
    """Train or resume jobs, and yield the reason of each one's failure, or "".

    Before, it estimates the durations. Each text for progress has the time left, corrected by the durations
    so far, in which the caller's work between the jobs counts.

    Args:
        notify: receives sentences about progress.
    """
    remaining = [job for _, job in jobs if RunFolder(job.out).state() != "done"]
    expected = _estimate(remaining, notify)
    spent = estimated = 0.0
    for number, (name, job) in enumerate(jobs, 1):
        left = sum(expected) * (spent / estimated if estimated else 1.0)
        end = f", about {format_duration(left)} left" if left else ""
        begin = time.monotonic()
        yield train(job, f"Training {name} ({number} of {len(jobs)}{end})")
        if expected and job in remaining:
            spent, estimated = spent + time.monotonic() - begin, estimated + expected.pop(0)


def _estimate(jobs: Sequence[Job], notify: Callable[[str], object]) -> list[float]:
    """Return the estimated seconds of jobs, and report their sum; nothing if one has no estimate.

    Steps of one job of each method and scene are measured. A training from splats is assumed to have steps
    as long as one from points.
    """
    if not jobs:
        return []
    notify(f"Estimating the time of {len(jobs)} trainings.")
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
    notify(f"{len(jobs)} trainings take about {format_duration(sum(seconds))}.")
    return seconds
