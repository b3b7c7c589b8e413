"""What a step of Octree-GS sees and draws: shared by explicit and neural anchors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from ...lod.rules.octree import fade_weights, target_level
from ...optimize.model import Model
from ...optimize.training_data import TrainingData, TrainingView
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera
from . import OctreeParameters
from .tree import Octree

SMALLEST = 32
"""Pixels that the shorter side of a photograph made smaller has at least."""


@dataclass
class Schedule:
    """Which levels a step draws and from how far it looks.

    Attributes:
        tree: the levels and their voxels.
        joins: the step at which each level joins.
    """

    data: TrainingData
    parameters: OctreeParameters
    seed: int
    tree: Octree
    joins: list[int] = field(init=False)

    def __post_init__(self) -> None:
        """The coarser half of the levels is there at once; each trains longer than the next (Sec. 4.3)."""
        p, levels = self.parameters, self.tree.levels
        first = max(levels // 2, 1)
        intervals = p.coarse_factor ** -np.arange(levels - first + 1.0)
        ends = np.cumsum(intervals) / intervals.sum() * p.coarse_share * p.steps
        self.joins = [0] * first + [round(end) for end in ends[:-1]]

    def level_at(self, step: int) -> int:
        """The finest level that has joined."""
        return sum(step >= join for join in self.joins)

    def hands_over(self, step: int) -> bool:
        """Whether levels are handed over after a step: when the last one joins, and at the end."""
        return step + 1 in (self.joins[-1], self.parameters.steps)

    # -- what a step sees ------------------------------------------------------------------------------

    def shrinks(self) -> list[int]:
        """How many times smaller photographs are made at most, in powers of two from 1."""
        far = self.parameters.far_share
        side = min(min(camera.width, camera.height) for camera in self.data.train)
        most = min(self.tree.levels - 1, int(np.log2(max(side / SMALLEST, 1)))) if far else 0
        return [2**i for i in range(most + 1)]

    def shrink(self, step: int) -> int:
        """How many times smaller a step's photograph is made: what one as many times farther away sees.

        Levels that finer ones have not joined yet see what they would be wanted for; later some steps do, so
        that levels learn to stand alone that no photograph is far enough away for. Not in the paper.
        """
        shrinks = self.shrinks()
        if step < self.joins[-1]:
            return shrinks[min(self.tree.levels - self.level_at(step), len(shrinks) - 1)]
        rng = np.random.default_rng([self.seed, step, 3])
        if len(shrinks) == 1 or rng.random() >= self.parameters.far_share:
            return 1
        return shrinks[int(rng.integers(1, len(shrinks)))]

    # -- what it draws ---------------------------------------------------------------------------------

    def wanted(self, camera: Camera, model: Model) -> torch.Tensor:
        """The level (N,) that a view wants at every anchor, not rounded."""
        means = model.read("means")
        distances = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
        distances *= self.tree.focal_px / camera.focal
        return target_level(distances, model.columns["bias"], self.tree.d_max, self.tree.levels)

    def weights(self, camera: Camera, model: Model, step: int, full: bool = False) -> torch.Tensor:
        """1 for the anchors (N,) that a step draws, 0 for others; ``full``: sometimes for all that joined."""
        level, newest = model.columns["level"], self.level_at(step)
        if full and np.random.default_rng([self.seed, step, 4]).random() < self.parameters.full_share:
            return (level <= newest).float()
        return (fade_weights(self.wanted(camera, model).clip(1, newest), level) >= 0.5).float()

    # -- what it changes -------------------------------------------------------------------------------

    def growing(self, step: int) -> bool:
        """Whether anchors are still added."""
        return step < self.parameters.grow_until * self.parameters.steps

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        """Whether anchors may grow for what a step sees."""
        return self.growing(step) and (view.shrink == 1 or step < self.joins[-1])

    def grows_after(self, step: int) -> bool:
        """Whether anchors are added after a step."""
        return self.growing(step) and self._interval_ends(step)

    def prunes_unseen_after(self, step: int) -> bool:
        """Whether what no view sees much of goes after a step: when growing ends, and at the end."""
        p, last = self.parameters, step + 1 == self.parameters.steps
        grown = self.growing(step) and step + 1 >= p.grow_until * p.steps
        return p.least_weight > 0 and (grown or last)

    def reassigns_after(self, step: int) -> bool:
        """Whether splats move to levels that they fit after a step."""
        return self._interval_ends(step) or step + 1 == self.parameters.steps

    def _interval_ends(self, step: int) -> bool:
        return (step + 1) % self.parameters.grow_interval == 0

    def learning_rates(self, rates: Mapping[str, LearningRate], step: int) -> dict[str, LearningRate]:
        """Learning rates at a step, by name: they fall from when growing ends. Not in the paper."""
        p = self.parameters
        after = step / p.steps - p.grow_until
        fall = p.lr_end ** (after / (1 - p.grow_until)) if after > 0 else 1.0
        return {name: rate * fall for name, rate in rates.items()}
