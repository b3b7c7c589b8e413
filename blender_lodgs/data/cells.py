"""Plan of the cells of a large scene, stored on its root (``training_settings``)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...training.runs.cells.plan import PlannedCell, choose_cells, plan, read_planned_scene
from ...training.runs.job import Job
from ...training.scenes.colmap import Scene
from ...training.scenes.regions import Region
from . import photographs

if TYPE_CHECKING:
    from .training_settings import TrainingCell, TrainingSettings

GROUND_QUANTILE = 0.01
"""Quantile of the point heights at which cells are drawn."""
MARGIN = 0.05
"""Margin of unbounded cells beyond the cameras, as a fraction of the cameras' longer side."""
_PLAN_KEYS = (
    "scene",
    "model",
    "images",
    "method",
    "preset",
    "image_scale",
    "test_every",
    "cells",
    "parameters",
)
"""Job keys that determine the plan."""


@dataclass(frozen=True)
class CellPlan:
    """Plan of a job's cells.

    Attributes:
        job: job with the planned grid in ``cells``; "" for a single cell.
        planned: planned cells.
        outlines: corners of each cell; see :func:`outlines`.
        view_indices: indices of each cell's views, sorted by name.
    """

    job: Job
    planned: list[PlannedCell]
    outlines: list[tuple[np.ndarray, np.ndarray]]
    view_indices: list[list[int]]


def plan_cells(job: Job, splats: int = 0, memory: int = 0) -> CellPlan:
    """Plan the cells of a job. Takes a while; needs no bpy and may run in a thread.

    Args:
        splats: maximum number of splats per cell; the job gets the fewest cells within it. 0 for no limit.
        memory: maximum number of bytes per cell, in the same way. Without both, the job's own grid is used.

    Raises:
        LodgsError: the scene cannot be read or divided into these cells.
    """
    scene = read_planned_scene(job)
    if splats or memory:
        job = job.with_cells(choose_cells(job.with_cells("1x1"), splats, memory, scene))
    planned = plan(job, scene)
    if len(planned) == 1:
        job = replace(job, cells="")
    regions = [cell.region for cell in planned]
    index_of = {name: index for index, name in enumerate(scene.names)}
    view_indices = [[index_of[name] for name in region.views] for region in regions]
    return CellPlan(job, planned, outlines(scene, regions), view_indices)


def outlines(scene: Scene, regions: list[Region]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the corners on the ground of each cell and of its enlarged area, in COLMAP's world.

    Unbounded sides end shortly beyond the cameras.

    Returns:
        Pairs of (4, 3) arrays.
    """
    ground = regions[0].ground
    centers = np.array([camera.center for camera in scene.cameras]) @ ground.T
    low, high = centers[:, :2].min(axis=0), centers[:, :2].max(axis=0)
    margin = MARGIN * (high - low).max()
    height = np.quantile(scene.points.astype(np.float64) @ ground[2], GROUND_QUANTILE)

    def corners(bounds: np.ndarray) -> np.ndarray:
        a, b, c, d = np.clip(bounds, (low - margin)[:, None], (high + margin)[:, None]).ravel()
        return np.array([(a, c, height), (b, c, height), (b, d, height), (a, d, height)]) @ ground

    return [(corners(region.cell), corners(region.area)) for region in regions]


def store_plan(settings: TrainingSettings, cell_plan: CellPlan) -> None:
    """Store a plan for the panel and the viewports."""
    settings.columns, settings.rows = cell_plan.job.grid if cell_plan.job.cells else (1, 1)
    resize_cells(settings, len(cell_plan.planned))
    entries = zip(
        settings.planned_cells, cell_plan.planned, cell_plan.outlines, cell_plan.view_indices, strict=True
    )
    for cell, planned, (outline, enlarged), view_indices in entries:
        cell.views, cell.points = planned.views, planned.points
        cell.splats, cell.steps, cell.megabytes = planned.splats, planned.steps, planned.memory / 1e6
        cell.outline, cell.enlarged, cell.view_indices = (
            outline.ravel(),
            enlarged.ravel(),
            json.dumps(view_indices),
        )
    settings.planned_for = _plan_key(settings, cell_plan.job)


def resize_cells(settings: TrainingSettings, count: int) -> None:
    """Set the number of cells; another number clears the stored plan."""
    if len(settings.planned_cells) != count:
        clear_plan(settings)
        for _ in range(count):
            settings.planned_cells.add()


def clear_plan(settings: TrainingSettings) -> None:
    """Clear the stored plan."""
    settings.planned_cells.clear()
    settings.active_cell, settings.planned_for = 0, ""


def is_planned(settings: TrainingSettings, job: Job) -> bool:
    """Return True if the stored plan belongs to a job and to the current division settings."""
    return settings.planned_for == _plan_key(settings, job)


def _plan_key(settings: TrainingSettings, job: Job) -> str:
    values = asdict(job)
    return json.dumps([*(values[name] for name in _PLAN_KEYS), *settings.limits])


def cell_cameras(root: bpy.types.Object, cell: TrainingCell) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (V, 3) and frame corners (V, 4, 3) of a cell's existing cameras, in scene units."""
    view_indices = set(json.loads(cell.view_indices or "[]"))
    cameras = [view for view in photographs.views(root) if view.data.lodgs.model_index in view_indices]
    poses = np.array([view.matrix_basis for view in cameras], np.float64).reshape(-1, 4, 4)
    half_sizes = [(v.width / v.fx / 2, v.height / v.fy / 2) for v in (view.data.lodgs for view in cameras)]
    frames = [[(-x, y, -1), (x, y, -1), (x, -y, -1), (-x, -y, -1)] for x, y in half_sizes]
    sizes = np.array([view.data.display_size for view in cameras])
    corners = sizes[:, None, None] * np.reshape(frames, (-1, 4, 3)) @ poses[:, :3, :3].swapaxes(1, 2)
    return poses[:, :3, 3], poses[:, None, :3, 3] + corners
