"""Schedules of training: intervals, learning rates and image sizes."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from functools import lru_cache
from itertools import accumulate
from math import ceil, inf, sqrt

import numpy as np

SMALL_IMAGES = 2, 4
"""Reductions of images, as if they were seen from farther away."""
SMALL_SHARE = 0.25
"""Share of the steps that refine a merged level with reduced images. On full-size images alone, a level
becomes worse than its merge at small sizes."""

FAR_END = 0.9
"""Share of the steps of a finest level after which all images have full size, for the finest details."""

ANNEAL_FROM = 0.85
"""Share of the steps of a level after which learning rates other than those of positions fall."""

MANY_PHOTOS = 40
"""Number of training photos from which measures against overfitting are off."""


def few_photos(count: int) -> float:
    """Return the strength of measures against overfitting, from 1 for no photos to 0 for MANY_PHOTOS."""
    return max(1 - count / MANY_PHOTOS, 0.0)


def log_linear(first: float, last: float, share: float) -> float:
    """Interpolate geometrically between two values; a ``share`` above 1 gives the last value."""
    share = min(share, 1.0)
    return float(first ** (1 - share) * last**share)


def annealing(share: float, final: float) -> float:
    """Return the factor on learning rates after a share of a level's steps, which falls to ``final``."""
    return log_linear(1.0, final, max(share - ANNEAL_FROM, 0.0) / (1 - ANNEAL_FROM))


def due(interval: int, step: int) -> bool:
    """Return True every ``interval`` steps, counting from step 1. The interval 0 disables."""
    return interval > 0 and step % interval == 0


class LevelStages:
    """Stages of a run, which train one level each.

    Args:
        stages: number and steps of each level, in the order of training.

    Attributes:
        ends: number of completed steps of the run at the end of each level.
    """

    def __init__(self, stages: Iterable[tuple[int, int]]) -> None:
        self._stages = list(stages)
        self.ends = list(accumulate(steps for _, steps in self._stages))

    def level_at(self, step: int) -> int:
        """Return the level that a step trains; after all levels, the last one."""
        return self._stages[self._index(step)][0]

    def steps_at(self, step: int) -> int:
        """Return the number of steps of the level that a step trains."""
        return self._stages[self._index(step)][1]

    def local_step(self, step: int) -> int:
        """Return the number of completed steps of the level that a step trains."""
        index = self._index(step)
        return step - (self.ends[index - 1] if index else 0)

    def share(self, step: int) -> float:
        """Return the completed share of the steps of the level that a step trains."""
        return self.local_step(step) / self.steps_at(step)

    def _index(self, step: int) -> int:
        return min(bisect_right(self.ends, step), len(self.ends) - 1)


class ShSchedule:
    """Active degree of harmonics, which increases during training.

    Args:
        degree: final degree.
        interval: steps between two increases.

    Attributes:
        degree: final degree.
        completed: steps of an earlier run, which this one continues.
        full_from: step from which all harmonics are active.
    """

    def __init__(self, degree: int, interval: int) -> None:
        self.degree = degree
        self._interval = max(interval, 1)
        self.completed = 0
        self.full_from = inf

    def __call__(self, step: int) -> int:
        """Return the active degree of a step."""
        if step >= self.full_from:
            return self.degree
        return min(self.degree, (self.completed + step) // self._interval)


@lru_cache(1 << 13)  # image reading asks for coming steps, too
def random_reduction(seed: int, step: int, share: float = SMALL_SHARE) -> float:
    """Draw the factor by which the image of a step is reduced: 1, or one of SMALL_IMAGES.

    Args:
        share: share of the steps with a reduced image.
    """
    rng = np.random.default_rng([seed, step, 21])
    return float(rng.choice(SMALL_IMAGES)) if rng.random() < share else 1.0


def refining_reduction(seed: int, step: int, share: float, first: float, full: float) -> float:
    """Return the factor by which the image of a step that refines a merged level is reduced.

    Args:
        share: completed share of the level's steps.
        first, full: see :func:`shrink_at`.
    """
    factor = random_reduction(seed, step)
    return factor if factor > 1 else shrink_at(share, first, full)


def shrink_at(share: float, first: float, full: float) -> float:
    """Return the factor by which images are reduced after a share of the steps.

    The number of pixels grows linearly up to full size: fewer pixels and splats suffice to learn coarse
    structure first (DashGaussian, Chen et al. 2025). Sides are rounded up to tenths, so that images of each
    size can be cached.

    Args:
        first: side of the first images, as a share of the full side.
        full: share of the steps after which images have full size.
    """
    progress = min(share / full, 1.0) if full > 0 else 1.0
    side = sqrt(first**2 + (1 - first**2) * progress)
    return 10 / ceil(10 * side - 1e-9)
