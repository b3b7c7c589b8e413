"""Octree-GS (Ren et al. 2024) with explicit anchors, and coarser levels merged from them.

Not in the paper: anchors of all levels together are the finest level. Coarser levels are merged from it one
by one and refined, as FLoD's, and the rule ``bands`` draws one level at each distance. The levels of the
octree add up instead, so that half of its splats are a worse image than a merge of all of them.
"""

from __future__ import annotations

import torch

from ...optimize import method
from ...optimize.anchors.explicit import ExplicitAnchors
from ...optimize.anchors.parameters import ExplicitOctreeParameters
from ...optimize.initialize import from_splats, to_splats
from ...optimize.merged_levels import MergedLevels
from ...optimize.model import Model
from ...optimize.parameters import DensityParameters
from ...optimize.schedules import LevelStages
from ...optimize.training_data import TrainingView
from ...splats.gaussians import Splats
from ...splats.levels import Level

FIRST, FULL = DensityParameters.first_resolution, DensityParameters.full_resolution
"""Sizes of images while a level is refined."""
RATIO = 4.0
"""Ratio of the distances of coarser levels."""


class Method(ExplicitAnchors):
    """Training of Octree-GS.

    Attributes:
        stages: the anchors' steps, then the merged levels in the order of training.
        merged: merging and refinement of the coarser levels, if they are merged.
        s_min: minimum size of each level, coarse to fine, in scene units: those of FLoD's rule.
        completed: completed levels as tensors, by number, once the anchors are trained.
    """

    parameters: ExplicitOctreeParameters

    def setup(self, base: Splats | None) -> None:
        super().setup(base)
        p, data = self.parameters, self.data
        self.stages = LevelStages(p.stages)
        self.merged = MergedLevels(self.stages, data, p, self.seed, self.backend)
        self.completed: dict[int, dict[str, torch.Tensor]] = {}
        if p.merges:
            self.facts, self.levels = {}, p.merged_levels + 1
            # until distances are measured, the finest level ends at the median depth
            far = data.median_depth / data.focal
            self.s_min = [far * RATIO**n for n in range(p.merged_levels - 1, -1, -1)] + [0.0]

    def level_at(self, step: int) -> int:
        return self.stages.level_at(step) if self.parameters.merges else super().level_at(step)

    def ends_level(self, step: int) -> bool:
        return step + 1 in self.stages.ends or (not self.merged.refines(step) and super().ends_level(step))

    def levels_after(self, step: int) -> list[Level]:
        """Return the finest level when all anchors have joined and when they are trained; each coarser level
        once it is refined; all levels at the end, with measured distances.
        """
        if not self.parameters.merges:
            return super().levels_after(step)
        completed = step + 1 in self.stages.ends
        if not (completed or (not self.merged.refines(step) and self.schedule.completes_levels(step))):
            return []
        number, splats = self.level_at(step), self.model.splats()
        if completed:
            self.completed[number] = from_splats(splats, self.parameters.sh_degree, self.device)
            if number == 1:
                self.s_min = self.merged.measure_min_sizes(self.completed, 1.0, RATIO)
                return [self._level(n, to_splats(self.completed[n])) for n in sorted(self.completed)]
            finest_count = len(self.completed[self.levels]["means"])
            self.model = self.merged.start(number - 1, splats, finest_count)
        return [self._level(number, splats)]

    def meta(self) -> dict:
        return method.Method.meta(self) if self.parameters.merges else super().meta()

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        return self.merged.shrink(step, FIRST, FULL) if self.merged.refines(step) else super().shrink(step)

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        return (None, 0.0) if self.merged.refines(step) else super().render_weights(view, step)

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return not self.merged.refines(step) and super().collects_stats(view, step)

    def set_learning_rates(self, step: int) -> None:
        if self.merged.refines(step):
            self.model.lr = self.merged.learning_rates(step)
        else:
            super().set_learning_rates(step)

    def control_density(self, step: int) -> None:
        if not self.merged.refines(step):
            super().control_density(step)

    # -- levels ----------------------------------------------------------------------------------------

    def _level(self, number: int, splats: Splats) -> Level:
        return Level(number, splats, {"s_min": self.s_min[number - 1]})

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        return {**super().state_dict(), **({"completed": self.completed} if self.parameters.merges else {})}

    def load_state_dict(self, state: dict) -> None:
        self.completed = state.get("completed", {})
        if self.completed:  # the model is that of a merged level
            self.model = Model(state["model"]["tensors"], self._rates)
        super().load_state_dict(state)
