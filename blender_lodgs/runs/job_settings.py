"""Conversion between the training settings of a scene root and jobs."""

from __future__ import annotations

from dataclasses import Field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.methods import method_info, resolve_parameters
from ...training.optimize.parameters import Parameters
from ...training.runs.folder import RunFolder
from ...training.runs.job import DOME, Job
from .. import extension
from ..data import crops, viewpoints
from ..data.paths import absolute_path
from ..data.training_settings import (
    PANEL_KEYS,
    has_level_distances,
    hold_out_interval,
    level_distances,
    panel_parameters,
)
from .run_folders import run_folder, run_state

if TYPE_CHECKING:
    from ..data.training_settings import TrainingSettings


def make_job(root: bpy.types.Object, out: Path, parameters: dict) -> Job:
    """Return the job for the training settings of a scene root.

    Args:
        root: scene root.
        out: run folder.
        parameters: additional method parameters by name.

    Raises:
        LodgsError: the root has no COLMAP folder, no splats to start from, or an invalid setting.
    """
    settings = root.lodgs.training
    without_photos = viewpoints.has_only_splats(root)
    values = {
        **{name: _key_value(settings, f) for name, f in PANEL_KEYS.items()},
        **(_capture_keys(root, out) if without_photos else _photo_keys(root, out)),
        "out": str(out),
        "test_every": hold_out_interval(root),
        "backend": extension.preferences().backend,
        "cells": "" if without_photos else settings.grid,
        "region": crops.crop_text(root, settings.region) if settings.region in crops.crops_of(root) else "",
        "parameters": changed_parameters(settings) | parameters,
    }
    return Job.from_dict(values)


def _key_value(settings: TrainingSettings, f: Field) -> Any:
    """Return the value of a job key that has a property of the same name."""
    value = getattr(settings, f.name)
    if f.metadata["path"]:
        return str(absolute_path(value)) if value else ""
    return _as_typed(value)


def _photo_keys(root: bpy.types.Object, out: Path) -> dict:
    """Return the job keys for a scene that was imported from photos."""
    settings = root.lodgs.training
    if not root.lodgs.scene_folder:
        raise LodgsError(
            f"Cannot train '{root.name}': it has no photos.",
            "Import a COLMAP folder.",
        )
    base = base_path(root, out)
    if base and settings.grid:
        raise LodgsError(
            "Cannot train cells from splats: cells start from the points of the scene.",
            "Choose Points in Start From, or train one cell.",
        )
    return {
        "scene": str(absolute_path(root.lodgs.scene_folder)),
        "base": base,
    }


def _capture_keys(root: bpy.types.Object, out: Path) -> dict:
    """Return the job keys for splats without photos, which are trained on rendered views of them."""
    settings = root.lodgs.training
    run = RunFolder(out)
    info = method_info(settings.method)
    if not info.from_base:
        raise LodgsError(
            f"Cannot train '{root.name}' with {info.label}: it has no photos.", "Choose the method LODGE."
        )
    return {
        "model": "",
        "images": "",
        "base": str(run.base),
        "capture": DOME if settings.views_from == "DOME" else str(run.cameras),
        "views": settings.views,
        "view_width": settings.view_width,
    }


def changed_parameters(settings: TrainingSettings) -> dict:
    """Return the method parameters set in the panel, by name. The other values come from the preset."""
    group = settings.parameters
    values = {
        f.name: _as_typed(getattr(group, f.name))
        for f in panel_parameters(settings.method)
        if group.is_property_set(f.name)
    }
    if has_level_distances(settings.method) and not settings.find_distances:
        indices = [index for _, index in level_distances(settings)]
        values["distances"] = (*(_as_typed(settings.distances[index]) for index in indices), 0.0)
    return values


def current_parameters(settings: TrainingSettings) -> Parameters:
    """Return all parameters for the settings in the panel. Results are cached.

    Raises:
        LodgsError: a setting is invalid.
    """
    return _parameters(settings.method, settings.preset, tuple(changed_parameters(settings).items()))


@lru_cache
def _parameters(method: str, preset: str, changes: tuple[tuple[str, Any], ...]) -> Parameters:
    return resolve_parameters(method, preset, dict(changes))


def _as_typed(value):
    """Return a number as the user typed it, such as 0.65: Blender stores it rounded to 32 bits."""
    return float(str(np.float32(value))) if isinstance(value, float) else value


def apply_job(settings: TrainingSettings, job: Job) -> None:
    """Copy the values of a job to the training settings that the panel has."""
    for name in (*PANEL_KEYS, "views", "view_width"):
        setattr(settings, name, getattr(job, name))
    settings.region = crops.region_object(settings.id_data, job.crop) if job.crop else None
    settings.start_from = "FILE" if job.base else "POINTS"
    settings.columns, settings.rows = job.grid if job.cells else (1, 1)
    preset = method_info(job.method).preset(job.preset)
    parameters = job.resolved_parameters()
    for f in panel_parameters(job.method):
        settings.parameters.property_unset(f.name)
        if getattr(parameters, f.name) != getattr(preset, f.name):
            setattr(settings.parameters, f.name, getattr(parameters, f.name))
    settings.property_unset("distances")
    settings.find_distances = not any(getattr(parameters, "distances", ()))
    if has_level_distances(job.method) and not settings.find_distances:
        for number, index in level_distances(settings):
            settings.distances[index] = parameters.distances[number - 1]


def base_path(root: bpy.types.Object, out: Path) -> str:
    """Return the path of the splats that the next training starts from (``Job.base``).

    Args:
        root: scene root.
        out: folder of the new run.

    Returns:
        A path, or "" to start from the points of the scene.

    Raises:
        LodgsError: the root has no finished run, or no file is chosen.
    """
    settings = root.lodgs.training
    if not method_info(settings.method).from_base or settings.start_from == "POINTS":
        return ""
    if settings.start_from == "FILE":
        if not settings.base:
            raise LodgsError(
                "Cannot start from a file: no file is chosen.",
                "Choose a PLY or a run folder, or start from points.",
            )
        return str(absolute_path(settings.base))
    if settings.start_from == "SCENE":
        return str(RunFolder(out).base)
    run = run_folder(root)
    if run is None or run_state(run) != "done":
        raise LodgsError(
            f"Cannot start from a run: '{root.name}' has no finished run.",
            "Finish one first, or start from points.",
        )
    return str(run.path)
