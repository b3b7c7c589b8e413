"""Distances from which merged levels are drawn, measured on the training views. Not in the paper.

FLoD's levels in the paper have known minimum sizes. A merged level has none. The level before the finest is
drawn from the distance of least error in the photos, among those that draw few enough splats. Coarser levels
are drawn farther away than anything in the photos.
"""

from __future__ import annotations

from collections.abc import Mapping

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
    """Choose the distances of levels, as minimum sizes (``s_min``) of all levels, coarse to fine.

    The level before the finest has the distance :func:`measure_distances`, the next coarser one the farthest
    distance in the photos, and the others follow at the ratio ``rho``.

    Args:
        levels, drawn: see :func:`measure_distances`; ``levels`` are numbered up to the finest.
        gamma: control of the rule (``lod.rules.bands``).
    """
    distance, farthest = measure_distances(levels, data, drawn, antialias, backend)
    coarser = [farthest * rho**n for n in range(min(levels) - 1)]
    return [size * gamma / data.focal for size in (*reversed(coarser), distance)] + [0.0]


@torch.no_grad()
def measure_distances(
    levels: Mapping[int, Gaussians], data: TrainingData, drawn: float, antialias: bool, backend: str
) -> tuple[float, float]:
    """Choose the distance from which the level before the finest is drawn.

    Args:
        levels: the level before the finest, and the finest.
        drawn: maximum number of splats drawn in the training views, as a fraction of those of the finest
            level; at least the number of the level before it.

    Returns:
        The distance, and the farthest distance in the views, in scene units.
    """
    views = pick_evenly(range(len(data.train)), MEASURED_VIEWS)
    samples = [_pixels(levels, view, data, antialias, backend) for view in views]
    distances, errors = (np.concatenate(column) for column in zip(*samples, strict=True))
    if not len(distances):
        return data.median_depth, data.median_depth
    edges = np.quantile(distances, np.linspace(0, 1, BINS + 1))
    counts = np.zeros((BINS, len(levels)))
    for column, gaussians in enumerate(levels.values()):
        means = gaussians.means.cpu().numpy()
        for camera in (data.train[view] for view in views):
            visible = np.linalg.norm(means[camera.sees(means, data.near)] - camera.center, axis=1)
            counts[:, column] += _sums(visible, np.ones((len(visible), 1)), edges)[:, 0]
    return float(edges[choose_switch(_sums(distances, errors, edges), counts, drawn)]), float(edges[-1])


def choose_switch(errors: np.ndarray, counts: np.ndarray, drawn: float) -> int:
    """Choose the first bin of the level before the finest: the one of least error.

    Args:
        errors: (B, 2) error of both levels in each bin of distances, ascending; the finest is last.
        counts: (B, 2) splats of both levels in each bin.
        drawn: maximum number of splats, as a fraction of those of the finest level. The other level may
            always be drawn everywhere.

    Returns:
        Index of a bin, 0 to B.
    """
    errors_by_switch, splats_by_switch = (
        np.append(0, np.cumsum(values[:, 1])) + np.append(np.cumsum(values[::-1, 0])[::-1], 0)
        for values in (errors, counts)
    )
    within_limit = splats_by_switch <= max(drawn * counts[:, 1].sum(), splats_by_switch[0])
    return int(np.where(within_limit, errors_by_switch, np.inf).argmin())


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
