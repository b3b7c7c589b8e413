"""Background colours of training steps."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from .training_data import TrainingData


class Background:
    """Colour behind the images of a step, random or black.

    It is always random for transparent images, so that splats match their transparency.

    Args:
        data: training data.
        random: use random colours for opaque images too.
        seed: seed of the run.

    Attributes:
        end: step from which the background is black.
    """

    def __init__(self, data: TrainingData, random: bool, seed: int) -> None:
        self._data = data
        self._wanted = random
        self._seed = seed
        self.end = float("inf")

    @cached_property
    def _random(self) -> bool:
        return self._wanted or self._data.transparent

    def __call__(self, step: int) -> tuple[float, float, float]:
        """Return the colour of a step, the same for all of its images."""
        if step >= self.end or not self._random:
            return 0.0, 0.0, 0.0
        red, green, blue = np.random.default_rng([self._seed, step, 5]).random(3)
        return red, green, blue

    @torch.no_grad()
    def remove(self, image: torch.Tensor, alpha: torch.Tensor, step: int) -> torch.Tensor:
        """Replace the background of a step's image (H, W, 3) by black."""
        return image - (1 - alpha[..., None]) * torch.tensor(self(step)).to(image)
