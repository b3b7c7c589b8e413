"""The cells that a large scene is trained in: what their plan says, kept on its root (``training``)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...training.runs.blocks.plan import PlannedCell, choose_cells, plan, read_planned_scene
from ...training.runs.job import Job
from ...training.scenes.colmap import Scene
from ...training.scenes.regions import Region
from . import photographs

if TYPE_CHECKING:
    from .training import TrainingCell, TrainingSettings

GROUND = 0.01
"""The quantile of the points' heights at which cells are shown."""
BEYOND = 0.05
"""Share of the cameras' longer side by which cells without end are shown to reach beyond them."""
_DECIDES = (
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
"""What of a job its plan depends on."""


@dataclass(frozen=True)
class CellPlan:
    """What a plan says of the cells of a job.

    Attributes:
        job: whose ``cells`` say how many there are; "" for one.
        planned: each of them.
        outlines: of each, see :func:`outlines`.
        places: of each, the places by name of its views.
    """

    job: Job
    planned: list[PlannedCell]
    outlines: list[tuple[np.ndarray, np.ndarray]]
    places: list[list[int]]


def plan_cells(job: Job, splats: int = 0, memory: int = 0) -> CellPlan:
    """Plans the cells of a job. No bpy: it may take a while, in a thread.

    Args:
        splats, memory: of how many splats, or bytes, each cell has at most; the job then has as few cells as
            do. 0: as many as the job says.

    Raises:
        LodgsError: the scene cannot be read, or divided so.
    """
    scene = read_planned_scene(job)
    if splats or memory:
        job = job.with_cells(choose_cells(job.with_cells("1x1"), splats, memory, scene))
    planned = plan(job, scene)
    if len(planned) == 1:
        job = replace(job, cells="")
    regions = [each.region for each in planned]
    place_of = {name: place for place, name in enumerate(scene.names)}
    places = [[place_of[name] for name in region.views] for region in regions]
    return CellPlan(job, planned, outlines(scene, regions), places)


def outlines(scene: Scene, regions: list[Region]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The corners (4, 3) on the ground of each cell and of the same enlarged, in COLMAP's world.

    What has no end does not reach far beyond the cameras here.
    """
    ground = regions[0].ground
    stand = np.array([camera.center for camera in scene.cameras]) @ ground.T
    low, high = stand[:, :2].min(axis=0), stand[:, :2].max(axis=0)
    reach = BEYOND * (high - low).max()
    height = np.quantile(scene.points.astype(np.float64) @ ground[2], GROUND)

    def corners(bounds: np.ndarray) -> np.ndarray:
        a, b, c, d = np.clip(bounds, (low - reach)[:, None], (high + reach)[:, None]).ravel()
        return np.array([(a, c, height), (b, c, height), (b, d, height), (a, d, height)]) @ ground

    return [(corners(region.cell), corners(region.area)) for region in regions]


def show(settings: TrainingSettings, found: CellPlan) -> None:
    """Keeps a plan, for the panel and for viewports."""
    settings.columns, settings.rows = found.job.grid if found.job.cells else (1, 1)
    require(settings, len(found.planned))
    each = zip(settings.planned_cells, found.planned, found.outlines, found.places, strict=True)
    for cell, planned, (outline, enlarged), places in each:
        cell.views, cell.points = planned.views, planned.points
        cell.splats, cell.steps, cell.megabytes = planned.splats, planned.steps, planned.memory / 1e6
        cell.outline, cell.enlarged, cell.places = outline.ravel(), enlarged.ravel(), json.dumps(places)
    settings.planned_for = _decides(settings, found.job)


def require(settings: TrainingSettings, count: int) -> None:
    """Makes sure that there are so many cells; those of another plan are forgotten."""
    if len(settings.planned_cells) != count:
        forget(settings)
        for _ in range(count):
            settings.planned_cells.add()


def forget(settings: TrainingSettings) -> None:
    """Forgets the plan."""
    settings.planned_cells.clear()
    settings.active_cell, settings.planned_for = 0, ""


def is_planned(settings: TrainingSettings, job: Job) -> bool:
    """Whether the plan that is kept is that of a job, and of how the settings divide it."""
    return settings.planned_for == _decides(settings, job)


def _decides(settings: TrainingSettings, job: Job) -> str:
    values = asdict(job)
    return json.dumps([*(values[name] for name in _DECIDES), *settings.limits])


def eyes(root: bpy.types.Object, cell: TrainingCell) -> tuple[np.ndarray, np.ndarray]:
    """Where the cameras of a cell stand (V, 3), and the corners (V, 4, 3) of their frames in the viewport, in
    the scene's own units; of those that are still there."""
    places = set(json.loads(cell.places or "[]"))
    found = [view for view in photographs.views(root) if view.data.lodgs.place in places]
    poses = np.array([view.matrix_basis for view in found], np.float64).reshape(-1, 4, 4)
    halves = [(v.width / v.fx / 2, v.height / v.fy / 2) for v in (view.data.lodgs for view in found)]
    frames = [[(-x, y, -1), (x, y, -1), (x, -y, -1), (-x, -y, -1)] for x, y in halves]
    sizes = np.array([view.data.display_size for view in found])
    corners = sizes[:, None, None] * np.reshape(frames, (-1, 4, 3)) @ poses[:, :3, :3].swapaxes(1, 2)
    return poses[:, :3, 3], poses[:, None, :3, 3] + corners
