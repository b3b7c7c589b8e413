"""Distances from which merged levels are drawn, measured on the training views. Not in the paper.

FLoD's levels in the paper have known minimum sizes. A merged level has none. The measured distances are those
of least error in the photos, among those that draw few enough splats.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations_with_replacement

import numpy as np
import torch

from ..rasterize import Gaussians, rasterize
from ..scenes.cameras import Camera, pick_evenly
from .training_data import TrainingData

MEASURED_VIEWS = 12
"""Number of training views to measure."""
BINS = 24
"""Number of bins of distances, with about as many pixels each."""


def measure_min_sizes(
    levels: Mapping[int, Gaussians],
    data: TrainingData,
    drawn: float,
    antialias: bool,
    backend: str,
    gamma: float,
    rho: float,
) -> list[float]:
    """Choose the distances of the finest levels, as minimum sizes (``s_min``) of all levels, coarse to fine.

    Coarser levels follow at the ratio ``rho``.

    Args:
        levels, drawn: see :func:`measure_distances`; ``levels`` are numbered up to the finest.
        gamma: control of the rule (``lod.rules.bands``).
    """
    distances = measure_distances(levels, data, drawn, antialias, backend)
    sizes = [distance * gamma / data.focal for distance in distances.values()]
    coarser = min(levels) - 1
    return [sizes[0] * rho**n for n in range(coarser, 0, -1)] + sizes + [0.0]


@torch.no_grad()
def measure_distances(
    levels: Mapping[int, Gaussians], data: TrainingData, drawn: float, antialias: bool, backend: str
) -> dict[int, float]:
    """Choose the distances from which levels are drawn.

    Args:
        levels: levels in use, coarse to fine.
        drawn: maximum number of splats drawn in the training views, as a fraction of those of the finest
            level; at least the number of the level before it.

    Returns:
        The distance of each level but the finest, in scene units.
    """
    views = pick_evenly(range(len(data.train)), MEASURED_VIEWS)
    samples = [_pixels(levels, view, data, antialias, backend) for view in views]
    distances, errors = (np.concatenate(column) for column in zip(*samples, strict=True))
    if not len(distances):
        return dict.fromkeys(list(levels)[:-1], data.median_depth)
    edges = np.quantile(distances, np.linspace(0, 1, BINS + 1))
    counts = np.zeros((BINS, len(levels)))
    for column, gaussians in enumerate(levels.values()):
        means = gaussians.means.cpu().numpy()
        for camera in (data.train[view] for view in views):
            visible = np.linalg.norm(means[camera.sees(means, data.near)] - camera.center, axis=1)
            counts[:, column] += _sums(visible, np.ones((len(visible), 1)), edges)[:, 0]
    switches = choose_switches(_sums(distances, errors, edges), counts, drawn)
    return {number: float(edges[index]) for number, index in zip(list(levels)[:-1], switches, strict=True)}


def choose_switches(errors: np.ndarray, counts: np.ndarray, drawn: float) -> list[int]:
    """Choose the first bin of each level but the finest.

    Args:
        errors: (B, L) error of each level in each bin of distances, ascending; levels coarse to fine.
        counts: (B, L) splats of each level in each bin.
        drawn: maximum number of splats, as a fraction of those of the finest level. The level before the
            finest may always be drawn everywhere.

    Returns:
        Indices of bins, descending, 0 to B: the choice of the least error.
    """
    bins, levels = errors.shape
    *_, second_finest, finest = counts.sum(axis=0)
    max_splats = max(drawn * finest, second_finest)
    numbers = np.arange(bins)
    best, least_error = [0] * (levels - 1), np.inf
    for ascending in combinations_with_replacement(range(bins + 1), levels - 1):
        # a bin shows the coarsest level whose first bin is not after it
        column = levels - 1 - np.searchsorted(ascending, numbers, side="right")
        error = errors[numbers, column].sum()
        if error < least_error and counts[numbers, column].sum() <= max_splats:
            best, least_error = list(ascending[::-1]), error
    return best


def _pixels(
    levels: Mapping[int, Gaussians], view: int, data: TrainingData, antialias: bool, backend: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (P,) of a view's opaque pixels in the finest level, and squared errors (P, L)."""
    camera, target = data.train[view], data.target(view)
    errors, depth = [], np.empty(0)
    *_, finest = levels
    for number, gaussians in levels.items():
        outputs = ("median_depth",) if number == finest else ()
        rendering = rasterize(
            gaussians, camera, near=data.near, antialias=antialias, outputs=outputs, backend=backend
        )
        if rendering.median_depth is not None:
            depth = rendering.median_depth.cpu().numpy()
        errors.append(((rendering.image.cpu().clamp(0, 1) - target.image) ** 2).mean(-1).numpy())
    opaque = (depth > 0) & (True if target.mask is None else target.mask.numpy() > 0.5)
    return (depth * _ray_lengths(camera))[opaque], np.stack(errors, axis=-1)[opaque]


def _ray_lengths(camera: Camera) -> np.ndarray:
    """Return the distance of each pixel's point at depth 1 from the camera, (H, W)."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.sqrt(1 + x**2 + y[:, None] ** 2)


def _sums(distances: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Sum values (N, C) in each bin of distances, (B, C); the outer bins have no outer limit."""
    index = np.clip(np.searchsorted(edges, distances, side="right") - 1, 0, len(edges) - 2)
    return np.stack([np.bincount(index, column, len(edges) - 1) for column in values.T], axis=1)
