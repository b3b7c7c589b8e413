"""From a job to the views that it trains and is measured on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..methods.data import TrainingData
from ..scenes.colmap import read_scene
from ..scenes.undistort import undistorted
from .folder import RunFolder
from .job import Job


def training_data(job: Job, folder: RunFolder, tell: Callable[..., None] | None = None) -> TrainingData:
    """The job's scene, read and where needed undistorted (once, into the run folder).

    Args:
        tell: called with an event's kind and values (status, warning) while this goes on.

    Raises:
        LodgsError: if the scene cannot be read, or has too little to train on.
    """
    model, images = (Path(path) if path else None for path in (job.model, job.images))
    scene = read_scene(Path(job.scene), model=model, images=images)
    warnings = list(scene.warnings)
    if scene.distorted:
        if tell:
            tell("status", message=f"Undistorting {len(scene.distorted)} views")
        scene = undistorted(scene, folder.path / "undistorted")
        warnings += [warning for warning in scene.warnings if warning not in warnings]
    for warning in warnings:
        if tell:
            tell("warning", message=warning)
    return TrainingData(scene, job.image_scale, job.test_every, job.exposure, job.validation)
