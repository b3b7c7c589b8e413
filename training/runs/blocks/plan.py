"""From a job with cells to a block for each: an ordinary job in a folder of its own. No torch.

run/  job.toml (with ``cells``)  blocks/1/job.toml  blocks/1/region.json  blocks/2/...  blocks/whole.ply
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from ...errors import LodgsError
from ...methods import method_info
from ...scenes.colmap import Scene, read_scene
from ...scenes.regions import Region, plan_cells
from ..folder import RunFolder
from ..job import Job

REGION = "region.json"


@dataclass(frozen=True)
class Block:
    """A cell and its run.

    Attributes:
        number: from 1.
        folder: of its run.
        region: what it is trained on.
    """

    number: int
    folder: RunFolder
    region: Region

    @property
    def job(self) -> Job:
        """Its job, as it was written."""
        return Job.from_file(self.folder.job)


def plan(job: Job, scene: Scene | None = None) -> list[tuple[Region, Job]]:
    """The cells of a job's scene, each with the job that trains it, whose folder is still the whole's.

    Of the steps each block has as many as it has views, so that every view is seen as often as if the scene
    were trained as a whole; of the splats as many as it has points.

    Args:
        scene: of the job, where it has been read already.

    Raises:
        LodgsError: the scene cannot be read, or divided so.
    """
    if scene is None:
        model, images = (Path(path) if path else None for path in (job.model, job.images))
        scene = read_scene(Path(job.scene), model=model, images=images)
    if not len(scene.points):
        raise LodgsError(
            f"The COLMAP model in {scene.model} has no 3D points.", "Triangulate them in COLMAP."
        )
    method = method_info(method_info(job.method).in_cells)
    told = asdict(job.resolved_parameters())
    known = {field.name for field in fields(method.parameters)}
    parameters = {name: value for name, value in told.items() if name in known}
    training = {camera.name for camera in scene.split(job.test_every, job.validation)[0]}
    found = []
    for number, region in enumerate(plan_cells(scene, *job.grid), 1):
        views, points = len(training & set(region.views)), int(region.points_of(scene).sum())
        if views < 2 or not points:
            what = f"{views} views and {points} points"
            raise LodgsError(f"Cell {number} has {what}, too little to train on.", "Ask for fewer cells.")
        share = views / len(training)
        steps = _scaled(parameters["steps"], share)
        splats = max(round(parameters["max_splats"] * points / len(scene.points)), 1)
        its = {**parameters, "steps": steps, "max_splats": splats}
        its = {name: list(value) if isinstance(value, tuple) else value for name, value in its.items()}
        block = replace(job, method=method.name, cells="", region=REGION, parameters=its)
        found.append((region, block))
    return found


def write_plan(job: Job, folder: RunFolder) -> list[Block]:
    """Writes a job and its blocks into the run's folder, ready to be trained; blocks that are there stay.

    Raises:
        LodgsError: as :func:`plan`, or the folder cannot be written.
    """
    if not folder.blocks.exists():
        made = plan(job)
        try:
            with tempfile.TemporaryDirectory(dir=folder.path, prefix="planning-") as work:
                for number, (region, block) in enumerate(made, 1):
                    there = Path(work) / "blocks" / str(number)
                    there.mkdir(parents=True)
                    region.write(there / REGION)
                    replace(block, out=str(there), region=str(there / REGION)).write(there / "job.toml")
                shutil.move(Path(work) / "blocks", folder.blocks)
        except OSError as error:
            raise LodgsError(
                f"The blocks in {folder.path} cannot be written: {error.strerror or error}.",
                "Choose a folder that you may write to, on a disk with room.",
            ) from error
    return read_plan(folder)


def read_plan(folder: RunFolder) -> list[Block]:
    """The blocks of a run that is divided, by number.

    Raises:
        LodgsError: there are none, or one is damaged.
    """
    numbers = sorted(int(path.name) for path in folder.blocks.glob("*") if path.name.isdecimal())
    if not numbers:
        raise LodgsError(f"{folder.path} has no blocks.", "Plan them first.")
    return [
        Block(number, RunFolder(there := folder.blocks / str(number)), Region.read(there / REGION))
        for number in numbers
    ]


def planned_job(path: Path) -> Job:
    """The job of a run that is divided.

    Raises:
        LodgsError: there is none.
    """
    job = Job.from_file(RunFolder(path).job)
    if not job.cells:
        raise LodgsError(f"{path} is not divided into cells.", "Train its job, or plan it with --cells.")
    return job


def plan_table(blocks: list[Block]) -> str:
    """What each block will take, for people."""
    lines = ["block   views  splats at most     steps"]
    for block in blocks:
        p = block.job.resolved_parameters()
        views = len(block.region.views)
        lines.append(f"{block.number:5}{views:8,}{p.max_splats:16,}{p.total_steps:10,}")
    return "\n".join(lines)


def _scaled(steps: int | tuple[int, ...], share: float) -> int | tuple[int, ...]:
    if isinstance(steps, tuple):
        return tuple(max(round(each * share), 1) for each in steps)
    return max(round(steps * share), 1)
