"""Choose the distance of a coarser level by the least number of splats to draw (LODGE, Sec. 3, Fig. 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ...rasterize import rasterize
from ...scenes.cameras import Camera, pick_evenly
from .composite import IndexedLevel, LevelStack, Rows, smooth, visible_rows

MAX_CURVES = 5
"""Maximum number of levels for which the bundle header stores the measured costs."""
VIEWS = 8
"""Number of training views for measuring the cost."""
CANDIDATES, NEAR_QUANTILE, FAR_QUANTILE = 9, 0.05, 0.9
"""Number of candidate distances, in equal ratios, and quantiles of the distances of visible splats that
bound them: the first in any view, the second over all views."""


class Thresholds:
    """Greedy choice of the levels' distances, finest level first, as in the paper.

    Args:
        cameras: training views.
        near: near clipping depth in scene units.
        backend: rasterizer backend.
        prune_weight: minimum share of a pixel of a splat in the coarser level.
        std: function that returns the smoothing filter's standard deviation for a distance, both in scene
            units.
        antialias: see ``rasterize``.
        min_ratio: minimum ratio between the distances of neighbouring levels.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        near: float,
        backend: str,
        prune_weight: float,
        std: Callable[[float], float],
        antialias: bool = False,
        min_ratio: float = 2.0,
    ) -> None:
        self._cameras = pick_evenly(cameras, VIEWS)
        self._near, self._backend, self._prune_weight, self._std = near, backend, prune_weight, std
        self._antialias, self._min_ratio = antialias, min_ratio

    @torch.no_grad()
    def choose(
        self, levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], max_distance: float = np.inf
    ) -> tuple[float, dict[str, Any]]:
        """Choose the distance of the next coarser level.

        Args:
            levels: existing levels by number, finest first.
            d_l: their distances in scene units.
            max_distance: maximum distance.

        Returns:
            The distance, and a report: the tried ``distances``, the ``costs`` of each, and the cost
                ``before``, without the level. Numbers are rounded to keep the bundle header small.
        """
        min_distance = self._min_ratio * max(d_l.values())
        candidates = self._candidates(next(iter(levels.values())), min_distance, max_distance)
        costs = [_round(self.cost(levels, d_l, distance)) for distance in candidates]
        views = [(camera, visible_rows(levels, d_l, camera, self._near)) for camera in self._cameras]
        current = _round(self._mean_tile_count(LevelStack(levels, self._antialias), views))
        return candidates[int(np.argmin(costs))], {"distances": candidates, "costs": costs, "before": current}

    def cost(self, levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], distance: float) -> float:
        """Return the mean number of splats per tile of 16x16 pixels with an additional level.

        The level is the finest one after smoothing and pruning, without tuning.
        """
        finest, number = next(iter(levels.values())), min(levels) - 1
        coarser = IndexedLevel.of(smooth(finest.gaussians, self._std(distance)))
        levels, d_l = {**levels, number: coarser}, {**d_l, number: distance}
        stack = LevelStack(levels, self._antialias)
        views = [(camera, visible_rows(levels, d_l, camera, self._near)) for camera in self._cameras]
        importance = stack.importance(views, self._near, self._backend)[stack.slices[number]].numpy()
        keep = importance >= self._prune_weight
        pruned = [(camera, {**rows, number: rows[number][keep[rows[number]]]}) for camera, rows in views]
        return self._mean_tile_count(stack, pruned)

    def _mean_tile_count(self, stack: LevelStack, views: Iterable[tuple[Camera, Rows]]) -> float:
        """Return the mean number of splats per tile over the images of the given rows."""
        tiles = []
        for camera, rows in views:
            selected = stack.rows(rows)
            rendering = rasterize(
                stack.gaussians, camera, near=self._near, antialias=self._antialias, rows=selected,
                backend=self._backend,
            )  # fmt: skip
            tiles.append(rendering.tile_counts.double().mean())
        return float(torch.stack(tiles).mean())

    def _candidates(self, finest: IndexedLevel, min_distance: float, max_distance: float) -> list[float]:
        """Return candidate distances in scene units; ``max_distance`` takes precedence over the minimum."""
        visible = []
        for camera in self._cameras:
            means = finest.means[finest.in_view(camera, self._near)]
            visible.append(np.linalg.norm(means[camera.sees(means, self._near)] - camera.center, axis=1))
        visible = [distances for distances in visible if len(distances)]
        visible = visible or [np.linalg.norm(finest.means - c.center, axis=1) for c in self._cameras]
        nearest = min(float(np.quantile(distances, NEAR_QUANTILE)) for distances in visible)
        near = min(max(nearest, min_distance), max_distance)
        far = min(float(np.quantile(np.concatenate(visible), FAR_QUANTILE)), max_distance)
        return [_round(d) for d in np.geomspace(near, max(far, near), CANDIDATES)]


def _round(number: float) -> float:
    """Round to four digits."""
    return float(f"{number:.4g}")
