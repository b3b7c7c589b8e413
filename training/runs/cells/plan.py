"""Divide a job with cells into ordinary jobs, one per cell. Imports no torch.

run/  job.toml (with ``cells``)  blocks/
    coarse/job.toml             coarse levels of the full scene, if the method trains them separately
    1/job.toml  region.json     a cell; starts from the coarse levels if there are any
    seams/1/job.toml  region.json   the same cell, whose borders are fitted to its neighbours
    whole.ply                   merged bundle, if it is the base of another method
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError, system_reason
from ...files import temporary_folder
from ...lod.rule import resolve_rule
from ...methods import method_info
from ...optimize.memory import MAX_BYTES, TARGET_BYTES
from ...optimize.parameters import Parameters
from ...scenes.colmap import Scene, read_scene
from ...scenes.regions import Region, plan_cells
from ...scenes.triangulate import cached_points
from ..base import base_origin
from ..events import PART_KINDS
from ..folder import RunFolder
from ..job import MAX_CELLS, Job

REGION = "region.json"
COARSE, CELL, SEAM = PART_KINDS
"""Kinds of parts: coarse levels of the full scene, a cell, and a cell whose borders are fitted. Files, events
and commands call a cell a block."""
SEAM_METHOD = "3dgs"
"""Method that fits a cell's borders. At full detail, the splats of all methods are plain 3DGS splats."""
SEAM_PARAMETERS = {
    "lr_means": 0.0, "lr_means_final": 0.0, "lr_quats": 0.0, "lr_scales": 0.0, "lr_opacities": 1e-2,
    "lr_sh": 1e-3, "densify_until": 0.0, "prune_interval": 0, "opacity_reset_interval": 0,
    "least_weight": 0.0, "first_resolution": 1.0, "far_share": 0.0, "free_depth": 0.0, "largest": 0.0,
    "margin": 0.0,
}  # fmt: skip
"""Parameters that fit only colours and opacities: splats are not moved, resized, added or removed, so that
each stays in its cell and keeps the size of its level."""
MAX_CELL_ASPECT = 2.5
"""Maximum length of automatically chosen cells, as a multiple of their width."""
PROGRAM_BYTES = 650e6
"""Approximate memory of a trainer without splats and photos."""
SPLAT_BYTES = 2_300
"""Approximate memory per trained splat of degree 3."""


@dataclass(frozen=True)
class Part:
    """Part of a divided run, trained as an ordinary run.

    Attributes:
        number: cell number, from 1; 0 for the coarse part.
        folder: its run folder.
        region: its cell; None for the full scene.
    """

    number: int
    folder: RunFolder
    region: Region | None

    @property
    def kind(self) -> str:
        """COARSE, CELL or SEAM."""
        return COARSE if self.region is None else SEAM if self.region.seam else CELL

    @property
    def name(self) -> str:
        """Name for messages."""
        cell = f"cell {self.number}"
        return {COARSE: "coarse levels", CELL: cell, SEAM: f"border of {cell}"}[self.kind]

    @cached_property
    def job(self) -> Job:
        """Its job, as stored."""
        return Job.from_file(self.folder.job)


@dataclass(frozen=True)
class Division:
    """Parts of a divided run, in stages that are trained one after the other.

    Attributes:
        coarse: coarse levels of the full scene; None if the cells train all levels.
        cells: one part per cell, by number.
        seams: parts that fit the borders of cells; empty without polishing.
    """

    coarse: Part | None
    cells: list[Part]
    seams: list[Part]

    @property
    def stages(self) -> list[list[Part]]:
        """Parts that can be trained in parallel, stage by stage."""
        return [[self.coarse] if self.coarse else [], self.cells, self.seams]

    def part(self, name: str) -> Part | None:
        """Return the part ``coarse``, ``block-3`` or ``seam-3``; None if this division does not need it.

        Raises:
            LodgsError: the name is not a part's.
        """
        kind, _, number = name.partition("-")
        numbers = [str(cell.number) for cell in self.cells]
        if name != COARSE and not (kind in (CELL, SEAM) and number in numbers):
            last = numbers[-1]
            raise LodgsError(
                f"Unknown part '{name}'.",
                f"Use coarse, block-1 to block-{last}, or seam-1 to seam-{last}.",
            )
        parts = [part for stage in self.stages for part in stage if part.kind == kind]
        return next((part for part in parts if number in ("", str(part.number))), None)


@dataclass(frozen=True)
class PlannedCell:
    """Cell of a plan, before training.

    Attributes:
        number: cell number, from 1.
        region: the cell on the ground, and its views.
        job: job that trains it, still with the run folder of the full scene.
        views: number of training views.
        points: number of initial points.
        steps: number of training steps.
        splats: maximum number of splats.
        memory: estimated memory of its trainer in bytes, with photos.
    """

    number: int
    region: Region
    job: Job
    views: int
    points: int
    steps: int
    splats: int
    memory: int


def read_planned_scene(job: Job, add_points: Callable[[Scene], Scene] | None = None) -> Scene:
    """Read the scene of a job with cells.

    Args:
        add_points: adds points to a scene without points; None for those in its cache.

    Raises:
        LodgsError: the scene cannot be read, or has no points.
    """
    model, images = job.model_and_images
    scene = read_scene(Path(job.scene), model=model, images=images, origin=base_origin(job))
    scene = add_points(scene) if add_points else cached_points(scene, job.exposure)
    if not len(scene.points):
        raise LodgsError(
            f"Cannot divide scene: the COLMAP model in {scene.model} has no 3D points.",
            f"Triangulate them: lodgs blocks plan {job.scene}.",
        )
    return scene


def plan(job: Job, scene: Scene | None = None) -> list[PlannedCell]:
    """Divide a job's scene into cells and estimate the cost of each; write nothing.

    A cell's steps are proportional to its views, so that every view is used as often as in a single run; its
    splats are proportional to its points.

    Args:
        job: the job.
        scene: the job's scene, if already read.

    Raises:
        LodgsError: the scene cannot be read, or not divided into these cells.
    """
    if not job.cells:
        raise LodgsError("Cannot plan cells: the scene has only one cell.", "Use at least 2 cells.")
    scene = read_planned_scene(job) if scene is None else scene
    undivided, _ = _divided(job)
    training = _training_views(job, scene)
    pixels = float(np.mean([camera.width * camera.height for camera in scene.cameras])) * job.image_scale**2
    cells = []
    for number, region in enumerate(plan_cells(scene, *job.grid), 1):
        views, points = len(training & set(region.views)), int(region.start_points(scene).sum())
        if views < 2 or not points:
            raise LodgsError(
                f"Cannot train cell {number}: it has {views} view(s) and {points} point(s), but needs 2 "
                "views and 1 point.",
                "Use fewer cells.",
            )
        share = views / len(training)
        limit = undivided.max_splats
        splats = max(round(limit * points / len(scene.points)), 1) if limit else 0
        steps: Any = _scaled(undivided.steps, share)  # a tuple in FLoD
        parameters = replace(undivided, steps=steps, max_splats=splats)
        memory = _memory(parameters, views, pixels, job.photo_memory)
        cell_job = _part_job(job, parameters)
        cells.append(
            PlannedCell(number, region, cell_job, views, points, parameters.total_steps, splats, memory)
        )
    return cells


def choose_cells(job: Job, splats: int = 0, memory: int = 0, scene: Scene | None = None) -> str:
    """Return the smallest grid, as in ``Job.cells``, whose cells stay within the limits.

    Args:
        job: the job.
        splats: maximum number of splats per cell; 0 is unlimited.
        memory: maximum memory per cell in bytes, as estimated by ``plan``; 0 is unlimited.
        scene: the job's scene, if already read.

    Raises:
        LodgsError: no possible grid stays within the limits.
    """
    scene = read_planned_scene(job) if scene is None else scene
    total = _divided(job)[0].max_splats
    if not total and (splats or memory):
        raise LodgsError(
            "Cannot choose cells by a limit: the job's number of splats is unlimited.",
            "Set max_splats, or give the number of cells.",
        )
    failure = None
    for grid in _grids(scene, total / splats if splats else 1):
        try:
            cells = plan(replace(job, cells=grid), scene)
        except LodgsError as error:
            raise failure or error from None
        largest = max(cell.splats for cell in cells)
        peak = max(cell.memory for cell in cells)
        if largest <= (splats or largest) and peak <= (memory or peak):
            return grid
        failure = LodgsError(
            f"Cannot divide scene within the limit: in {grid} cells the largest has {largest:,} splats and "
            f"needs {peak / 1e9:.1f} GB.",
            "Raise the limit per cell, or lower max_splats.",
        )
    raise failure or LodgsError(
        f"Cannot divide scene within the limit: {MAX_CELLS} cells, the maximum, are not enough.",
        "Raise the limit per cell.",
    )


def write_plan(
    job: Job,
    folder: RunFolder,
    scene: Scene | None = None,
    planned: list[PlannedCell] | None = None,
    add_points: Callable[[Scene], Scene] | None = None,
) -> Division:
    """Write a job's parts into the run folder; keep an existing division.

    Args:
        job: the job.
        folder: its run.
        scene, planned: the job's scene and cells, if already available.
        add_points: see :func:`read_planned_scene`.

    Raises:
        LodgsError: see :func:`plan`, or the folder cannot be written.
    """
    if not folder.blocks.exists():
        scene = scene or read_planned_scene(job, add_points)
        cells = planned or plan(job, scene)
        _, coarse = _divided(job)
        training = _training_views(job, scene)
        try:
            with temporary_folder(folder.path) as work:
                temporary = RunFolder(work)
                if coarse is not None:
                    _write_part(_part_job(job, coarse), temporary.coarse)
                for cell in cells:
                    path = temporary.blocks / str(cell.number)
                    _write_part(cell.job, path, cell.region, temporary.coarse if coarse else None)
                    seam = cell.region.as_seam(scene)
                    if _polishes(job) and len(training & set(seam.views)) > 1:
                        path = temporary.seams / str(cell.number)
                        _write_part(_seam_job(job), path, seam, RunFolder(path).base)
                shutil.move(temporary.blocks, folder.blocks)
        except OSError as error:
            raise LodgsError(
                f"Cannot write cells to {folder.path}: {system_reason(error)}.",
                "Choose a writable folder on a disk with free space.",
            ) from error
    return read_plan(folder)


def read_plan(folder: RunFolder) -> Division:
    """Read the parts of a divided run.

    Raises:
        LodgsError: the run has no parts, or one is damaged.
    """
    cells = _read_parts(folder.blocks)
    if not cells:
        raise LodgsError(
            f"Cannot train cells of {folder.path}: none are planned.",
            "Plan them with lodgs blocks plan, or in the panel.",
        )
    coarse = RunFolder(folder.coarse)
    return Division(Part(0, coarse, None) if coarse.job.exists() else None, cells, _read_parts(folder.seams))


def read_planned_job(path: Path) -> Job:
    """Read the job of a divided run.

    Raises:
        LodgsError: the job does not exist or has no cells.
    """
    job = Job.from_file(RunFolder(path).job)
    if not job.cells:
        raise LodgsError(
            f"Cannot train cells of {path}: the run is not divided.",
            "Train its job directly, or plan it with --cells.",
        )
    return job


def plan_table(planned: list[PlannedCell]) -> str:
    """Format the cost of each cell as a table."""
    lines = [" cell   views    points      max splats     steps  approx. memory"]
    for cell in planned:
        splats = f"{cell.splats:,}" if cell.splats else "unlimited"
        lines.append(
            f"{cell.number:5}{cell.views:8,}{cell.points:10,}{splats:>16}{cell.steps:10,}"
            f"{cell.memory / 1e9:13.1f} GB"
        )
    return "\n".join(lines)


def _training_views(job: Job, scene: Scene) -> set[str]:
    return {camera.name for camera in scene.split(job.test_every, job.validation)[0]}


def _divided(job: Job) -> tuple[Parameters, Parameters | None]:
    """Return the cells' parameters for an undivided scene, and those of the coarse part or None."""
    method = method_info(method_info(job.method).cell_method)
    values = asdict(job.resolved_parameters())
    names = {field.name for field in fields(method.parameters)}
    values = {name: value for name, value in values.items() if name in names}
    parameters = method.parameters(**values | dict(method.cell_values))
    coarse, fine = method.split_parameters(parameters) or (None, parameters)
    return fine, coarse


def _part_job(job: Job, parameters: Parameters, method: str = "") -> Job:
    values = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(parameters).items()}
    method = method or method_info(job.method).cell_method
    return replace(job, method=method, cells="", polish=0, parameters=values)


def _polishes(job: Job) -> bool:
    """Return whether borders of cells are fitted; the rule must not weight splats at full detail."""
    rule = resolve_rule(method_info(method_info(job.method).cell_method).rule)
    return job.polish > 0 and not rule.weights_full_detail


def _seam_job(job: Job) -> Job:
    parameters, _ = _divided(job)
    common: dict[str, Any] = {field.name: getattr(parameters, field.name) for field in fields(Parameters)}
    preset = method_info(SEAM_METHOD).preset(job.preset)
    changes: dict[str, Any] = {**common, "steps": job.polish, **SEAM_PARAMETERS}
    return _part_job(job, replace(preset, **changes), SEAM_METHOD)


def _write_part(job: Job, path: Path, region: Region | None = None, base: Path | None = None) -> None:
    path.mkdir(parents=True)
    region_path = ""
    if region is not None:
        region.write(path / REGION)
        region_path = str(path / REGION)
    base_path = "" if base is None else str(base)
    replace(job, out=str(path), region=region_path, base=base_path).write(path / "job.toml")


def _read_parts(folder: Path) -> list[Part]:
    numbers = sorted(int(path.name) for path in folder.glob("*") if path.name.isdecimal())
    return [
        Part(number, RunFolder(path := folder / str(number)), Region.read(path / REGION))
        for number in numbers
    ]


def _grids(scene: Scene, min_cells: float) -> Iterator[str]:
    """Yield grids with increasing numbers of nearly square cells, as in ``Job.cells``."""
    ground = scene.up_rotation()
    centers = np.array([camera.center for camera in scene.cameras]) @ ground.T
    longer, shorter = sorted(np.ptp(centers[:, :2], axis=0), reverse=True)
    aspect = min(longer / max(shorter, 1e-9), MAX_CELLS)
    for count in range(ceil(min_cells), MAX_CELLS + 1):
        grids = ((count // rows, rows) for rows in range(1, count + 1) if count % rows == 0)
        log_aspect, columns, rows = min((abs(float(np.log(aspect * b / a))), a, b) for a, b in grids)
        if log_aspect <= np.log(MAX_CELL_ASPECT) or count == 1:
            yield f"{columns}x{rows}"


def _memory(parameters: Parameters, views: int, pixels: float, photo_memory: int) -> int:
    """Estimate a trainer's memory in bytes."""
    photos = min(views * pixels * TARGET_BYTES, photo_memory * 1e6 or MAX_BYTES)
    return round(PROGRAM_BYTES + SPLAT_BYTES * parameters.max_trained_splats + photos)


def _scaled(steps: int | tuple[int, ...], share: float) -> int | tuple[int, ...]:
    if isinstance(steps, tuple):
        return tuple(max(round(count * share), 1) for count in steps)
    return max(round(steps * share), 1)
