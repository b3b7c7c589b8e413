"""From which distance on a coarser level is shown: what leaves least to draw (LODGE, Sec. 3, Fig. 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ...rasterize import rasterize
from ...scenes.cameras import Camera, pick_evenly
from .composite import IndexedLevel, Rows, Stack, filtered, rows_seen

MOST_CURVES = 5
"""Of more levels than this, a bundle's head has no room for what was tried."""
VIEWS = 8
"""So many training views tell the cost."""
TRIED, NEAREST, FARTHEST = 9, 0.05, 0.9
"""So many distances are tried, in equal ratios: from that which this share of the splats of some view are
nearer than, to that which this share of the splats of all views are nearer than."""
STANDING_APART = 2.0
"""A level begins at least this many times farther away than the next finer one."""


class Thresholds:
    """Finds distances one after the other, finest first (the paper's greedy strategy).

    Args:
        cameras: the training views.
        near: depth at which drawing begins, in scene units.
        backend: the rasterizer's.
        prune_weight: the least share of a pixel that keeps a splat of the coarser level.
        std: the smoothing filter's standard deviation for a distance, both in scene units.
        antialias: as of ``rasterize``.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        near: float,
        backend: str,
        prune_weight: float,
        std: Callable[[float], float],
        antialias: bool = False,
    ) -> None:
        self._cameras = pick_evenly(cameras, VIEWS)
        self._near, self._backend, self._prune_weight, self._std = near, backend, prune_weight, std
        self._antialias = antialias

    @torch.no_grad()
    def next(
        self, levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], most: float = np.inf
    ) -> tuple[float, dict[str, Any]]:
        """The distance of the next coarser level.

        Args:
            levels: the levels that there are, by number, finest first.
            d_l: their distances, in scene units.
            most: none beyond this is tried.

        Returns:
            The distance; and for a report the ``distances`` that were tried with the ``costs`` of each, and
            the cost ``before``, without the level; in few digits, because the bundle's head has little room.
        """
        tried = self._candidates(next(iter(levels.values())), STANDING_APART * max(d_l.values()), most)
        costs = [_short(self.cost(levels, d_l, distance)) for distance in tried]
        alone = [(camera, rows_seen(levels, d_l, camera, self._near)) for camera in self._cameras]
        before = _short(self._mean_in_tiles(Stack(levels, self._antialias), alone))
        return tried[int(np.argmin(costs))], {"distances": tried, "costs": costs, "before": before}

    def cost(self, levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], distance: float) -> float:
        """How many splats a tile of 16x16 pixels has to look at, on average, with one more level.

        The level is the finest one smoothed and pruned, without the steps that tune it.
        """
        finest, number = next(iter(levels.values())), min(levels) - 1
        coarser = IndexedLevel.of(filtered(finest.gaussians, self._std(distance)))
        levels, d_l = {**levels, number: coarser}, {**d_l, number: distance}
        stack = Stack(levels, self._antialias)
        pictures = [(camera, rows_seen(levels, d_l, camera, self._near)) for camera in self._cameras]
        found = stack.importance(pictures, self._near, self._backend)[stack.part[number]].numpy()
        kept = found >= self._prune_weight
        pruned = [(camera, {**rows, number: rows[number][kept[rows[number]]]}) for camera, rows in pictures]
        return self._mean_in_tiles(stack, pruned)

    def _mean_in_tiles(self, stack: Stack, pictures: Iterable[tuple[Camera, Rows]]) -> float:
        """How many splats a tile has to look at, on average over pictures."""
        tiles = []
        for camera, rows in pictures:
            some = stack.rows(rows)
            drawn = rasterize(
                stack.gaussians, camera, near=self._near, antialias=self._antialias, rows=some,
                backend=self._backend,
            )  # fmt: skip
            tiles.append(drawn.tile_counts.double().mean())
        return float(torch.stack(tiles).mean())

    def _candidates(self, finest: IndexedLevel, least: float, most: float) -> list[float]:
        """Distances to try, of at least ``least`` where ``most`` leaves room for that, in scene units."""
        seen = []
        for camera in self._cameras:
            means = finest.means[finest.in_view(camera, self._near)]
            seen.append(np.linalg.norm(means[camera.sees(means, self._near)] - camera.center, axis=1))
        seen = [distances for distances in seen if len(distances)] or [np.array([least])]
        near = min(max(min(float(np.quantile(distances, NEAREST)) for distances in seen), least), most)
        far = min(float(np.quantile(np.concatenate(seen), FARTHEST)), most)
        return [_short(d) for d in np.geomspace(near, max(far, near), TRIED)]


def _short(number: float) -> float:
    """The number in four digits."""
    return float(f"{number:.4g}")
