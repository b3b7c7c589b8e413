"""Finishing steps: coarser levels learn to stand beside the finest, as selective rendering draws them.

Not in the paper (FLoD, Sec. 5.2), which trains each level as if it were alone: no step has ever drawn two of
them, nor the places where one takes over from the next. Here they are rows of one model, and each step draws
what the rule chooses at a random screen size, or a coarser level alone, so that it does not come to need the
others. The finest level stays as it is: it is drawn whole as well, and no worse than before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ...lod.rule import Values, facts_of
from ...lod.rules.bands import RULE
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera
from ...splats.bundle import Level
from ..model import Model, splat_rates
from ..schedules import log_linear
from . import FlodParameters

LEVEL = "level"
"""Column of the number of each row's level; levels follow each other, coarse to fine."""
SPREAD = 2.0
"""The largest factor on the run's screen size, up or down."""
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


def rates(parameters: FlodParameters, extent: float, share: float) -> dict[str, LearningRate]:
    """The learning rates after a share of the steps."""
    lr = splat_rates(parameters, extent) | {"means": MEANS * parameters.lr_means_final * extent}
    return {name: rate * log_linear(1.0, FALL, share) for name, rate in lr.items()}


def random_values(rng: np.random.Generator, gamma: float, model: Model, alone: float) -> Values:
    """Controls of the rule for a step: a coarser level alone with a chance of ``alone``, else all levels."""
    numbers = list(_rows(model))
    factor, level = SPREAD ** rng.uniform(-1, 1), int(rng.choice(numbers[:-1]))
    first, last = (level, level) if rng.uniform() < alone else (numbers[0], numbers[-1])
    return {"gamma": gamma * factor, "first": first, "last": last}


def weights(model: Model, s_min: Sequence[float], camera: Camera, values: Values) -> torch.Tensor:
    """The rule's weights (N,) of all rows.

    Args:
        s_min: of every level of the run, coarse to fine.
    """
    means, facts = model["means"].detach().cpu().numpy(), _facts(s_min)
    found = [
        RULE.weights(
            means[rows],
            np.asarray(camera.center, np.float32),
            camera.focal,
            {},
            facts_of(RULE, {}, facts, number),
            values,
        )
        for number, rows in _rows(model).items()
    ]
    return torch.from_numpy(np.concatenate(found)).to(model["means"].device)


def hold_finest(model: Model) -> None:
    """After ``backward``: the finest level has no part in the step; without moments it stays as it is."""
    *_, finest = _rows(model).values()
    for tensor in model.adam.tensors.values():
        if tensor.grad is not None:
            tensor.grad[finest] = 0


@torch.no_grad()
def keep_sizes(model: Model, s_min: Sequence[float]) -> None:
    """No splat becomes smaller than its level allows."""
    for number, rows in _rows(model).items():
        if s_min[number - 1] > 0:
            model["log_scales"][rows].clamp_(min=float(np.log(s_min[number - 1])))


def levels_of(model: Model, s_min: Sequence[float]) -> list[Level]:
    """The levels that were trained, coarse to fine: all but the finest."""
    splats, facts, (*rows, _) = model.splats(), dict(_facts(s_min)), _rows(model).items()
    return [Level(number, splats.select(some), facts[number]) for number, some in rows]


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
