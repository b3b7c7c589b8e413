"""The cells that a large scene is trained in: what their plan says, kept on its root (``training``)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ...training.runs.blocks.plan import plan
from ...training.runs.job import Job
from ...training.scenes.colmap import Scene, read_scene
from ...training.scenes.regions import ENLARGED, Region
from . import photographs

if TYPE_CHECKING:
    from .training import TrainingCell, TrainingSettings

GROUND = 0.01
"""The quantile of the points' heights at which cells are shown."""
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


@dataclass
class PlannedCell:
    """What a plan says of a cell, as ``TrainingCell`` keeps it."""

    views: int
    points: int
    splats: int
    steps: int
    megabytes: float
    outline: np.ndarray
    enlarged: np.ndarray
    places: str


def plan_cells(job: Job) -> list[PlannedCell]:
    """What each cell of a job will be trained on, and take. No bpy: it may take a while, in a thread.

    Raises:
        LodgsError: the scene cannot be read, or divided so.
    """
    model, images = (Path(path) if path else None for path in (job.model, job.images))
    scene = read_scene(Path(job.scene), model, images)
    places = {camera.name: place for place, camera in enumerate(scene.cameras)}
    planned = plan(job, scene)
    found = []
    for (region, block), (outline, enlarged) in zip(
        planned, outlines(scene, [region for region, _ in planned]), strict=True
    ):
        p = block.resolved_parameters()
        found.append(
            PlannedCell(
                len(region.views), int(region.points_of(scene).sum()), p.max_splats, p.total_steps, 0.0,
                outline.ravel(), enlarged.ravel(), json.dumps([places[name] for name in region.views]),
            )
        )  # fmt: skip
    return found


def outlines(scene: Scene, regions: list[Region]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The corners (4, 3) on the ground of each cell and of the same enlarged, in COLMAP's world.

    What has no end does not reach far beyond the cameras here.
    """
    ground = regions[0].ground
    stand = np.array([camera.center for camera in scene.cameras]) @ ground.T
    low, high = stand[:, :2].min(axis=0), stand[:, :2].max(axis=0)
    reach = ENLARGED * (high - low).max()
    height = np.quantile(scene.points.astype(np.float64) @ ground[2], GROUND)

    def corners(bounds: np.ndarray) -> np.ndarray:
        a, b, c, d = np.clip(bounds, (low - reach)[:, None], (high + reach)[:, None]).ravel()
        return np.array([(a, c, height), (b, c, height), (b, d, height), (a, d, height)]) @ ground

    return [(corners(region.cell), corners(region.area)) for region in regions]


def show(settings: TrainingSettings, job: Job, planned: list[PlannedCell]) -> None:
    """Keeps the plan of a job, for the panel and for viewports."""
    require(settings, len(planned))
    for cell, values in zip(settings.planned_cells, planned, strict=True):
        for name, value in vars(values).items():
            setattr(cell, name, value)
    settings.planned_for = _decides(job)


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
    """Whether the plan that is kept is a job's."""
    return settings.planned_for == _decides(job)


def _decides(job: Job) -> str:
    values = asdict(job)
    return json.dumps([values[name] for name in _DECIDES])


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
