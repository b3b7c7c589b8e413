"""Schedule of Octree-GS: image sizes, drawn levels and density control per step, for explicit and neural
anchors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from ...lod.rules.octree import fade_weights, target_level
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera
from ..model import Model
from ..training_data import TrainingData, TrainingView
from .anchor_octree import AnchorOctree
from .parameters import OctreeParameters

MIN_SIDE = 32
"""Minimum length of the shorter side of a downscaled photo, in pixels."""


@dataclass
class Schedule:
    """Schedule of levels and image sizes.

    Attributes:
        tree: levels and their voxels.
        joins: step at which each level joins.
    """

    data: TrainingData
    parameters: OctreeParameters
    seed: int
    tree: AnchorOctree
    join_steps: list[int] = field(init=False)

    def __post_init__(self) -> None:
        """Compute the join steps: some levels start at once, and each trains longer than the next
        (Sec. 4.3).
        """
        p, levels, published = self.parameters, self.tree.levels, self.parameters.joins == "published"
        initial = levels // 2 if published else max(levels // 2 - 1, 0)
        first = min((initial if p.init_level < 0 else p.init_level) + 1, levels)
        intervals = p.coarse_factor ** -np.arange(levels - first + (0.0 if published else 1.0))
        ends = np.cumsum(intervals) / max(intervals.sum(), 1e-9) * p.coarse_share * p.steps
        self.join_steps = [0] * first + [round(end) for end in ends[: levels - first]]

    def level_at(self, step: int) -> int:
        """Return the finest joined level."""
        return sum(step >= join for join in self.join_steps)

    def ends_level(self, step: int) -> bool:
        """Return whether a level joins after a step, or the step is the last one."""
        return step + 1 == self.parameters.steps or self.level_at(step + 1) > self.level_at(step)

    def completes_levels(self, step: int) -> bool:
        """Return whether levels are complete after a step: when the last one joins, and at the end."""
        return step + 1 in (self.join_steps[-1], self.parameters.steps)

    # -- images ----------------------------------------------------------------------------------------

    def shrink_factors(self) -> list[int]:
        """Return the factors for downscaling photos, powers of two from 1."""
        far_share = self.parameters.far_share
        side = min(min(camera.width, camera.height) for camera in self.data.train)
        max_exponent = min(self.tree.levels - 1, int(np.log2(max(side / MIN_SIDE, 1)))) if far_share else 0
        return [2**i for i in range(max_exponent + 1)]

    def shrink(self, step: int) -> int:
        """Return the factor by which a step's photo is downscaled, which imitates a view from farther away.

        Before all levels have joined, photos match the distance at which the joined levels are drawn.
        Later some steps use smaller photos, which trains coarse levels for distances that no photo has.
        Not in the paper.
        """
        shrink_factors = self.shrink_factors()
        if step < self.join_steps[-1]:
            return shrink_factors[min(self.tree.levels - self.level_at(step), len(shrink_factors) - 1)]
        rng = np.random.default_rng([self.seed, step, 3])
        if len(shrink_factors) == 1 or rng.random() >= self.parameters.far_share:
            return 1
        return shrink_factors[int(rng.integers(1, len(shrink_factors)))]

    # -- drawn anchors ---------------------------------------------------------------------------------

    def target_levels(self, camera: Camera, model: Model) -> torch.Tensor:
        """Return the target level (N,) of every anchor for a view, not rounded."""
        means = model.read("means")
        distances = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
        distances *= self.tree.focal_px / camera.focal
        return target_level(distances, model.columns["bias"], self.tree.d_max, self.tree.levels)

    def weights(self, camera: Camera, model: Model, step: int, full: bool = False) -> torch.Tensor:
        """Return 1 for anchors (N,) drawn in a step, else 0; ``full`` randomly draws all joined levels."""
        level, newest = model.columns["level"], self.level_at(step)
        if full and np.random.default_rng([self.seed, step, 4]).random() < self.parameters.full_share:
            return (level <= newest).float()
        return (fade_weights(self.target_levels(camera, model).clip(1, newest), level) >= 0.5).float()

    # -- density control -------------------------------------------------------------------------------

    def is_growing(self, step: int) -> bool:
        """Return whether anchors are still added."""
        return step < self.parameters.grow_until * self.parameters.steps

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        """Return whether a step contributes to the statistics for growth."""
        return (
            self.is_growing(step)
            and step >= self.parameters.stats_from
            and (view.shrink == 1 or step < self.join_steps[-1])
        )

    def grows_after(self, step: int) -> bool:
        """Return whether anchors are added after a step."""
        return self.is_growing(step) and step >= self.parameters.grow_from and self._interval_ends(step)

    def prunes_unseen_after(self, step: int) -> bool:
        """Return whether splats of low weight are removed after a step: when growth ends, and at the end."""
        p, last = self.parameters, step + 1 == self.parameters.steps
        grown = self.is_growing(step) and step + 1 >= p.grow_until * p.steps
        return p.least_weight > 0 and (grown or last)

    def reassigns_after(self, step: int) -> bool:
        """Return whether splats move to matching levels after a step."""
        return self._interval_ends(step) or step + 1 == self.parameters.steps

    def _interval_ends(self, step: int) -> bool:
        return (step + 1) % self.parameters.grow_interval == 0

    def learning_rates(self, rates: Mapping[str, LearningRate], step: int) -> dict[str, LearningRate]:
        """Return learning rates of a step by name; they fall once growth ends. Not in the paper."""
        p = self.parameters
        progress = step / p.steps - p.grow_until
        fall = p.lr_end ** (progress / (1 - p.grow_until)) if progress > 0 else 1.0
        return {name: rate * fall for name, rate in rates.items()}
