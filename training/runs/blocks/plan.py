"""From a job with cells to a block for each: ordinary jobs in folders of their own. No torch.

run/  job.toml (with ``cells``)  blocks/
    coarse/job.toml             levels that are trained on the whole scene, where the method divides them so
    1/job.toml  region.json     a cell; begins with the coarse levels, where there are some
    seams/1/job.toml  region.json   the same cell, whose borders are fitted to the cells beside it
    whole.ply                   what all are together, where that is another method's base
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from math import ceil
from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ...lod.rule import find_rule
from ...methods import method_info
from ...optimize.memory import MOST_BYTES, TARGET_BYTES
from ...optimize.parameters import Parameters
from ...scenes.colmap import Scene, read_scene
from ...scenes.regions import Region, plan_cells
from ..folder import RunFolder
from ..job import MAX_CELLS, Job

REGION = "region.json"
COARSE, BLOCK, SEAM = "coarse", "block", "seam"
"""Kinds of parts: levels of the whole scene, a cell, and a cell whose borders are fitted to others."""
POLISHED_BY = "3dgs"
"""What fits a cell's borders to those beside it: at full detail all methods' splats are its."""
STILL = {
    "lr_means": 0.0, "lr_means_final": 0.0, "lr_quats": 0.0, "lr_scales": 0.0, "lr_opacities": 1e-2,
    "lr_sh": 1e-3, "densify_until": 0.0, "prune_interval": 0, "opacity_reset_interval": 0,
    "least_weight": 0.0, "first_resolution": 1.0, "free_depth": 0.0, "largest": 0.0, "margin": 0.0,
}  # fmt: skip
"""Its parameters there: colours and opacities are fitted; splats neither move nor come or go, so that each
stays in its cell, and as large as its level allows."""
SLIMMEST = 2.5
"""No cells that are so many times longer than wide are chosen."""
PROGRAM_BYTES = 650e6
"""What a trainer takes of memory without splats and photographs, about."""
SPLAT_BYTES = 2_300
"""What it takes for each splat that it trains, of degree 3, about."""


@dataclass(frozen=True)
class Block:
    """A part of a divided run, and the ordinary run that trains it.

    Attributes:
        number: of its cell, from 1; 0 for what is trained on the whole scene.
        folder: of its run.
        region: what it is trained on; None for the whole scene.
    """

    number: int
    folder: RunFolder
    region: Region | None

    @property
    def kind(self) -> str:
        """COARSE, BLOCK or SEAM."""
        return COARSE if self.region is None else SEAM if self.region.seam else BLOCK

    @property
    def name(self) -> str:
        """What people call it."""
        return "coarse levels" if self.region is None else f"{self.kind} {self.number}"

    @cached_property
    def job(self) -> Job:
        """Its job, as it was written."""
        return Job.from_file(self.folder.job)


@dataclass(frozen=True)
class Division:
    """All parts of a divided run; each stage begins when the one before it is finished.

    Attributes:
        coarse: what is trained once on the whole scene; None where cells make all levels.
        blocks: one for each cell, by number.
        seams: these again, whose borders are fitted to each other; of cells without such there is none.
    """

    coarse: Block | None
    blocks: list[Block]
    seams: list[Block]

    @property
    def stages(self) -> list[list[Block]]:
        """What can be trained side by side, in order."""
        return [[self.coarse] if self.coarse else [], self.blocks, self.seams]

    def part(self, name: str) -> Block | None:
        """The part ``coarse``, ``block-3`` or ``seam-3``; None where this division needs no such part.

        Raises:
            LodgsError: no division has one called so.
        """
        kind, _, number = name.partition("-")
        numbers = [str(block.number) for block in self.blocks]
        if name != COARSE and not (kind in (BLOCK, SEAM) and number in numbers):
            last = numbers[-1]
            raise LodgsError(
                f"There is no part '{name}'.",
                f"Say coarse, block-1 to block-{last}, or seam-1 to seam-{last}.",
            )
        parts = [part for stage in self.stages for part in stage if part.kind == kind]
        return next((part for part in parts if number in ("", str(part.number))), None)


@dataclass(frozen=True)
class PlannedCell:
    """A cell before anything is trained, for whoever shows or chooses a division.

    Attributes:
        number: from 1.
        region: the cell on the ground, and its views.
        job: what trains it, whose folder is still the whole's.
        views: how many it is trained on.
        points: how many it begins with.
        steps: how many it makes.
        splats: the most that it has.
        memory: bytes that its trainer takes, estimated, with photographs.
    """

    number: int
    region: Region
    job: Job
    views: int
    points: int
    steps: int
    splats: int
    memory: int


def read_planned_scene(job: Job) -> Scene:
    """The scene of a job with cells.

    Raises:
        LodgsError: it cannot be read, or has no points.
    """
    model, images = (Path(path) if path else None for path in (job.model, job.images))
    scene = read_scene(Path(job.scene), model=model, images=images)
    if not len(scene.points):
        raise LodgsError(
            f"The COLMAP model in {scene.model} has no 3D points.", "Triangulate them in COLMAP."
        )
    return scene


def plan(job: Job, scene: Scene | None = None) -> list[PlannedCell]:
    """The cells of a job's scene, each with what its training will take; nothing is written.

    Of the steps each block has as many as it has views, so that every view is seen as often as if the scene
    were trained as a whole; of the splats as many as it has points.

    Args:
        scene: of the job, where it has been read already.

    Raises:
        LodgsError: the scene cannot be read, or divided so.
    """
    scene = read_planned_scene(job) if scene is None else scene
    whole, _ = _divided(job)
    training = _training_views(job, scene)
    pixels = float(np.mean([camera.width * camera.height for camera in scene.cameras])) * job.image_scale**2
    found = []
    for number, region in enumerate(plan_cells(scene, *job.grid), 1):
        views, points = len(training & set(region.views)), int(region.start_points(scene).sum())
        if views < 2 or not points:
            what = f"{views} views and {points} points"
            raise LodgsError(f"Cell {number} has {what}, too little to train on.", "Ask for fewer cells.")
        share = views / len(training)
        splats = max(round(whole.max_splats * points / len(scene.points)), 1)
        its = replace(whole, steps=_scaled(whole.steps, share), max_splats=splats)
        memory = _memory(its, views, pixels, job.photo_memory)
        found.append(
            PlannedCell(number, region, _part_of(job, its), views, points, its.total_steps, splats, memory)
        )
    return found


def choose_cells(job: Job, splats: int = 0, memory: int = 0, scene: Scene | None = None) -> str:
    """The fewest cells of which none has more splats, or takes more memory: a job's ``cells``.

    Args:
        splats: the most of a block; 0: any number.
        memory: the most bytes of a block, as ``plan`` estimates them; 0: any number.

    Raises:
        LodgsError: however many there are, one has more.
    """
    scene = read_planned_scene(job) if scene is None else scene
    whole, trouble = _divided(job)[0].max_splats, None
    for grid in _grids(scene, whole / splats if splats else 1):
        try:
            found = plan(replace(job, cells=grid), scene)
        except LodgsError as error:
            raise trouble or error from None
        largest, most = max(each.splats for each in found), max(each.memory for each in found)
        if largest <= (splats or largest) and most <= (memory or most):
            return grid
        trouble = LodgsError(
            f"In {grid} cells a block still has {largest:,} splats and takes {most / 1e9:.1f} GB.",
            "Allow more for a block, or lower max_splats.",
        )
    raise trouble or LodgsError(
        f"{MAX_CELLS} cells, the most that there can be, are too few.", "Allow more for a block."
    )


def write_plan(
    job: Job, folder: RunFolder, scene: Scene | None = None, planned: list[PlannedCell] | None = None
) -> Division:
    """Writes a job's parts into the run's folder, ready to be trained; parts that are there stay.

    Args:
        scene, planned: of the job, where they are known already.

    Raises:
        LodgsError: as :func:`plan`, or the folder cannot be written.
    """
    if not folder.blocks.exists():
        scene = scene or read_planned_scene(job)
        made, (_, coarse) = planned or plan(job, scene), _divided(job)
        training = _training_views(job, scene)
        try:
            with tempfile.TemporaryDirectory(dir=folder.path, prefix="planning-") as work:
                there = RunFolder(work)
                if coarse is not None:
                    _write_part(_part_of(job, coarse), there.coarse)
                for each in made:
                    path = there.blocks / str(each.number)
                    _write_part(each.job, path, each.region, there.coarse if coarse else None)
                    seam = each.region.as_seam(scene)
                    if _polishes(job) and len(training & set(seam.views)) > 1:
                        path = there.seams / str(each.number)
                        _write_part(_seam_job(job), path, seam, RunFolder(path).base)
                shutil.move(there.blocks, folder.blocks)
        except OSError as error:
            raise LodgsError(
                f"The blocks in {folder.path} cannot be written: {error.strerror or error}.",
                "Choose a folder that you may write to, on a disk with room.",
            ) from error
    return read_plan(folder)


def read_plan(folder: RunFolder) -> Division:
    """The parts of a run that is divided.

    Raises:
        LodgsError: there are none, or one is damaged.
    """
    blocks = _read_parts(folder.blocks)
    if not blocks:
        raise LodgsError(f"{folder.path} has no blocks.", "Plan them first.")
    coarse = RunFolder(folder.coarse)
    return Division(
        Block(0, coarse, None) if coarse.job.exists() else None, blocks, _read_parts(folder.seams)
    )


def read_planned_job(path: Path) -> Job:
    """The job of a run that is divided.

    Raises:
        LodgsError: there is none.
    """
    job = Job.from_file(RunFolder(path).job)
    if not job.cells:
        raise LodgsError(f"{path} is not divided into cells.", "Train its job, or plan it with --cells.")
    return job


def plan_table(planned: list[PlannedCell]) -> str:
    """What each block will take, for people."""
    lines = ["block   views    points  splats at most     steps  memory, about"]
    for each in planned:
        lines.append(
            f"{each.number:5}{each.views:8,}{each.points:10,}{each.splats:16,}{each.steps:10,}"
            f"{each.memory / 1e9:12.1f} GB"
        )
    return "\n".join(lines)


def _training_views(job: Job, scene: Scene) -> set[str]:
    return {camera.name for camera in scene.split(job.test_every, job.validation)[0]}


def _divided(job: Job) -> tuple[Parameters, Parameters | None]:
    """Parameters of the cells, as if one had all of the scene, and of what is trained on all of it."""
    method = method_info(method_info(job.method).in_cells)
    told = asdict(job.resolved_parameters())
    known = {field.name for field in fields(method.parameters)}
    whole = method.parameters(**{name: value for name, value in told.items() if name in known})
    coarse, fine = method.divided(whole) or (None, whole)
    return fine, coarse


def _part_of(job: Job, parameters: Parameters, method: str = "") -> Job:
    values = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(parameters).items()}
    method = method or method_info(job.method).in_cells
    return replace(job, method=method, cells="", polish=0, parameters=values)


def _polishes(job: Job) -> bool:
    """Whether borders of cells are fitted: at full detail they have to be drawn as plain splats are."""
    rule = find_rule(method_info(method_info(job.method).in_cells).rule)
    return job.polish > 0 and (rule is None or not rule.always)


def _seam_job(job: Job) -> Job:
    whole, _ = _divided(job)
    common = {field.name: getattr(whole, field.name) for field in fields(Parameters)}
    preset = method_info(POLISHED_BY).preset(job.preset)
    return _part_of(job, replace(preset, **{**common, "steps": job.polish, **STILL}), POLISHED_BY)


def _write_part(job: Job, path: Path, region: Region | None = None, base: Path | None = None) -> None:
    path.mkdir(parents=True)
    where = ""
    if region is not None:
        region.write(path / REGION)
        where = str(path / REGION)
    begins = "" if base is None else str(base)
    replace(job, out=str(path), region=where, base=begins).write(path / "job.toml")


def _read_parts(folder: Path) -> list[Block]:
    numbers = sorted(int(path.name) for path in folder.glob("*") if path.name.isdecimal())
    return [
        Block(number, RunFolder(there := folder / str(number)), Region.read(there / REGION))
        for number in numbers
    ]


def _grids(scene: Scene, fewest: float) -> Iterator[str]:
    """Ever more cells, none much longer than wide, as ``Job.cells`` has them."""
    ground = scene.up_rotation()
    eyes = np.array([camera.center for camera in scene.cameras]) @ ground.T
    longer, shorter = sorted(np.ptp(eyes[:, :2], axis=0), reverse=True)
    aspect = min(longer / max(shorter, 1e-9), MAX_CELLS)
    for count in range(ceil(fewest), MAX_CELLS + 1):
        ways = ((count // rows, rows) for rows in range(1, count + 1) if count % rows == 0)
        slim, columns, rows = min((abs(float(np.log(aspect * b / a))), a, b) for a, b in ways)
        if slim <= np.log(SLIMMEST) or count == 1:
            yield f"{columns}x{rows}"


def _memory(parameters: Parameters, views: int, pixels: float, photo_memory: int) -> int:
    """Bytes that a trainer takes, about."""
    photographs = min(views * pixels * TARGET_BYTES, photo_memory * 1e6 or MOST_BYTES)
    return round(PROGRAM_BYTES + SPLAT_BYTES * parameters.most_at_once + photographs)


def _scaled(steps: int | tuple[int, ...], share: float) -> int | tuple[int, ...]:
    if isinstance(steps, tuple):
        return tuple(max(round(each * share), 1) for each in steps)
    return max(round(steps * share), 1)
