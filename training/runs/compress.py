"""Compression of levels as LightGaussian compresses 3DGS (Fan et al. 2024), for FLoD and other methods.

Splats of low global significance are removed, the remaining ones are distilled from the originals, and their
values are quantised. ``splats/coding.py`` has the format. Needs torch and scipy.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.cluster.vq import kmeans2, vq

from ..editing.cleaning import keep_splats
from ..editing.export import Compression
from ..errors import LodgsError
from ..lod.selection import full_detail_controls, standalone_levels
from ..optimize.support import midpoint_views
from ..optimize.training_data import TrainingData
from ..rasterize import Adam, Gaussians, Target, contributions, photometric_loss, rasterize, tensor_device
from ..scenes.cameras import Camera
from ..splats.bundle import read_bundle, write_bundle
from ..splats.coding import Codebook
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import Splats
from ..splats.level_folder import read_folder
from ..splats.levels import Bundle
from ..splats.ply import Element, all_columns
from ..splats.sh import coefficient_count
from .data import training_data
from .folder import RunFolder, find_splats
from .job import Job

VOLUME_QUANTILE = 0.9
"""Quantile of volumes from which on a splat's volume counts as 1 (LightGaussian, Sec. 3.2)."""
VOLUME_POWER = 0.1
"""Power of a splat's volume in its significance, β (LightGaussian, Sec. 3.2)."""
RATES = {"sh": 2.5e-3, "opacity_logits": 0.025, "log_scales": 5e-3, "quats": 1e-3}
"""Learning rates of the distillation, those of 3DGS. Higher degrees of ``sh`` have a 20th."""
SAMPLES = 16
"""Number of splats per set of the codebook that k-means sees."""
ITERATIONS = 5
"""Iterations of k-means."""
MIN_SHARED = 32
"""Minimum mean number of splats per set."""
_SIGNIFICANCE = "significance"
"""Temporary extra column."""


def compress(
    source: Path, out: Path, settings: Compression, run: Path | None = None, warn: Warn = ignore
) -> str:
    """Write a compressed copy of a run's bundle, or of any bundle, folder of levels or 3DGS PLY.

    Without training views, or if levels need each other, splats are only quantised.

    Args:
        run: run whose training views measure the splats; None for the source, if it is one.
        warn: called with warnings about the scene and the splats.

    Returns:
        A report of the remaining splats and of the size.

    Raises:
        LodgsError: cannot read or write a file, the source would be overwritten, or ``out`` is no PLY.
    """
    path = find_splats(source)
    if out.resolve() == path.resolve():
        raise LodgsError(f"Cannot write {out}: it is the source.", "Choose another output file.")
    if out.suffix.lower() != ".ply":
        raise LodgsError(f"Cannot write {out}: compressed bundles are PLY files.", "End its name with .ply.")
    bundle = read_folder(path, warn) if path.is_dir() else read_bundle(path, warn)
    limit_degree(bundle, settings.sh_degree).check()
    plain_size = sum(Element.from_splats("", [level.rows], all_columns).size for level in bundle.levels)
    counts = [len(level.rows) for level in bundle.levels]
    if not any(counts):
        raise LodgsError(f"Cannot compress {source}: it has no splats.", "Choose another file.")
    run = source if run is None and path != source else run
    if run is None or not _levels_are_scenes(bundle):
        reason = "it has no training views" if run is None else "its levels are not complete scenes"
        warn(f"{source}: splats are quantised, but none are removed, because {reason}.")
        bundle, weights = limit_degree(bundle, settings.sh_degree), None
    else:
        folder = RunFolder(run)
        job = Job.from_file(folder.job)
        data = training_data(job, folder, pixels=False)
        margin = job.resolved_parameters().margin
        bundle = shrink_levels(bundle, data, settings, margin, job.backend)
        weights = np.concatenate([level.splats.extras.pop(_SIGNIFICANCE) for level in bundle.levels])
    write_bundle(out, bundle, codebook=make_codebook(bundle, settings.codes, weights))
    report = [
        f"level {level.number}: {len(level.rows):,} of {count:,} splats"
        for level, count in zip(bundle.levels, counts, strict=True)
    ]
    return "\n".join([*report, f"{out}: {describe_size(out.stat().st_size, plain_size)}"])


def describe_size(size: int, plain_size: int) -> str:
    """Describe the size of a compressed file, in relation to the same splats in a PLY."""
    change = f"{abs(1 - size / plain_size):.1%} {'smaller' if size <= plain_size else 'larger'}"
    return f"{size / 1e6:,.2f} MB, {change} than a PLY"


def _levels_are_scenes(bundle: Bundle) -> bool:
    """Return True if each level is drawn by itself, without weights."""
    separate = not bundle.cumulative and len(standalone_levels(bundle)) == len(bundle.levels)
    return separate and full_detail_controls(bundle) is None


def shrink_levels(
    bundle: Bundle, data: TrainingData, settings: Compression, margin: float, backend: str
) -> Bundle:
    """Remove each level's splats of least significance, and distill the remaining ones.

    Args:
        margin: width of the margin around training views whose splats count, see ``Parameters.margin``.

    Returns:
        A bundle whose splats have an extra column with their significance.
    """
    device, masks, levels = tensor_device(backend), {}, []
    options = {"near": data.near, "antialias": bundle.antialias, "backend": backend}
    for level in bundle.levels:
        wide = (camera.widened(margin) for camera in data.train)
        total = contributions(Gaussians.of(level.splats, device), wide, **options).total.cpu().numpy()
        column = significance(level.splats, total)
        masks[level.number] = np.ones(len(column), bool)
        masks[level.number][np.argsort(column, kind="stable")[: int(settings.prune * len(column))]] = False
        extras = level.splats.extras | {_SIGNIFICANCE: column.astype(np.float32)}
        levels.append(replace(level, splats=replace(level.splats, extras=extras)))
    pruned = keep_splats(replace(bundle, levels=levels), masks)
    pruned = limit_degree(pruned, settings.sh_degree)
    views = [*data.train, *midpoint_views(data.train)]
    for level, original in zip(pruned.levels, bundle.levels, strict=True):
        if settings.distill_steps and len(level.splats):
            level.splats = distill(level.splats, original.splats, views, settings.distill_steps, **options)
    return pruned


def limit_degree(bundle: Bundle, degree: int) -> Bundle:
    """Return a bundle without spherical harmonics above a degree."""
    count = coefficient_count(degree)
    levels = []
    for level in bundle.levels:
        sh = np.ascontiguousarray(level.splats.sh[:, :count])
        levels.append(replace(level, splats=replace(level.splats, sh=sh)))
    return replace(bundle, levels=levels)


def significance(splats: Splats, weight: np.ndarray) -> np.ndarray:
    """Return the global significance of splats, (N,) float64 (LightGaussian, Sec. 3.2).

    Args:
        weight: (N,) opacity times transmittance, summed over the pixels of all training views. Unlike the
            paper's, it falls off from a splat's centre, as in the image.
    """
    volumes = np.exp(splats.log_scales.astype(np.float64).sum(axis=1))
    largest = np.quantile(volumes, VOLUME_QUANTILE) if len(volumes) else 1.0
    return weight * (volumes / max(largest, 1e-300)).clip(0, 1) ** VOLUME_POWER


def distill(
    splats: Splats, teacher: Splats, views: Sequence[Camera], steps: int, *, backend: str, **options
) -> Splats:
    """Train colours, opacities and shapes of splats to show the images of others (LightGaussian, Sec. 3.3).

    No splat becomes thinner than the thinnest before, so that minimum sizes of levels remain.

    Args:
        views: training views and pseudo views.
        options: options of ``rasterize``.
    """
    device = tensor_device(backend)
    original, student = Gaussians.of(teacher, device), vars(Gaussians.of(splats, device))
    trained = {name: student[name].clone().requires_grad_() for name in RATES}
    higher_terms = splats.sh.shape[1] - 1
    rates = RATES | {"sh": torch.tensor([[RATES["sh"]], *[[RATES["sh"] / 20]] * higher_terms])}
    adam = Adam(trained, rates)
    rounds = np.tile(np.arange(len(views)), (steps // len(views) + 1, 1))
    order = np.random.default_rng(0).permuted(rounds, axis=1)
    thinnest = float(splats.log_scales.min())
    for view in order.ravel()[:steps]:
        with torch.no_grad():
            target = Target(rasterize(original, views[view], backend=backend, **options).image)
        image = rasterize(Gaussians(**{**student, **trained}), views[view], backend=backend, **options).image
        photometric_loss(image, target, backend=backend).backward()
        adam.step()
        with torch.no_grad():
            trained["log_scales"].clamp_(min=thinnest)
        for tensor in trained.values():
            tensor.grad = None
    return replace(splats, **{name: tensor.detach().cpu().numpy() for name, tensor in trained.items()})


def make_codebook(bundle: Bundle, size: int, weights: np.ndarray | None = None) -> Codebook:
    """Find sets of SH coefficients for the splats of all levels by k-means (LightGaussian, Sec. 3.4).

    Args:
        size: maximum number of sets; bundles with few splats get fewer.
        weights: (N,) relative probabilities that k-means samples a splat, for the splats of all levels.
    """
    harmonics = np.concatenate([level.splats.sh[:, 1:] for level in bundle.levels])
    rows = harmonics.reshape(len(harmonics), -1)
    if weights is None or not weights.any():
        weights = np.ones(len(rows))
    size = min(size, len(rows) // MIN_SHARED, np.count_nonzero(weights))
    sets, codes = np.zeros((1, rows.shape[1]), np.float32), np.zeros(len(rows), np.uint16)
    if rows.shape[1] and size:
        rng, chances = np.random.default_rng(0), weights / weights.sum(dtype=np.float64)
        first = rows[rng.choice(len(rows), size, replace=False, p=chances)]
        sample = rows[rng.choice(len(rows), SAMPLES * size, p=chances)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of sets without splats, which are kept
            sets = kmeans2(sample, first, ITERATIONS, minit="matrix")[0]
        codes = vq(rows, sets)[0].astype(np.uint16)
    ends = np.cumsum([len(level.splats) for level in bundle.levels])[:-1]
    numbers = [level.number for level in bundle.levels]
    return Codebook(sets.reshape(len(sets), -1, 3), dict(zip(numbers, np.split(codes, ends), strict=True)))
