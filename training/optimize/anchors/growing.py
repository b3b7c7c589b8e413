"""Creation, growth, pruning, level changes and volumes of octree anchors, explicit and neural.

A model of anchors has the columns ``level`` and ``bias``. Its statistics are per anchor, (N,), or per
Gaussian of an anchor, (N, n).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from ...lod.rules.octree import fade_weights, target_level
from ...scenes.cameras import Camera
from ..initialize import drop_duplicates, neighbor_scale
from ..model import Model
from ..training_data import TrainingData
from . import anchor_octree
from .parameters import OctreeParameters
from .schedule import Schedule

MAX_NEW_LOGIT = float(np.log(0.1 / 0.9))
"""Maximum opacity logit of new splats, low enough not to change images."""


def create_anchors(
    data: TrainingData, parameters: OctreeParameters, seed: int, max_anchors: int, min_voxel: float = 0.0
) -> tuple[Schedule, np.ndarray, np.ndarray, np.ndarray]:
    """Build the octree of a scene and choose the initial points.

    Args:
        max_anchors: maximum number of anchors.
        min_voxel: minimum edge of level 1's voxels, in scene units.

    Returns:
        The schedule with its tree; points (N, 3), their colours (N, 3) uint8, and their levels (N,).
    """
    p = parameters
    all_points, _ = drop_duplicates(data.full_scene.points, data.full_scene.point_colors)
    points, colors = drop_duplicates(data.scene.points, data.scene.point_colors)
    tree = anchor_octree.build(
        all_points, data.full_train, focal_px=data.focal, footprint=p.footprint,
        quantiles=(p.nearest, p.farthest), levels=p.levels, coarser=p.coarser_levels,
    )  # fmt: skip
    schedule = Schedule(data, p, seed, replace(tree, voxel=max(tree.voxel, min_voxel)))
    level = anchor_octree.anchors(points, schedule.tree)
    rows = np.flatnonzero(level > 0)
    rows = rows[needed_by_views(schedule, points[rows], level[rows])]
    if len(rows) > max_anchors:
        rows = np.sort(np.random.default_rng(seed).choice(rows, max_anchors, replace=False))
    return schedule, points[rows], colors[rows], level[rows]


def needed_by_views(schedule: Schedule, points: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return whether enough views need the level (N,) of a point (N, 3): the pruning of the paper, by
    distance alone.
    """
    tree, cameras = schedule.tree, schedule.data.train
    view_count = np.zeros(len(points))
    for camera in cameras:
        distances = np.linalg.norm(points - camera.center, axis=1)
        distances *= tree.focal_px / camera.focal
        needed = target_level(distances, 0.0, tree.d_max, tree.levels)
        view_count += fade_weights(needed, level) >= 0.5
    return view_count >= max(schedule.parameters.visible_share * len(cameras), 1)


def log_spacing(points: np.ndarray, level: np.ndarray, columns: int) -> torch.Tensor:
    """Return the log distance of points (N, 3) to neighbours of their level (N,) and coarser ones, (N,
    columns).
    """
    scale = np.empty(len(points))
    for number in np.unique(level):
        is_coarser = level <= number
        scale[level == number] = neighbor_scale(points[is_coarser])[level[is_coarser] == number]
    return torch.from_numpy(np.repeat(np.log(scale)[:, None], columns, 1)).float()


@torch.no_grad()
def select_growth(
    schedule: Schedule, model: Model, step: int, ready: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Select Gaussians with large gradients for growth (Octree-GS, Sec. 4.2), and increase the bias of
    anchors with many.

    Args:
        ready: Gaussians with enough statistics, in the shape of ``seen``; others do not grow. The bias then
            depends on an anchor's mean gradient over them. None uses all, and the largest gradient.

    Returns:
        (C,) each, by decreasing gradient: the anchor, the index of its Gaussian, and the level to grow
            in: the anchor's own, or the next one if the gradient exceeds that level's threshold.
    """
    p, columns = schedule.parameters, model.columns
    gradient, level = model.mean_gradient().view(len(model), -1), columns["level"]
    rise = 2**p.grow_harder
    factor = rise ** (level - 1 - p.coarser_levels).clamp_min(0)
    threshold = (p.grad_threshold * p.threshold_factor(schedule.data.threshold_scale) * factor)[:, None]
    target = level[:, None].expand_as(gradient)
    if step >= p.coarse_share * p.steps:
        if p.grow_next:
            target = (target + (gradient >= threshold * rise)).clamp_max(schedule.tree.levels)
        bias_gradient = gradient.amax(1)
        if ready is not None:
            bias_gradient = (gradient * ready).sum(1) / ready.sum(1).clamp_min(1)
        columns["bias"] += p.bias_rate * (bias_gradient >= 0.25 * threshold[:, 0])
    selected = gradient >= threshold
    source, offset_index = torch.nonzero(selected if ready is None else selected & ready).unbind(1)
    order = torch.argsort(gradient[source, offset_index], descending=True, stable=True)
    source, offset_index = source[order], offset_index[order]
    return source, offset_index, target[source, offset_index]


def limit_growth(
    schedule: Schedule, model: Model, rows: Mapping[str, torch.Tensor], step: int, max_anchors: int
) -> dict[str, torch.Tensor]:
    """Limit proposed rows, in order, to the budget and to free voxels that views need.

    The budget grows with a power of the steps up to ``max_anchors``, which reserves most of it for finer
    levels.

    Args:
        rows: tensors (M, ...) by name, with ``means`` and ``level``; the first ones take precedence.
        step: number of the step, from 0.
        max_anchors: maximum number of anchors of the model.
    """
    p = schedule.parameters
    share = min((step + 1) / max(p.grow_until * p.steps, 1), 1.0) ** p.room_exponent
    room = int(max_anchors * share) - len(model)
    free = _free_positions(schedule, model, rows["means"], rows["level"])[: max(room, 0)]
    return {name: row[free] for name, row in rows.items()}


def _free_positions(
    schedule: Schedule, model: Model, means: torch.Tensor, level: torch.Tensor
) -> torch.Tensor:
    """Return indices, in order, of needed positions that are the first in a voxel without an anchor."""

    def keys(means: torch.Tensor, level: torch.Tensor) -> np.ndarray:
        return schedule.tree.keys(means.detach().double().cpu().numpy(), level.long().cpu().numpy())

    proposed = keys(means, level)
    occupied = keys(model.read("means"), model.columns["level"])
    _, first = np.unique(proposed, return_index=True)
    free = np.sort(first[~np.isin(proposed[first], occupied)])
    needed = needed_by_views(schedule, means[free].double().cpu().numpy(), level[free].cpu().numpy())
    return torch.from_numpy(free[needed]).to(means.device)


@torch.no_grad()
def find_unseen(
    schedule: Schedule,
    model: Model,
    step: int,
    largest_weights: Callable[[Camera, int, torch.Tensor], torch.Tensor],
) -> torch.Tensor:
    """Return which joined Gaussians have low weight in all views, near or far (RadSplat). Not in the paper.

    Args:
        largest_weights: function of the camera, the index of the training view and the weights (N,) of
            anchors that returns each Gaussian's maximum blending weight.

    Returns:
        Booleans in the shape of ``seen``.
    """
    largest = torch.zeros_like(model.read("seen"))
    for view in range(len(schedule.data.train)):
        for shrink in schedule.shrink_factors():
            camera = schedule.data.camera(view, shrink)
            weights = schedule.weights(camera, model, step)
            torch.maximum(largest, largest_weights(camera, view, weights), out=largest)
    not_joined = model.columns["level"] > schedule.level_at(step)
    low_weight = largest < schedule.parameters.least_weight
    low_weight[not_joined] = False
    return low_weight


def matching_levels(
    schedule: Schedule, level: torch.Tensor, means: torch.Tensor, log_scales: torch.Tensor, newest: int
) -> torch.Tensor:
    """Return the matching level (N,) closest to the current one, for splats at (N, 3) with log scales (N,
    3).

    Wide splats would be visible beyond the distance at which their level is drawn, narrow ones would be
    drawn where they are too small to see. Narrow splats move at most to ``newest`` and to the first level
    that photos need, and only if a photo needs it, so that images of photos hardly change. Not in the
    paper.

    Args:
        level: (N,) current levels as floats.
        newest: finest level that has joined.
    """
    p, tree = schedule.parameters, schedule.tree
    pixel = tree.d_max / tree.focal_px  # at level 1's distance
    width = log_scales.amax(1).sub(float(np.log(pixel))) / float(np.log(2))
    finer, coarser = (1 + torch.tensor(limit).log2() - width for limit in (p.narrowest, p.widest))
    finer = torch.maximum(level, finer.ceil().clamp_max(min(newest, p.coarser_levels + 1)))
    narrow = torch.nonzero(finer > level)[:, 0]
    needed = needed_by_views(schedule, means[narrow].double().cpu().numpy(), finer[narrow].cpu().numpy())
    narrow = narrow[torch.from_numpy(needed).to(narrow.device)]
    level = level.index_copy(0, narrow, finer[narrow])
    return torch.minimum(level, coarser.floor().clamp_min(1))


def mean_volume(scales: torch.Tensor) -> torch.Tensor:
    """Return the mean product of scales (M, 3), 0 if a view draws no splats (Octree-GS, Sec. 7.1)."""
    return scales.prod(1).sum() / max(len(scales), 1)
