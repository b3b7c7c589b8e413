"""``lodgs blocks``: divide a scene that is too large for one run into cells, and train them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import LodgsError
from . import PROGRAM
from .job_options import add_options, job_from_options, parse_resources
from .options import parse_positive, require_effect
from .train import train_job

if TYPE_CHECKING:
    from ..runs.folder import RunFolder
    from ..runs.job import Job
    from ..scenes.colmap import Scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    plan = actions.add_parser(
        "plan", help="divide a scene into cells, each with a run of its own, and estimate the costs of each"
    )
    add_options(plan)
    plan.add_argument(
        "--block-splats", type=parse_positive, default=0, metavar="N",
        help="instead of --cells: use as few cells as have at most N splats each",
    )  # fmt: skip
    plan.add_argument(
        "--block-memory", type=parse_positive, default=0, metavar="MB",
        help="instead of --cells: use as few cells as need at most this much memory each (estimated)",
    )  # fmt: skip
    train = actions.add_parser("run", help="train or resume the cells of a plan, and merge them")
    train.add_argument("run", type=Path, help="run folder of the plan")
    train.add_argument(
        "--on", default="here", metavar="WHERE",
        help="here, one at a time (default); local:N, N at a time; or the key file of a scheduler",
    )  # fmt: skip
    train.add_argument(
        "--no-tls", action="store_true",
        help="permit --on tcp://HOST:8786, a Dask scheduler without encryption: everybody who reaches its "
        "port can run programs as its user",
    )  # fmt: skip
    train.add_argument(
        "--only", metavar="PART",
        help="train only this part on this computer: coarse, block-3 or seam-3. Succeeds if there is no "
        "such part",
    )  # fmt: skip
    train.add_argument(
        "--takes", action="append", default=[], metavar="NAME=NUMBER",
        help="Dask resources that each cell needs, such as GPU=1",
    )  # fmt: skip
    scheduler = actions.add_parser("scheduler", help="distribute cells to the workers of several computers")
    scheduler.add_argument("key", type=Path, help="key file to write; every worker needs a copy")
    scheduler.add_argument(
        "--host", metavar="HOST", help="address of this computer for the others (default: its main address)"
    )
    scheduler.add_argument(
        "--port", type=parse_positive, default=8786, metavar="N", help="port for connections (default 8786)"
    )
    worker = actions.add_parser("worker", help="train cells of a scheduler on this computer")
    worker.add_argument("key", type=Path, help="copy of the scheduler's key file")
    worker.add_argument(
        "--offers", action="append", default=[], metavar="NAME=NUMBER",
        help="Dask resources of this worker, such as GPU=1",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    match options.action:
        case "plan":
            return _plan(options)
        case "run":
            return _train(options)
    from ..runs.cells import cluster

    if options.action == "scheduler":
        cluster.run_scheduler(options.key, options.host, options.port)
    else:
        cluster.run_worker(options.key, parse_resources(options.offers))
    return 0


def _plan(options: argparse.Namespace) -> int:
    from ..runs.cells.plan import choose_cells, plan, plan_table, read_planned_scene, write_plan
    from ..runs.folder import RunFolder
    from ..runs.job import save_job

    job = job_from_options(options).resolved()
    folder = RunFolder(job.out)
    scene = read_planned_scene(job, lambda scene: _ensure_points(scene, job, folder))
    if options.block_splats or options.block_memory:
        if job.cells:
            raise LodgsError(
                "Cannot combine --cells with --block-splats or --block-memory.", "Use only one of them."
            )
        job = job.with_cells(choose_cells(job, options.block_splats, options.block_memory * 10**6, scene))
    if not job.cells:
        raise LodgsError(
            "Cannot plan cells: their number is missing.",
            "Add --cells 2x4, for 2 columns of 4 cells, or --block-splats 1000000.",
        )
    planned = plan(job, scene)
    folder.create()
    if folder.job.exists():  # refuses results of another job before the plan is written
        save_job(job, folder)
    write_plan(job, folder, scene, planned)
    save_job(job, folder)
    print(plan_table(planned))
    print(f"Train them with: {PROGRAM} blocks run {folder.path}", flush=True)
    return 0


def _ensure_points(scene: Scene, job: Job, folder: RunFolder) -> Scene:
    if len(scene.points):
        return scene
    from ..runs.data import ensure_points  # imports torch

    def report(kind: str, message: str, **values: object) -> None:
        print(message if kind == "status" else f"{kind}: {message}", file=sys.stderr, flush=True)

    return ensure_points(scene, job, folder, report)


def _train(options: argparse.Namespace) -> int:
    from ..runs.cells.plan import read_plan, read_planned_job
    from ..runs.cells.train import prepare_part
    from ..runs.folder import RunFolder

    if not options.only:
        return train_job(
            lambda: read_planned_job(options.run),
            on=options.on,
            resources=parse_resources(options.takes),
            tls=not options.no_tls,
        )
    unused = {"--on": options.on != "here", "--no-tls": options.no_tls, "--takes": options.takes}
    require_effect(unused, "runs without --only")
    division = read_plan(RunFolder(options.run))
    part = division.part(options.only)
    if part is None:
        return 0
    prepare_part(division, part)
    return train_job(lambda: part.job)
