"""Dropout of random splats (DropGaussian, Park et al. 2025).

With few images, splats overfit to single images; dropout makes others replace them.
"""

from __future__ import annotations

import numpy as np
import torch

from .schedules import few_photos

END = 7 / 8
"""Share of the steps after which dropout is disabled."""


class Dropout:
    """Random weights of splats, one set per step.

    Args:
        rate: share of the splats to drop, times :func:`few_photos`.
        views: number of training views.
        seed: seed of the run.
        device: device of the weights.
    """

    def __init__(self, rate: float, views: int, seed: int, device: torch.device | str = "cpu") -> None:
        self._rate = rate * few_photos(views)
        self._seed = seed
        self._device = device

    def weights(self, count: int, step: int, share: float) -> torch.Tensor | None:
        """Return weights (count,) that drop random splats from a step, or None without dropout.

        The remaining splats become more opaque to compensate.

        Args:
            share: share of the schedule's steps completed before this one.
        """
        rate = self._rate
        if rate <= 0 or share >= END:
            return None
        draws = np.random.default_rng([self._seed, step, 13]).random(count, np.float32)
        return torch.from_numpy((draws >= rate) / np.float32(1 - rate)).to(self._device)
