"""Finishing: the levels before the finest become its most important splats, and all learn to stand together.

Not in the paper (FLoD, Sec. 5.2), which trains each level as if it were alone, before the finer ones: no step
has ever drawn two of them, nor the places where one takes over from the next. Here they are rows of one
model. Those whose smallest size hardly limits what they can show begin anew: as copies of the finest level's
splats that have the largest share of some pixel, so many that views by distance draw no more than they may.
Each step then draws what the rule chooses at a random screen size, or a level alone, so that it does not come
to need the others. Rates fall meanwhile, for the finest level as well: without that the one before it, which
has fewer splats and more steps, comes to be the better one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ...lod.blocks import spatial_order
from ...lod.rule import Values, collect_facts
from ...lod.rules.bands import RULE
from ...optimize.model import Model, splat_rates
from ...optimize.pruning import importance_threshold, log_scale_gain
from ...optimize.schedules import log_linear
from ...optimize.training_data import TrainingData
from ...rasterize import Gaussians, contributions
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera, pick_evenly
from ...splats.levels import Level
from . import FlodParameters

LEVEL = "level"
"""Column of the number of each row's level; levels follow each other, coarse to fine."""
FINE_PIXELS = 1.5
"""A level begins anew where its smallest size covers at most so many pixels at the median depth. What is
coarser was trained with fewer and larger splats than the finest level's, and keeps them."""
VIEWS_COUNTED = 24
"""In so many training views it is counted what they draw."""
COARSER = 0.8
"""Of two neighbouring levels that begin anew the coarser one has so many times the other's splats."""
LEAST_SHARE = 0.25
"""At least this share of what views draw of a level stays, whatever the others have drawn."""
SPREAD = 1.3
"""The largest factor on the run's screen size, up or down."""
FINEST_WEIGHT = 2.0
"""The finest level is drawn alone so many times as often as each other one."""
MEANS = 3.0
"""Positions begin with so many times the rate that a level ends with."""
FALL = 0.1
"""What is left of all learning rates at the end."""


def joined(levels: Mapping[int, Mapping[str, torch.Tensor]], lr: Mapping[str, LearningRate]) -> Model:
    """One model of the splats of several levels.

    Args:
        levels: tensors by name for each number, coarse to fine, smallest sizes baked in.
        lr: the learning rates to begin with.
    """
    names = next(iter(levels.values()))
    tensors = {name: torch.cat([level[name] for level in levels.values()]) for name in names}
    numbers = [torch.full_like(level["opacity_logits"], n, dtype=torch.int32) for n, level in levels.items()]
    return Model(tensors, lr, {LEVEL: torch.cat(numbers)})


@torch.no_grad()
def begun_anew(
    levels: Mapping[int, Mapping[str, torch.Tensor]],
    numbers: Sequence[int],
    s_min: Sequence[float],
    data: TrainingData,
    parameters: FlodParameters,
    gamma: float,
    backend: str,
) -> dict[int, dict[str, torch.Tensor]]:
    """Levels of the finest one's splats, so many that views by distance draw no more than ``drawn`` of it.

    Each has the ones with the largest share of some pixel. Views are as wide as photographs are continued, so
    that what continues them counts.

    Args:
        levels: as of :func:`joined`.
        numbers: those that begin anew, coarse to fine, the last one before the finest.
        gamma: the screen size that levels are chosen with.

    Returns:
        Their splats, in spatial order, none smaller than its level allows. With Mip-Splatting's filter, which
        shows of splats smaller than a pixel as little as they are, those that are raised to that size become
        as much fainter as they cover more.
    """
    p, (coarsest, *_, finest) = parameters, levels
    order = torch.from_numpy(spatial_order(levels[finest]["means"].cpu().numpy()))
    tensors = {name: tensor[order.to(tensor.device)] for name, tensor in levels[finest].items()}
    wide = (camera.widened(p.margin) for camera in data.train)
    found = contributions(Gaussians(**tensors), wide, near=data.near, antialias=p.antialias, backend=backend)
    shares, log_scales = found.largest.cpu().numpy(), tensors["log_scales"].cpu().numpy()
    rank = np.empty(len(shares))
    rank[np.argsort(-shares, kind="stable")] = np.arange(1, len(shares) + 1)
    first = {number: COARSER ** (numbers[-1] - number) / rank for number in numbers}

    values = {"gamma": gamma, "first": coarsest, "last": finest}
    views = {
        number: _views_drawing(
            (tensors if number in numbers else level)["means"], number, s_min, data, values
        )
        for number, level in levels.items()
    }
    alone = _views_drawing(tensors["means"], finest, s_min, data, {**values, "first": finest})
    own = np.concatenate([views[number] for number in numbers])
    others = sum(int(each.sum()) for number, each in views.items() if number not in numbers)
    most = max(p.drawn * alone.sum() - others, LEAST_SHARE * own.sum())
    least = importance_threshold(np.concatenate(list(first.values())), own, most)

    anew = {}
    for number in numbers:
        kept = first[number] >= least
        wider = log_scales + log_scale_gain(log_scales, shares, kept)[:, None]
        sizes = np.maximum(wider, np.float32(np.log(s_min[number - 1])))
        level = tensors | {"log_scales": torch.from_numpy(sizes).to(tensors["log_scales"])}
        if p.antialias:
            share = torch.from_numpy(np.exp(covered_log(wider) - covered_log(sizes)))
            level["opacity_logits"] = fainter(tensors["opacity_logits"], share)
        rows = torch.from_numpy(kept)
        anew[number] = {name: tensor[rows.to(tensor.device)] for name, tensor in level.items()}
    return anew


def covered_log(log_scales: np.ndarray) -> np.ndarray:
    """Logarithm of the areas (N,) that ellipsoids (N, 3) cover, but for a factor: root mean square over all
    sides to see them from."""
    squares = np.exp(2 * log_scales.astype(np.float64))
    return np.log((squares * np.roll(squares, 1, axis=1)).sum(1)) / 2


def fainter(logits: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
    """Opacities (N,), as logits, times shares (N,) in (0, 1]."""
    share = share.to(logits)
    return torch.where(share < 1, torch.logit((logits.sigmoid() * share).clamp_min(1e-6)), logits)


def rates(parameters: FlodParameters, extent: float, share: float) -> dict[str, LearningRate]:
    """The learning rates after a share of the steps."""
    lr = splat_rates(parameters, extent) | {"means": MEANS * parameters.lr_means_final * extent}
    return {name: rate * log_linear(1.0, FALL, share) for name, rate in lr.items()}


def random_values(rng: np.random.Generator, gamma: float, model: Model, alone: float) -> Values:
    """Controls of the rule for a step: a level alone with a chance of ``alone``, else all levels."""
    numbers = list(_rows(model))
    often = np.array([1.0] * (len(numbers) - 1) + [FINEST_WEIGHT])
    factor, level = SPREAD ** rng.uniform(-1, 1), int(rng.choice(numbers, p=often / often.sum()))
    first, last = (level, level) if rng.uniform() < alone else (numbers[0], numbers[-1])
    return {"gamma": gamma * factor, "first": first, "last": last}


def weights(model: Model, s_min: Sequence[float], camera: Camera, values: Values) -> torch.Tensor:
    """The rule's weights (N,) of all rows.

    Args:
        s_min: of every level of the run, coarse to fine.
    """
    means = model.read("means").cpu().numpy()
    found = [_weights(means[rows], number, s_min, camera, values) for number, rows in _rows(model).items()]
    return torch.from_numpy(np.concatenate(found)).to(model.columns[LEVEL].device)


def keep_sizes(model: Model, s_min: Sequence[float]) -> None:
    """No splat becomes smaller than its level allows."""
    with np.errstate(divide="ignore"):
        least = torch.from_numpy(np.log(np.asarray(s_min, np.float64))).to(model.columns[LEVEL].device)
    model.raise_log_scales(least.float()[model.columns[LEVEL].long() - 1])


def levels_of(model: Model, s_min: Sequence[float]) -> list[Level]:
    """The levels that were trained, coarse to fine."""
    splats, facts = model.splats(), dict(_facts(s_min))
    return [Level(number, splats.select(some), facts[number]) for number, some in _rows(model).items()]


def _weights(
    means: np.ndarray, number: int, s_min: Sequence[float], camera: Camera, values: Values
) -> np.ndarray:
    """The rule's weights (N,) of a level's splats."""
    eye, facts = np.asarray(camera.center, np.float32), collect_facts(RULE, {}, _facts(s_min), number)
    return RULE.weights(means, eye, camera.focal, {}, facts, values)


def _views_drawing(
    means: torch.Tensor, number: int, s_min: Sequence[float], data: TrainingData, values: Values
) -> np.ndarray:
    """In how many of VIEWS_COUNTED training views each of a level's splats (N,) is drawn."""
    places = means.cpu().numpy()
    views = np.zeros(len(places), np.int64)
    for camera in pick_evenly(data.train, VIEWS_COUNTED):
        shown = _weights(places, number, s_min, camera, values) > 0
        views += shown & camera.sees(places, data.near)
    return views


def _facts(s_min: Sequence[float]) -> list[tuple[int, dict[str, float]]]:
    return [(number, {"s_min": size}) for number, size in enumerate(s_min, 1)]


def _rows(model: Model) -> dict[int, slice]:
    """The rows of each level, by its number."""
    numbers, counts = model.columns[LEVEL].unique_consecutive(return_counts=True)
    ends = counts.cumsum(0)
    return {
        int(number): slice(int(end - count), int(end))
        for number, count, end in zip(numbers, counts, ends, strict=True)
    }
