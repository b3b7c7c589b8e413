"""Conversion between the training settings of a scene root and jobs."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.methods import method_info, parameters_of
from ...training.optimize.parameters import Parameters
from ...training.runs.folder import RunFolder
from ...training.runs.job import DOME, Job
from .. import extension
from ..data import crops, viewpoints
from ..data.training import chooses_distances, hold_out, level_distances, offered
from .run_folders import run_folder, run_state

if TYPE_CHECKING:
    from ..data.training import TrainingSettings


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
        "parameters": changed_parameters(settings) | parameters,
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
    base = base_path(root, out)
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


def changed_parameters(settings: TrainingSettings) -> dict:
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


def current_parameters(settings: TrainingSettings) -> Parameters:
    """The parameters of the training that the panel describes; found anew only when a choice changes.

    Raises:
        LodgsError: a choice is impossible.
    """
    return _parameters(settings.method, settings.preset, tuple(changed_parameters(settings).items()))


@lru_cache
def _parameters(method: str, preset: str, changes: tuple[tuple[str, Any], ...]) -> Parameters:
    return parameters_of(method, preset, dict(changes))


def _as_typed(value):
    """A number as its artist typed it, such as 0.65: Blender keeps the nearest one of 32 bits."""
    return float(str(np.float32(value))) if isinstance(value, float) else value


def apply_job(settings: TrainingSettings, job: Job) -> None:
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


def base_path(root: bpy.types.Object, out: Path) -> str:
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
    if run is None or run_state(run) != "done":
        raise LodgsError(
            f"'{root.name}' has no finished run to start from.", "Finish one first, or start from points."
        )
    return str(run.path)
