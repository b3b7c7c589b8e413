"""Splats that stay in the renderer's memory, and of which every frame shows a choice."""

from __future__ import annotations

import numpy as np

from ..lod.choice import Choice, Chooser
from ..lod.rule import OPACITY
from ..splats.gaussians import Splats
from .scene import SplatSet


class KeptSet:
    """A set of splats that frames choose from: no splat is copied, drawn or not.

    Args:
        splats: in the set's own coordinates; its extras are columns that rules may ask for.
        weights: (N,), a factor on those that a choice gives.
        backend: rasterizer.

    Attributes:
        drawn: the splats as they are drawn.
    """

    def __init__(self, splats: Splats, weights: np.ndarray, backend: str) -> None:
        self.drawn, self._weights = SplatSet(splats, weights, backend), weights
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-splats.opacity_logits))
        self._chooser = Chooser(splats.means, splats.extras | {OPACITY: opacities})

    def weights(self, choice: Choice | None) -> np.ndarray | None:
        """The weights (N,) of a frame; None: the set's own."""
        if choice is None:
            return None
        some, found = self._chooser.chosen(choice)
        weights = np.zeros(len(self.drawn), np.float32)
        weights[some] = found * self._weights[some]
        return weights
