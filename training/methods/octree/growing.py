"""How anchors of an octree begin, grow, go and change level: shared by explicit and neural anchors.

A model of anchors has the columns ``level`` and ``bias``; its stats may be of each anchor, (N,), or of each
Gaussian that an anchor carries, (N, n).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch

from ...lod.rules.octree import fade_weights, target_level
from ...optimize.initialize import drop_duplicates, neighbour_scale
from ...optimize.model import Model
from ...optimize.training_data import TrainingData
from ...scenes.cameras import Camera
from . import OctreeParameters, tree
from .schedule import Schedule

FAINT = float(np.log(0.1 / 0.9))
"""Logit of the opacity that new splats have at most, so that pictures do not change when they come."""


def plant(
    data: TrainingData, parameters: OctreeParameters, seed: int, most: int
) -> tuple[Schedule, np.ndarray, np.ndarray, np.ndarray]:
    """The octree of a scene, and the points that training begins with.

    Args:
        most: of anchors.

    Returns:
        The schedule with its tree; points (N, 3), their colours (N, 3) uint8, and their levels (N,).
    """
    p = parameters
    everywhere, _ = drop_duplicates(data.full_scene.points, data.full_scene.point_colors)
    points, colors = drop_duplicates(data.scene.points, data.scene.point_colors)
    octree = tree.build(
        everywhere, data.full_train, focal_px=data.focal, footprint=p.footprint,
        quantiles=(p.nearest, p.farthest), levels=p.levels, coarser=p.coarser_levels,
    )  # fmt: skip
    schedule = Schedule(data, p, seed, octree)
    level = tree.anchors(points, octree)
    chosen = np.flatnonzero(level > 0)
    chosen = chosen[wanted_by_views(schedule, points[chosen], level[chosen])]
    if len(chosen) > most:
        chosen = np.sort(np.random.default_rng(seed).choice(chosen, most, replace=False))
    return schedule, points[chosen], colors[chosen], level[chosen]


def wanted_by_views(schedule: Schedule, points: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Whether enough views want the level (N,) at a point (N, 3): the paper's weeding, by distance alone."""
    octree, cameras = schedule.tree, schedule.data.train
    wanting = np.zeros(len(points))
    for camera in cameras:
        distances = np.linalg.norm(points - camera.center, axis=1)
        distances *= octree.focal_px / camera.focal
        wanted = target_level(distances, 0.0, octree.d_max, octree.levels)
        wanting += fade_weights(wanted, level) >= 0.5
    return wanting >= max(schedule.parameters.visible_share * len(cameras), 1)


def log_spacing(points: np.ndarray, level: np.ndarray, columns: int) -> torch.Tensor:
    """Log of how far apart points (N, 3) of a level (N,) and coarser ones are, (N, columns)."""
    scale = np.empty(len(points))
    for number in np.unique(level):
        upto = level <= number
        scale[level == number] = neighbour_scale(points[upto])[level[upto] == number]
    return torch.from_numpy(np.repeat(np.log(scale)[:, None], columns, 1)).float()


@torch.no_grad()
def steep(schedule: Schedule, model: Model, step: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The Gaussians whose gradients are large (Octree-GS, Sec. 4.2); levels of which much is so gain bias.

    Returns:
        (C,) each, by falling gradient: the anchor, which of its Gaussians it is, and the level to grow in,
        the anchor's own, or the next if the gradient is above that level's threshold.
    """
    p, columns = schedule.parameters, model.columns
    gradient, level = model.mean_gradient().view(len(model), -1), columns["level"]
    harder = 2**p.grow_harder
    rising = harder ** (level - 1 - p.coarser_levels).clamp_min(0)
    threshold = (p.grad_threshold * schedule.data.threshold_scale * rising)[:, None]
    target = level[:, None].expand_as(gradient)
    if step >= p.coarse_share * p.steps:
        target = (target + (gradient >= threshold * harder)).clamp_max(schedule.tree.levels)
        columns["bias"] += p.bias_rate * (gradient >= 0.25 * threshold).any(1)
    source, which = torch.nonzero(gradient >= threshold).unbind(1)
    order = torch.argsort(gradient[source, which], descending=True, stable=True)
    source, which = source[order], which[order]
    return source, which, target[source, which]


def with_room(
    schedule: Schedule, model: Model, rows: Mapping[str, torch.Tensor], step: int, most: int
) -> dict[str, torch.Tensor]:
    """Of the rows proposed, in order, those that there is room for, in free voxels that views want.

    What there is room for rises with the square of the steps to ``most``, so that most of it is left for
    finer levels.
    """
    p = schedule.parameters
    room = int(most * min((step + 1) / (p.grow_until * p.steps), 1.0) ** 2) - len(model)
    free = _free(schedule, model, rows["means"], rows["level"])[: max(room, 0)]
    return {name: row[free] for name, row in rows.items()}


def _free(schedule: Schedule, model: Model, means: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
    """Indices, in order, of places that views want and that are the first in a voxel without an anchor."""

    def keys(means: torch.Tensor, level: torch.Tensor) -> np.ndarray:
        return schedule.tree.keys(means.detach().double().cpu().numpy(), level.long().cpu().numpy())

    proposed = keys(means, level)
    taken = keys(model.read("means"), model.columns["level"])
    _, first = np.unique(proposed, return_index=True)
    free = np.sort(first[~np.isin(proposed[first], taken)])
    wanted = wanted_by_views(schedule, means[free].double().cpu().numpy(), level[free].cpu().numpy())
    return torch.from_numpy(free[wanted]).to(means.device)


@torch.no_grad()
def unseen(
    schedule: Schedule,
    model: Model,
    step: int,
    largest_weights: Callable[[Camera, int, torch.Tensor], torch.Tensor],
) -> torch.Tensor:
    """Which Gaussians that have joined no view, near or far, sees much of (RadSplat). Not in the paper.

    Args:
        largest_weights: gives each Gaussian's largest blending weight in a training view: of the camera, the
            view's index and the weights (N,) of anchors.

    Returns:
        Booleans in the shape of ``seen``.
    """
    largest = torch.zeros_like(model.read("seen"))
    for view in range(len(schedule.data.train)):
        for shrink in schedule.shrinks():
            camera = schedule.data.camera(view, shrink)
            weights = schedule.weights(camera, model, step)
            torch.maximum(largest, largest_weights(camera, view, weights), out=largest)
    unjoined = model.columns["level"] > schedule.level_at(step)
    poor = largest < schedule.parameters.least_weight
    poor[unjoined] = False
    return poor


def fitting_levels(
    schedule: Schedule, level: torch.Tensor, means: torch.Tensor, log_scales: torch.Tensor, newest: int
) -> torch.Tensor:
    """The level (N,) nearest to the given one for splats at places (N, 3), with logs of scales (N, 3).

    Wide ones would be seen from farther away than their level is drawn, narrow ones would be drawn from where
    they are not seen. Narrow ones move to ``newest`` at most, to the first level that photographs want at
    most, and only where one does want it: so hardly a photograph is drawn otherwise. Not in the paper.
    """
    p, octree = schedule.parameters, schedule.tree
    pixel = octree.d_max / octree.focal_px  # at level 1's distance
    width = log_scales.amax(1).sub(float(np.log(pixel))) / float(np.log(2))
    finer, coarser = (1 + torch.tensor(limit).log2() - width for limit in (p.narrowest, p.widest))
    finer = torch.maximum(level, finer.ceil().clamp_max(min(newest, p.coarser_levels + 1)))
    narrow = torch.nonzero(finer > level)[:, 0]
    wanted = wanted_by_views(schedule, means[narrow].double().cpu().numpy(), finer[narrow].cpu().numpy())
    narrow = narrow[torch.from_numpy(wanted).to(narrow.device)]
    level = level.index_copy(0, narrow, finer[narrow])
    return torch.minimum(level, coarser.floor().clamp_min(1))
