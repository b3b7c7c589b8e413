"""Estimate of a training before it starts: time, memory and disk, measured by real steps on this computer."""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..errors import LodgsError
from ..evaluate.messages import format_duration
from ..methods import METHODS, create
from ..optimize.initialize import MIN_POINTS, neighbor_scale
from ..optimize.memory import MAX_BYTES, TARGET_BYTES, free_memory, peak_memory, reset_peak_memory
from ..optimize.method import Method
from ..optimize.parameters import Parameters
from ..optimize.training_data import TrainingData
from ..rasterize import warm_up
from ..scenes.cameras import pick_evenly
from ..scenes.check import ESTIMATE, Finding
from ..scenes.colmap import Scene, read_scene
from ..scenes.triangulate import cached_points
from ..splats.gaussians import SplatRows
from .backend import choose_backend
from .base import base_origin, open_base
from .capture import capture
from .cells.plan import PROGRAM_BYTES, SPLAT_BYTES, choose_cells
from .job import AUTO, DOME, Job

ASSUMED_SPLATS = 1_000_000
"""Assumed number of splats of a run without a limit."""
START_SECONDS = 4.0
"""Seconds to start the trainer and to measure its result."""
MEASURED_SECONDS = 2.0
"""Approximate seconds of measured steps per size."""
ROUND_GROWTH = 0.1
"""Splats that a densification adds, as a share of the initial points. Measured: 0.04 to 0.25."""
GROWTH_SHARE = 0.5
"""Share of the steps in which the number of splats grows, if the finest level is trained first."""
SAMPLE_VIEWS = 6
"""Number of views to render of splats without photos."""
MAX_USE = 0.8
"""Share of the free memory or disk that a training may use."""
LONG_SECONDS = 2 * 3600
"""Seconds from which a preset of less effort is suggested."""
LARGE_SIDE, SMALL_SIDE = 1600, 640
"""Longer sides of training images in pixels: above the first, papers reduce photos; below the second, details
are lost."""


@dataclass(frozen=True)
class Estimate:
    """Expected costs of a training.

    Attributes:
        seconds: duration; from splats without the time between levels, so at least this.
        memory, free_memory: bytes at the peak, and those available now; of the GPU if it has its own.
        disk, free_disk: bytes of the run folder at the peak, with checkpoints, and those available there.
        splats: expected number of splats of the finest level.
        steps, views: number of steps and training views.
        size: width and height of a training image in pixels.
        from_splats: the training starts from splats.
    """

    seconds: float
    memory: int
    free_memory: int
    disk: int
    free_disk: int
    splats: int
    steps: int
    views: int
    size: tuple[int, int]
    from_splats: bool = False

    def __str__(self) -> str:
        splats = f"{float(f'{self.splats:.2g}'):,.0f}"
        duration = f"{'At least' if self.from_splats else 'About'} {format_duration(self.seconds)}"
        return (
            f"{duration}, {self.memory / 1e9:.1f} of {self.free_memory / 1e9:.1f} "
            f"GB memory, {self.disk / 1e9:.1f} of {self.free_disk / 1e9:.1f} GB disk, about {splats} "
            f"splats ({self.steps:,} steps on {self.views} views of {self.size[0]}x{self.size[1]} pixels)."
        )


def estimate_findings(job: Job) -> list[Finding]:
    """Return the estimate of a job as a finding, and settings to change with their reason.

    Takes some seconds, and up to a minute more if the kernels are not compiled yet.
    """
    if job.cells or job.region:
        return [Finding(ESTIMATE, "There is no estimate for training in cells or of a region.")]
    try:
        with tempfile.TemporaryDirectory(prefix="lodgs-") as scratch:
            costs = estimate(job, Path(scratch))
        return [Finding(ESTIMATE, str(costs)), *suggest_settings(job.resolved(), costs)]
    except LodgsError as error:
        return [Finding(ESTIMATE, f"No estimate: {error.what}", error.remedy)]


def estimate(job: Job, scratch: Path) -> Estimate:
    """Estimate a job by real steps with the initial and the final number of splats.

    A job that starts from splats has about the same number in all steps. Without photos, a few of its views
    are rendered.

    Args:
        scratch: folder for rendered views, and for files of methods with splats on disk.

    Raises:
        LodgsError: the scene or the base cannot be read or trained, or the scene has no points yet.
    """
    begin = time.monotonic()
    job = job.resolved()
    parameters = job.resolved_parameters()
    base = None
    if job.base:
        base, antialias = open_base(job.base)
        base = base if METHODS[job.method].streams_base else base.select(slice(None))
        parameters = replace(parameters, antialias=antialias)
    model, images = job.model_and_images
    folder, views, rendering = _render_views(job, scratch) if job.capture else (Path(job.scene), 0, 0.0)
    scene = cached_points(read_scene(folder, model, images, origin=base_origin(job)), job.exposure)
    if not len(scene.points):
        raise LodgsError("the scene has no points yet.", "Training makes them first.")
    backend = choose_backend(job, scene)
    torch.set_num_threads(1)  # as in training
    warm_up(backend)
    start = START_SECONDS + time.monotonic() - begin
    splats = _expected_splats(parameters, len(scene.points)) if base is None else len(base)
    early, _, data = _measure(job, parameters, scene, backend, scratch, base, last=False)
    late, growing = early, 1.0
    if base is None:
        if backend == "cuda":
            torch.cuda.reset_peak_memory_stats()
        reset_peak_memory()
        grown = _with_points(scene, max(splats, MIN_POINTS))
        all_points = replace(parameters, margin=0.0)  # margins are among the final splats
        late, growing, data = _measure(job, all_points, grown, backend, scratch, None, last=True)
    width, height = data.train[0].width, data.train[0].height
    views = views or len(data.train)
    photos = sum(TARGET_BYTES * camera.width * camera.height for camera in data.train)
    photos = round(photos * views / len(data.train))
    photos = max(min(photos, job.photo_memory * 10**6 or MAX_BYTES) - data.images.held_bytes, 0)
    if backend == "cuda":
        memory, available = torch.cuda.max_memory_allocated(), torch.cuda.mem_get_info()[0]
    else:
        memory = (peak_memory() or round(PROGRAM_BYTES + SPLAT_BYTES * splats)) + photos
        available = free_memory()
    planned = parameters.for_photos(views)
    steps = planned.total_steps if base is None else planned.base_steps
    growth = max(growing, GROWTH_SHARE)
    seconds = start + rendering + steps * (growth * (early + late) / 2 + (1 - growth) * late)
    return Estimate(
        seconds, memory, available, _disk_bytes(parameters, splats), _free_disk(Path(job.out)), splats, steps,
        views, (width, height), base is not None,
    )  # fmt: skip


def _render_views(job: Job, scratch: Path) -> tuple[Path, int, float]:
    """Render some of the views of a job without photos.

    Returns:
        The folder of the scene, the number of all views, and the seconds to render the others.
    """
    source, count = job.capture, job.views
    if source not in (AUTO, DOME):
        files = sorted(Path(source).glob("*.json"))
        count, source = len(files), str(scratch / "cameras")
        Path(source).mkdir()
        for file in pick_evenly(files, SAMPLE_VIEWS):
            shutil.copy2(file, source)
    times: list[float] = []
    rendered, _ = capture(
        job.base, scratch / "captured", source, min(count, SAMPLE_VIEWS), job.view_width, backend=job.backend,
        report=lambda number, total: times.append(time.monotonic()),
    )  # fmt: skip
    return scratch / "captured", count, max(count - rendered, 0) * float(np.median(np.diff(times)))


def suggest_settings(job: Job, costs: Estimate) -> list[Finding]:
    """Return settings to change, with their reason."""
    findings = []
    side = max(costs.size)
    if costs.memory > MAX_USE * costs.free_memory:
        problem = f"Training needs more than {MAX_USE:.0%} of the free memory."
        findings.append(Finding(ESTIMATE, problem, _memory_remedy(job, costs)))
    if costs.disk > MAX_USE * costs.free_disk:
        problem = f"The run may need more than {MAX_USE:.0%} of the free disk space."
        findings.append(Finding(ESTIMATE, problem, "Choose a run folder on another disk."))
    if side > LARGE_SIDE:
        scale = job.image_scale * LARGE_SIDE / side
        problem = f"The longer side of training images has {side} pixels; papers use at most {LARGE_SIDE}."
        findings.append(Finding(ESTIMATE, problem, f"Set the image scale to {scale:.2g} to train faster."))
    elif side < SMALL_SIDE and job.image_scale < 1:
        scale = min(job.image_scale * SMALL_SIDE / side, 1.0)
        problem = f"The longer side of training images has only {side} pixels, which loses details."
        findings.append(Finding(ESTIMATE, problem, f"Set the image scale to {scale:.2g}."))
    if costs.seconds > LONG_SECONDS and job.preset != "draft":
        problem = f"Training takes more than {LONG_SECONDS // 3600} hours on this computer."
        findings.append(Finding(ESTIMATE, problem, "Train the preset draft first to check the scene."))
    return findings


def _memory_remedy(job: Job, costs: Estimate) -> str:
    """Return the remedy for too little memory: cells if the method has them, else fewer splats."""
    if METHODS[job.method].cell_method:
        try:
            grid = choose_cells(job, memory=int(MAX_USE * costs.free_memory))
            if grid != "1x1":
                return f"Train in {grid} cells, which need memory one after the other."
        except LodgsError:
            pass
    return "Lower max_splats or image_scale, or close other programs."


def _expected_splats(parameters: Parameters, points: int) -> int:
    """Return the number of splats of the finest level, at most its limit, from that of the initial points."""
    if parameters.growth_rounds is None:
        return parameters.max_splats or max(ASSUMED_SPLATS, points)
    return min(parameters.splat_limit, round(points * (1 + ROUND_GROWTH * parameters.growth_rounds)))


def _measure(
    job: Job,
    parameters: Parameters,
    scene: Scene,
    backend: str,
    scratch: Path,
    base: SplatRows | None,
    *,
    last: bool,
) -> tuple[float, float, TrainingData]:
    """Return the median seconds of a step from the points of a scene, the share of steps before the finest
    level, and the data.

    Args:
        base: splats to start from, instead of the points.
        last: measure the last steps of the finest level, else the first steps.
    """
    data = TrainingData(
        scene, job.image_scale, job.test_every, job.exposure, job.validation,
        photo_memory=job.photo_memory * 10**6 or None, splat_memory=job.splat_memory * 10**6 or None,
        scratch=scratch,
    )  # fmt: skip
    method = create(job.method, data, parameters, job.seed, backend, base)
    begin, end = _finest_stage(method)
    try:
        first = max(end - 50, begin) if last else 0
        return _time_steps(method, first, end), begin / method.steps, data
    finally:
        method.close()


def _finest_stage(method: Method) -> tuple[int, int]:
    """Return the first step of the finest level, and the first step after its first stage."""
    finest = max(map(method.level_at, range(method.steps)))
    begin = next(step for step in range(method.steps) if method.level_at(step) == finest)
    stage = method.stage(begin)
    return begin, next((n for n in range(begin, method.steps) if method.stage(n) != stage), method.steps)


def _time_steps(method: Method, first: int, end: int) -> float:
    """Return the median seconds of the steps after a first one, before an end."""
    method.train_step(first)
    begin, times, step = time.monotonic(), [], first
    while len(times) < 2 or time.monotonic() - begin < MEASURED_SECONDS:
        step = min(step + 1, max(end - 2, 0))
        started = time.monotonic()
        method.train_step(step)
        times.append(time.monotonic() - started)
    return float(np.median(times))


def _with_points(scene: Scene, count: int) -> Scene:
    """Return a scene with ``count`` points, at random positions near its points."""
    rng = np.random.default_rng(0)
    rows = rng.integers(len(scene.points), size=count)
    sizes = np.minimum(neighbor_scale(scene.points), np.percentile(neighbor_scale(scene.points), 90))
    points = scene.points[rows] + rng.normal(size=(count, 3)) * sizes[rows, None]
    return replace(
        scene, points=points.astype(scene.points.dtype), point_colors=scene.point_colors[rows],
        point_ids=np.zeros(0, scene.point_ids.dtype),
    )  # fmt: skip


def _disk_bytes(parameters: Parameters, splats: int) -> int:
    """Return the bytes of a run: its levels as files and in the bundle, and two checkpoints with moments."""
    row = 4 * (11 + 3 * (parameters.sh_degree + 1) ** 2)
    levels = 1 if parameters.levels == 1 else 2  # coarser levels have at most as many splats together
    return splats * row * (2 * levels + 2 * 3)


def _free_disk(folder: Path) -> int:
    """Return the free bytes on the disk of a folder that may not exist yet."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free
