"""Finishing steps of FLoD: restart the levels before the finest, then train all as selected by distance.

Not in the paper (FLoD, Sec. 5.2), which trains each level on its own, before the finer ones; no step
renders two levels, nor the transitions between them. Here the finest levels are rows of one model. Levels
whose minimum size hardly limits their detail restart as copies of the most important splats of the finest
level, few enough to meet the budget of views by distance. Each step then renders the selection of the
rule at a random screen size, or a single level, so that each level also works without the others.
Learning rates fall meanwhile, for the finest level as well; otherwise the level before it, which has
fewer splats and more steps, becomes the better one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ...lod.rule import Values, collect_facts
from ...lod.rules.bands import RULE
from ...optimize.model import Model
from ...optimize.parameters import Parameters
from ...optimize.pruning import importance_threshold, log_scale_gain
from ...optimize.training_data import TrainingData
from ...rasterize import Gaussians, contributions
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera, pick_evenly
from ...splats.levels import Level
from ...splats.morton import spatial_order

LEVEL = "level"
"""Column with the level number of each row; levels are consecutive, coarse to fine."""
FINE_PIXELS = 1.5
"""A level restarts if its minimum size is at most this many pixels at the median depth. Coarser levels were
trained with fewer and larger splats than the finest level has, and keep them."""
COUNTED_VIEWS = 24
"""Number of training views in which drawn splats are counted."""
COUNT_RATIO = 0.8
"""Splat count of a restarted level relative to the next finer restarted level."""
MIN_SHARE = 0.25
"""Minimum fraction of the drawn splats of restarted levels that remain, regardless of other levels."""
MAX_GAMMA_FACTOR = 1.3
"""Maximum random factor on the screen size, up or down."""
FINEST_WEIGHT = 2.0
"""Relative frequency of the finest level in steps that render a single level."""


def join_levels(levels: Mapping[int, Mapping[str, torch.Tensor]], lr: Mapping[str, LearningRate]) -> Model:
    """Combine the splats of several levels in one model.

    Args:
        levels: tensors by name for each level number, coarse to fine, with minimum sizes applied.
        lr: initial learning rates.
    """
    names = next(iter(levels.values()))
    tensors = {name: torch.cat([level[name] for level in levels.values()]) for name in names}
    numbers = [torch.full_like(level["opacity_logits"], n, dtype=torch.int32) for n, level in levels.items()]
    return Model(tensors, lr, {LEVEL: torch.cat(numbers)})


@torch.no_grad()
def restart_levels(
    levels: Mapping[int, Mapping[str, torch.Tensor]],
    limits: Mapping[int, int],
    s_min: Sequence[float],
    data: TrainingData,
    parameters: Parameters,
    drawn: float,
    gamma: float,
    backend: str,
) -> dict[int, dict[str, torch.Tensor]]:
    """Restart levels with the most important splats of the finest level.

    Importance is a splat's maximum share of a pixel. The levels get as many splats as views by distance
    may draw. Views include the margins, so that margin splats count.

    Args:
        levels: see :func:`join_levels`.
        limits: maximum splat count of each level to restart, coarse to fine, the last one before the finest.
        drawn: number of splats that views by distance may draw, as a fraction of those of the finest level.
        gamma: screen size for the selection of levels.

    Returns:
        Tensors of the restarted levels, in spatial order, with minimum sizes applied. With
            Mip-Splatting's filter, which fades splats below a pixel, enlarged splats become fainter in
            proportion to their area.
    """
    p, (coarsest, *_, finest), numbers = parameters, levels, list(limits)
    order = torch.from_numpy(spatial_order(levels[finest]["means"].cpu().numpy()))
    tensors = {name: tensor[order.to(tensor.device)] for name, tensor in levels[finest].items()}
    wide = (camera.widened(p.margin) for camera in data.train)
    contribution = contributions(
        Gaussians(**tensors), wide, near=data.near, antialias=p.antialias, backend=backend
    )
    importance = contribution.largest.cpu().numpy()
    rank = np.empty(len(importance))
    rank[np.argsort(-importance, kind="stable")] = np.arange(1, len(importance) + 1)
    scores = {number: COUNT_RATIO ** (numbers[-1] - number) / rank for number in numbers}

    values = {"gamma": gamma, "first": coarsest, "last": finest}
    views = {
        number: _count_views((tensors if number in numbers else level)["means"], number, s_min, data, values)
        for number, level in levels.items()
    }
    finest_views = _count_views(tensors["means"], finest, s_min, data, {**values, "first": finest})
    own_views = np.concatenate([views[number] for number in numbers])
    other_splats = sum(int(counts.sum()) for number, counts in views.items() if number not in numbers)
    max_views = max(drawn * finest_views.sum() - other_splats, MIN_SHARE * own_views.sum())
    threshold = importance_threshold(np.concatenate(list(scores.values())), own_views, max_views)
    masks = {number: (scores[number] >= threshold) & (rank <= limits[number]) for number in numbers}
    return {
        number: _select_enlarged(tensors, mask, importance, s_min[number - 1], p.antialias)
        for number, mask in masks.items()
    }


def _select_enlarged(
    tensors: Mapping[str, torch.Tensor],
    mask: np.ndarray,
    importance: np.ndarray,
    s_min: float,
    antialias: bool,
) -> dict[str, torch.Tensor]:
    """Return the splats of a mask (N,), enlarged to cover the area of all; see :func:`restart_levels`."""
    log_scales = tensors["log_scales"].cpu().numpy()
    grown_scales = log_scales + log_scale_gain(log_scales, importance, mask)[:, None]
    sizes = np.maximum(grown_scales, np.float32(np.log(s_min)))
    level = {**tensors, "log_scales": torch.from_numpy(sizes).to(tensors["log_scales"])}
    if antialias:
        fraction = torch.from_numpy(np.exp(log_covered_area(grown_scales) - log_covered_area(sizes)))
        level["opacity_logits"] = scale_opacities(tensors["opacity_logits"], fraction)
    rows = torch.from_numpy(mask)
    return {name: tensor[rows.to(tensor.device)] for name, tensor in level.items()}


def log_covered_area(log_scales: np.ndarray) -> np.ndarray:
    """Return the log of the areas (N,) of ellipsoids (N, 3), up to a constant: root mean square over
    directions.
    """
    squares = np.exp(2 * log_scales.astype(np.float64))
    return np.log((squares * np.roll(squares, 1, axis=1)).sum(1)) / 2


def scale_opacities(logits: torch.Tensor, fraction: torch.Tensor) -> torch.Tensor:
    """Multiply opacities (N,), given as logits, by factors (N,) in (0, 1]."""
    fraction = fraction.to(logits)
    return torch.where(fraction < 1, torch.logit((logits.sigmoid() * fraction).clamp_min(1e-6)), logits)


def random_values(rng: np.random.Generator, gamma: float, model: Model, single_share: float) -> Values:
    """Draw the rule's controls for a step: a single level with probability ``single_share``, else all
    levels.
    """
    numbers = list(_rows(model))
    frequencies = np.array([1.0] * (len(numbers) - 1) + [FINEST_WEIGHT])
    factor = MAX_GAMMA_FACTOR ** rng.uniform(-1, 1)
    level = int(rng.choice(numbers, p=frequencies / frequencies.sum()))
    first, last = (level, level) if rng.uniform() < single_share else (numbers[0], numbers[-1])
    return {"gamma": gamma * factor, "first": first, "last": last}


def weights(model: Model, s_min: Sequence[float], camera: Camera, values: Values) -> torch.Tensor:
    """Return the rule's weights (N,) of all rows.

    Args:
        s_min: minimum size of every level of the run, coarse to fine.
    """
    means = model.read("means").cpu().numpy()
    level_weights = [
        _weights(means[rows], number, s_min, camera, values) for number, rows in _rows(model).items()
    ]
    return torch.from_numpy(np.concatenate(level_weights)).to(model.columns[LEVEL].device)


def raise_to_min_sizes(model: Model, s_min: Sequence[float]) -> None:
    """Raise the scales of splats to the minimum of their level."""
    with np.errstate(divide="ignore"):
        threshold = torch.from_numpy(np.log(np.asarray(s_min, np.float64))).to(model.columns[LEVEL].device)
    model.raise_log_scales(threshold.float()[model.columns[LEVEL].long() - 1])


def split_levels(model: Model, s_min: Sequence[float]) -> list[Level]:
    """Split the model into its levels, coarse to fine."""
    splats, facts = model.splats(), dict(_facts(s_min))
    return [Level(number, splats.select(rows), facts[number]) for number, rows in _rows(model).items()]


def _weights(
    means: np.ndarray, number: int, s_min: Sequence[float], camera: Camera, values: Values
) -> np.ndarray:
    """Return the rule's weights (N,) of a level's splats."""
    position, facts = np.asarray(camera.center, np.float32), collect_facts(RULE, {}, _facts(s_min), number)
    return RULE.weights(means, position, camera.focal, {}, facts, values)


def _count_views(
    means: torch.Tensor, number: int, s_min: Sequence[float], data: TrainingData, values: Values
) -> np.ndarray:
    """Count for each splat of a level (N,) in how many of COUNTED_VIEWS training views it is drawn."""
    positions = means.cpu().numpy()
    views = np.zeros(len(positions), np.int64)
    for camera in pick_evenly(data.train, COUNTED_VIEWS):
        drawn = _weights(positions, number, s_min, camera, values) > 0
        views += drawn & camera.sees(positions, data.near)
    return views


def _facts(s_min: Sequence[float]) -> list[tuple[int, dict[str, float]]]:
    return [(number, {"s_min": size}) for number, size in enumerate(s_min, 1)]


def _rows(model: Model) -> dict[int, slice]:
    """Return the rows of each level by number."""
    numbers, counts = model.columns[LEVEL].unique_consecutive(return_counts=True)
    ends = counts.cumsum(0)
    return {
        int(number): slice(int(end - count), int(end))
        for number, count, end in zip(numbers, counts, ends, strict=True)
    }
