"""Check of scenes before training by the trainer, with an estimate of its costs; last findings for panels."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import bpy

from ...training.errors import LodgsError
from ...training.runs.folder import RunFolder
from ...training.runs.job import Job
from ...training.scenes.check import ESTIMATE, SEVERITIES, Finding, check_folder
from .. import extension
from ..data import viewpoints
from ..data.paths import absolute_path
from ..data.training_settings import hold_out_interval
from . import environment, job_settings, jobs, run_folders

TIMEOUT = 600.0
"""Seconds after which a check is abandoned. The kernels may have to be compiled first."""

_findings: dict[int, tuple[str, list[Finding]]] = {}
"""Settings of the training and findings of the last check, by the session uid of the scene root."""
running: set[int] = set()
"""Session uids of the scene roots that are being checked."""


def read_findings(root: bpy.types.Object, stop: Event) -> Callable[[], list[Finding]]:
    """Return a function that checks the photos of a scene root, if any, and estimates the costs of training.

    It does not use Blender's data. Without a trainer, it only checks the photos.

    Args:
        stop: event that ends the trainer.

    Raises:
        LodgsError: the root has neither photos nor splats, or has no photos and no trainer.
    """
    settings = root.lodgs
    has_photos = bool(settings.scene_folder)
    if not has_photos and not viewpoints.has_only_splats(root):
        raise LodgsError(f"Cannot check '{root.name}': it has no photos.", "Import a COLMAP scene.")
    folder, model, images = (
        absolute_path(path) if path else None
        for path in (settings.scene_folder, settings.training.model, settings.training.images)
    )
    scale = settings.training.image_scale
    check = partial(check_folder, folder, model, images, image_scale=scale) if has_photos else list
    run = RunFolder(run_folders.runs_parent(root) / "estimate")  # its disk counts, nothing is written
    try:
        job = job_settings.make_job(root, run.path, {})
        inputs = jobs.TrainingInputs.of(root, job) if Path(job.base) == run.base else None
        return partial(_ask_trainer, environment.trainer_python(), job, inputs, check, stop)
    except LodgsError:
        if not has_photos:
            raise
        return check


def _ask_trainer(
    python: Path,
    job: Job,
    inputs: jobs.TrainingInputs | None,
    check: Callable[[], list[Finding]],
    stop: Event,
) -> list[Finding]:
    """Run ``lodgs train --check`` and return the findings that it prints; without an answer, check here.

    Args:
        inputs: splats and views of the job, to be exported.
    """
    with TemporaryDirectory(prefix="lodgs-") as folder:
        file, exported = Path(folder, "job.toml"), RunFolder(Path(folder))
        if inputs is not None:
            inputs.write(exported)
            capture = str(exported.cameras) if inputs.views else job.capture
            job = replace(job, base=str(exported.base), capture=capture)
        job.write(file)
        try:
            answer = environment.run_module(python, "train", str(file), "--check", timeout=TIMEOUT, stop=stop)
        except (OSError, subprocess.TimeoutExpired):
            answer = None
    if stop.is_set():
        return []
    if answer is None or answer.returncode not in (0, 2):
        return [*check(), Finding(ESTIMATE, "No estimate: the trainer did not answer.")]
    lines = [line.partition(": ") for line in answer.stdout.splitlines()]
    return [Finding(kind, text) for kind, _, text in lines if kind in (*SEVERITIES, ESTIMATE)]


def store_findings(root: bpy.types.Object, key: str, findings: list[Finding]) -> None:
    """Keep the findings about a scene root for the panels.

    Args:
        key: :func:`settings_key` at the start of the check.
    """
    _findings[root.session_uid] = key, findings


def last_findings(root: bpy.types.Object) -> list[Finding] | None:
    """Return the findings of the last check of a scene, without the estimate; None if it was not checked."""
    _, findings = _findings.get(root.session_uid, ("", None))
    return None if findings is None else [finding for finding in findings if finding.severity != ESTIMATE]


def last_estimate(root: bpy.types.Object) -> list[str]:
    """Return the estimate and suggestions for the current settings; none if they changed since the check."""
    key, findings = _findings.get(root.session_uid, ("", []))
    if key != settings_key(root):
        return []
    return [str(finding) for finding in findings if finding.severity == ESTIMATE]


def settings_key(root: bpy.types.Object) -> str:
    """Return a text that changes with the settings of the training and its device."""
    settings = root.lodgs.training
    changed = sorted(job_settings.changed_parameters(settings).items())
    common = settings.method, settings.preset, settings.image_scale, settings.start_from, settings.base
    files = root.lodgs.scene_folder, settings.model, settings.images
    views = settings.views_from, settings.views, settings.view_width
    grid, region, every = settings.grid, settings.region, hold_out_interval(root)
    return repr((*common, *files, *views, grid, region, every, changed, extension.preferences().backend))
