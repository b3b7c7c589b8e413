"""Splats that stay in the renderer's memory, and of which every frame shows a choice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..lod.choice import Choice
from ..lod.rule import Region, rules
from ..lod.selection import columns_of
from ..splats.gaussians import Splats
from .scene import SplatSet


@dataclass(frozen=True)
class _Part:
    """What a rule looks at of a set: which of its splats, ascending, their means, and its columns of them."""

    rows: np.ndarray
    means: np.ndarray
    columns: dict[str, np.ndarray]


class Resident:
    """A set of splats that frames choose from: no splat is copied, drawn or not.

    Args:
        splats: in the set's own coordinates; its extras are columns that rules may ask for.
        weights: (N,), a factor on those that a choice gives.
        backend: rasterizer.

    Attributes:
        drawn: the splats as they are drawn.
    """

    def __init__(self, splats: Splats, weights: np.ndarray, backend: str) -> None:
        self.drawn = SplatSet(splats, weights, backend)
        self._weights = weights
        nothing = np.zeros((len(splats), 0, 3), np.float32)
        self._told = replace(splats, quats=nothing, log_scales=nothing, sh=nothing)  # on a GPU, all else is
        self._whole: tuple[str, _Part] | None = None
        self._near: tuple[str, Region, _Part] | None = None
        self._last: tuple[Choice, np.ndarray] | None = None

    def weights(self, choice: Choice | None) -> np.ndarray | None:
        """The weights (N,) of a frame; None: the set's own. Those of one choice are found once."""
        if choice is None:
            return None
        if self._last is None or self._last[0] != choice:
            part, found = self._part(choice), np.zeros(len(self.drawn), np.float32)
            found[part.rows] = choice.weights(part.means, part.columns)
            self._last = choice, found * self._weights
        return self._last[1]

    def _part(self, choice: Choice) -> _Part:
        """What a choice need look at: while the eye stays in a region, only what may be shown there."""
        region, rule = choice.region(), rules()[choice.rule]
        if self._whole is None or self._whole[0] != rule.name:
            rows, columns = np.arange(len(self.drawn)), columns_of(rule, self._told)
            self._whole = rule.name, _Part(rows, self._told.means, columns)
        whole = self._whole[1]
        if region is None:
            return whole
        if self._near is None or self._near[:2] != (rule.name, region):
            rows = np.flatnonzero(choice.loaded(whole.columns))
            columns = {name: column[rows] for name, column in whole.columns.items()}
            self._near = rule.name, region, _Part(rows, whole.means[rows], columns)
        return self._near[2]
