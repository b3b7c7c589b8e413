"""Octree-GS (Ren et al. 2024) with explicit anchors, and coarser levels merged from them.

Not in the paper: anchors of all levels together are the finest level. Coarser levels are merged from it one
by one and refined, as FLoD's, and the rule ``bands`` draws one level at each distance. The levels of the
octree add up instead, so that half of its splats are a worse image than a merge of all of them.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import accumulate

import torch

from ...optimize import method
from ...optimize.anchors.explicit import ExplicitAnchors
from ...optimize.anchors.parameters import ExplicitOctreeParameters
from ...optimize.initialize import from_splats, to_splats
from ...optimize.level_distances import measure_min_sizes
from ...optimize.merging import merge
from ...optimize.model import Model
from ...optimize.parameters import DensityParameters
from ...optimize.refining import MERGED_RATE, drop_invisible, refining_rates
from ...optimize.schedules import refining_reduction
from ...optimize.training_data import TrainingView
from ...rasterize import Gaussians
from ...splats.gaussians import Splats
from ...splats.levels import Level

FIRST, FULL = DensityParameters.first_resolution, DensityParameters.full_resolution
"""Sizes of images while a level is refined."""
MEASURED_LEVELS = 3
"""Number of finest levels with measured distances."""
RATIO = 4.0
"""Ratio of the distances of coarser levels."""


class Method(ExplicitAnchors):
    """Training of Octree-GS.

    Attributes:
        s_min: minimum size of each level, coarse to fine, in scene units: those of FLoD's rule.
        completed: completed levels as tensors, by number, once the anchors are trained.
    """

    parameters: ExplicitOctreeParameters

    def setup(self, base: Splats | None) -> None:
        super().setup(base)
        p, data = self.parameters, self.data
        self._ends = list(accumulate([p.steps, *p.refining]))
        self.completed: dict[int, dict[str, torch.Tensor]] = {}
        if p.merges:
            self.facts, self.levels = {}, p.merged_levels + 1
            # until distances are measured, the finest level ends at the median depth
            far = data.median_depth / data.focal
            self.s_min = [far * RATIO**n for n in range(p.merged_levels - 1, -1, -1)] + [0.0]

    def level_at(self, step: int) -> int:
        return self.levels - self._stage(step) if self.parameters.merges else super().level_at(step)

    def ends_level(self, step: int) -> bool:
        return step + 1 in self._ends or (not self._refines(step) and super().ends_level(step))

    def levels_after(self, step: int) -> list[Level]:
        """Return the finest level when all anchors have joined and when they are trained; each coarser level
        once it is refined; all levels at the end, with measured distances.
        """
        if not self.parameters.merges:
            return super().levels_after(step)
        completed = step + 1 in self._ends
        if not (completed or (not self._refines(step) and self.schedule.completes_levels(step))):
            return []
        number, splats = self.level_at(step), self.model.splats()
        if completed:
            self.completed[number] = from_splats(splats, self.parameters.sh_degree, self.device)
            if number == 1:
                self._measure_distances()
                return [self._level(n, to_splats(self.completed[n])) for n in sorted(self.completed)]
            self._start_level(number - 1, splats)
        return [self._level(number, splats)]

    def meta(self) -> dict:
        return method.Method.meta(self) if self.parameters.merges else super().meta()

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        if not self._refines(step):
            return super().shrink(step)
        return refining_reduction(self.seed, step, self._share(step), FIRST, FULL)

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        return (None, 0.0) if self._refines(step) else super().render_weights(view, step)

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return not self._refines(step) and super().collects_stats(view, step)

    def set_learning_rates(self, step: int) -> None:
        if self._refines(step):
            rates = refining_rates(self.parameters, self.data.extent, self._share(step), MERGED_RATE)
            self.model.lr = rates
        else:
            super().set_learning_rates(step)

    def control_density(self, step: int) -> None:
        if not self._refines(step):
            super().control_density(step)

    def _refines(self, step: int) -> bool:
        """Return whether a step refines a merged level."""
        return self.parameters.merges and step >= self._ends[0]

    def _stage(self, step: int) -> int:
        """Return the number of levels that are complete before a step."""
        return min(bisect_right(self._ends, step), len(self._ends) - 1)

    def _share(self, step: int) -> float:
        """Return the completed share of the steps that refine the current level."""
        begin, end = self._ends[self._stage(step) - 1 :][:2]
        return (step - begin) / (end - begin)

    # -- levels ----------------------------------------------------------------------------------------

    def _level(self, number: int, splats: Splats) -> Level:
        return Level(number, splats, {"s_min": self.s_min[number - 1]})

    def _start_level(self, number: int, finer: Splats) -> None:
        """Start a level as a merge of the next finer one."""
        p = self.parameters
        count = round(p.share_below(self.levels - number) * len(self.completed[self.levels]["means"]))
        if number == self.levels - 1:
            finer = drop_invisible(finer, count, self.data, p, self.backend)
        tensors = from_splats(merge(finer, count), p.sh_degree, self.device)
        self.model = Model(tensors, self._rates)

    def _measure_distances(self) -> None:
        """Set the distances of the levels."""
        p, numbers = self.parameters, sorted(self.completed)[-MEASURED_LEVELS:]
        levels = {number: Gaussians(**self.completed[number]) for number in numbers}
        self.s_min = measure_min_sizes(levels, self.data, p.drawn, p.antialias, self.backend, 1.0, RATIO)

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        return {**super().state_dict(), **({"completed": self.completed} if self.parameters.merges else {})}

    def load_state_dict(self, state: dict) -> None:
        self.completed = state.get("completed", {})
        if self.completed:  # the model is that of a merged level
            self.model = Model(state["model"]["tensors"], self._rates)
        super().load_state_dict(state)
