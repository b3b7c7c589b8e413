"""Finished runs: open them, load their networks, and bake these again with another appearance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from ..errors import LodgsError
from ..evaluate.lpips import load_lpips
from ..evaluate.metrics import ssim
from ..evaluate.views import Evaluation
from ..lod.on_disk import read_or_open_bundle
from ..methods import create
from ..optimize.method import ImageModel, Method
from ..optimize.training_data import TrainingData
from ..rasterize import cpu_fallback_reason, tensor_device
from ..splats.bundle import read_bundle, write_bundle
from ..splats.dialects import Warn, ignore
from ..splats.levels import Bundle
from .arrays import array_error, read_arrays
from .data import training_data
from .folder import RunFolder
from .job import Job


def open_finished(run: Path, warn: Warn) -> tuple[RunFolder, Job, TrainingData]:
    """Return the folder, job and training data of a finished run.

    Raises:
        LodgsError: the run is not finished, contains a link, or has no scene.
    """
    folder = RunFolder(run)
    folder.reject_links()
    if not folder.bundle.exists():
        raise LodgsError(
            f"Cannot use {folder.path}: it is not a finished run (it has no bundle.ply).",
            "Choose a run folder, and finish training it first.",
        )
    job = Job.from_file(folder.job)

    def report(kind: str, **values) -> None:
        if kind == "warning":
            warn(values["message"])

    return folder, job, training_data(job, folder, report)


def open_evaluation(
    run: Path, warn: Warn = ignore, lpips: Path | None = None
) -> tuple[RunFolder, Job, Bundle, Evaluation]:
    """Open a finished run to measure SSIM, and LPIPS if its weights are there.

    Args:
        run: run folder.
        warn: called with warnings about the scene, and if an existing GPU is not used.
        lpips: archive of the networks' weights, see ``evaluate.lpips.load_lpips``.

    Returns:
        Its folder, job, bundle and evaluation.

    Raises:
        LodgsError: see ``open_finished``.
    """
    folder, job, data = open_finished(run, warn)
    if problem := cpu_fallback_reason(job.backend):
        warn(problem)
    bundle = read_or_open_bundle(folder.bundle)
    networks = load_lpips(lpips, tensor_device(job.backend))
    if not networks:  # torch's threads would compete with the kernels' threads; only LPIPS gains from them
        torch.set_num_threads(1)
    measures = {"ssim": ssim, **networks}
    return folder, job, bundle, Evaluation(data, job.backend, bundle.antialias, measures)


def load_networks(job: Job, folder: RunFolder, data: TrainingData) -> tuple[Method, ImageModel]:
    """Return the method of a run with its trained networks, and its neural model."""
    method = create(job.method, data, job.resolved_parameters(), job.seed, job.backend)
    model = method.image_model
    assert model is not None
    arrays = read_arrays(folder.model)
    try:
        model.load_arrays(arrays)
    except (KeyError, ValueError) as error:
        raise array_error(folder.model, error) from error
    return method, model


@contextmanager
def bake_again(run: Path, photos: Sequence[str], warn: Warn = ignore) -> Iterator[Path]:
    """Bake the networks of a finished run with the mean appearance of training photos (Octree-GS, Fig. 10).

    The bundle is temporary. A photo that is named twice has twice the weight.

    Raises:
        LodgsError: the run is not finished, has no networks or no appearances, or a photo is unknown.
    """
    folder, job, data = open_finished(run, warn)
    if not folder.model.exists():
        raise LodgsError(
            f"Cannot choose an appearance: {folder.path} has no networks.",
            "Choose a run of the method octree_neural that was trained with appearance above 0.",
        )
    method, model = load_networks(job, folder, data)
    model.use_appearance(photos)
    bundle = read_bundle(folder.bundle)
    levels = method.levels_after(method.steps - 1)
    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "bundle.ply"
        write_bundle(path, replace(bundle, levels=levels, meta=bundle.meta | {"appearance": list(photos)}))
        yield path
