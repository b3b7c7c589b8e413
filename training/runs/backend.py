"""Choose the rasterizer backend that trains a job."""

from __future__ import annotations

from collections.abc import Callable

from ..methods import METHODS
from ..rasterize import cpu_fallback_reason, resolve_backend
from ..rasterize.gpu.default_device import default_adapter
from ..rasterize.trial import card_problem, fastest_backend, step_times
from ..scenes.colmap import Scene
from .events import EventWriter
from .job import Job


def choose_backend(job: Job, scene: Scene, transparent: Callable[[], bool] = lambda: False) -> str:
    """Return the backend of a job. The choice auto is the fastest one that can make all steps of the job.

    Args:
        scene: scene of the job.
        transparent: return whether the photos have transparent pixels.

    Raises:
        LodgsError: see ``resolve_backend``.
    """
    if job.backend == "auto" and trains_on_device(job, scene) and not transparent():
        return fastest_backend()
    return resolve_backend(job.backend)


def trains_on_device(job: Job, scene: Scene) -> bool:
    """Return whether the backend gpu makes all steps of a job on its device, if photos are opaque.

    See ``Method.device_steps``.
    """
    parameters = job.resolved_parameters()
    needs_host = parameters.lr_exposure or parameters.depth_weight or job.region or job.cell
    if needs_host or any(camera.mask is not None for camera in scene.cameras):
        return False
    return METHODS[job.method].trains_on_device(parameters)


def report_backend(job: Job, scene: Scene, backend: str, events: EventWriter) -> None:
    """Report the backend of a job, and the reason if an existing GPU is not used."""
    names = {"cpu": "the CPU", "cuda": "the NVIDIA GPU", "reference": "the CPU (slow reference rasterizer)"}
    problem = cpu_fallback_reason(job.backend)
    if not problem and job.backend == "auto" and backend == "cpu" and trains_on_device(job, scene):
        problem = card_problem()
    if problem:
        events("warning", message=problem)
    name = names.get(backend) or default_adapter().name
    if job.backend == "auto" and backend == "gpu":
        times = step_times()
        name += f": a step of a trial took {times['gpu']:.1f} ms, and {times['cpu']:.1f} ms on the CPU"
    events("status", message=f"Training on {name}", backend=backend)
