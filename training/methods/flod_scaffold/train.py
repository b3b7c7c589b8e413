"""FLoD (Seo et al. 2025, Sec. 4.4) on Scaffold-GS (Lu et al. 2024): neural anchors, level by level.

A level trains the anchors of Octree-GS with a single octree level, whose scales have the minimum of the level
added (FLoD, Eq. 4). Its voxels are at least as large as this minimum, which replaces overlap pruning
(Sec. 4.3). Each level is baked when its steps end. The next one continues its anchors and networks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ...lod.rules.bands import initial_gamma, min_scales
from ...optimize.anchors import growing
from ...optimize.density_control import constrained_log_scales
from ...optimize.schedules import LevelStages
from ...optimize.training_data import TrainingView
from ...splats.gaussians import Splats
from ...splats.levels import Level
from ..octree_neural import train as octree_neural
from ..octree_neural.train import DISABLED_LOGIT
from . import FlodScaffoldParameters


class Method(octree_neural.Method):
    """Training of FLoD on Scaffold-GS.

    Attributes:
        run_parameters: parameters of all levels; ``parameters`` are those of the current one.
        level: number of the current level.
        stages: levels in the order of training.
        s_min: minimum standard deviation of each level, coarse to fine, in scene units.
    """

    run_parameters: FlodScaffoldParameters

    def setup(self, base: Splats | None) -> None:
        assert isinstance(self.parameters, FlodScaffoldParameters)
        self.run_parameters = p = self.parameters
        pixel = self.data.median_depth / self.data.focal
        self.s_min = min_scales(p.s_min_1 or p.coarsest * pixel, p.rho, p.levels)
        self.stages = LevelStages(enumerate(p.steps, 1))
        self._use_level(1)
        super().setup(base)
        self._constrain()
        self.image_model, self.facts, self.levels = None, {}, p.levels
        if p.levels > 1:
            self.controls = {"gamma": initial_gamma(self.s_min[-2] / pixel)}

    def _use_level(self, number: int) -> None:
        """Set the parameters and the voxels of a level."""
        self.level, self.parameters = number, self.run_parameters.of_level(number)
        self.min_voxel = self.s_min[number - 1]

    def start_anchors(self) -> dict[str, torch.Tensor]:
        """Return anchors at the scene's points, whose Gaussians have half of the points' spacing if the
        constraint allows.
        """
        rows = super().start_anchors()
        spacing = rows["log_scales"][:, 3:].exp()
        rows["log_scales"][:, 3:] = constrained_log_scales(spacing, 2 * self.min_voxel)
        return rows

    def _constrain(self) -> None:
        """Add the minimum of the current level to the scales of all Gaussians (FLoD, Eq. 4)."""
        self.decoder = replace(self.decoder, min_scale=self.s_min[self.level - 1])

    def level_at(self, step: int) -> int:
        return self.stages.level_at(step)

    def levels_after(self, step: int) -> list[Level]:
        """Return the level that the step completes, baked, and start the next one."""
        if step + 1 not in self.stages.ends:
            return []
        s_min = self.s_min[self.level - 1]
        splats = self.with_margins(self.bake())
        splats.extras = {}
        splats.log_scales = np.maximum(splats.log_scales, smallest_log_scale(s_min))
        finished = Level(self.level, splats, {"s_min": s_min})
        if self.level < self.run_parameters.levels:
            self.start_level(self.level + 1)
        return [finished]

    def meta(self) -> dict:
        footprint = self.s_min[0] * self.data.focal / self.data.median_depth
        return {"rho": self.run_parameters.rho, **super().meta(), "footprint_px": footprint}

    # -- steps -----------------------------------------------------------------------------------------

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return super().collects_stats(view, self.stages.local_step(step))

    def set_learning_rates(self, step: int) -> None:
        super().set_learning_rates(self.stages.local_step(step))

    def control_density(self, step: int) -> None:
        super().control_density(self.stages.local_step(step))

    # -- levels ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def start_level(self, number: int) -> None:
        """Start a level from the one before: same scales, a smaller constraint, new optimizers (Eq. 5).

        Its finer voxels get anchors at the scene's points where they have none. Gaussians that the level
        before disabled restart, because their anchor keeps its voxel from others.
        """
        rows = {name: tensor.detach() for name, tensor in self._next_tensors(self.s_min[number - 1]).items()}
        if self.parameters.direct:
            self._enable_gaussians(rows)
        self._use_level(number)
        points = self.start_anchors()
        ones = torch.ones(len(rows["means"]))
        self.model = self._new_model(rows, ones, torch.zeros_like(ones))
        order = np.random.default_rng([self.seed, number, 2]).permutation(len(points["level"]))
        points = {name: row[torch.from_numpy(order)].to(self.device) for name, row in points.items()}
        self.model.append(growing.limit_growth(self.schedule, self.model, points, 0, self._max_anchors))
        self.restart_networks_adam()
        self._constrain()

    def _enable_gaussians(self, rows: dict[str, torch.Tensor]) -> None:
        """Give disabled Gaussians the offset and opacity of new ones."""
        looks = rows["looks"].clone()
        disabled = looks[..., 0] < DISABLED_LOGIT / 2
        looks[..., 0][disabled] = growing.MAX_NEW_LOGIT
        spread = self._spread.to(looks).expand_as(rows["offsets"])
        rows |= {"looks": looks, "offsets": torch.where(disabled[..., None], spread, rows["offsets"])}

    def _next_tensors(self, new_min: float) -> dict[str, torch.Tensor]:
        """Return the model's tensors with scales that a smaller constraint leaves unchanged (FLoD, Eq. 5).

        A Gaussian's scale is its anchor's, E, times a fraction σ. With the difference of the constraints, Δ,
        E' = E + Δ / mean(σ) keeps the mean scale of the anchor's Gaussians. If these have looks of their own,
        σ' = (E σ + Δ) / E' keeps every scale.
        """
        tensors = dict(self.model.adam.tensors)
        delta = self.s_min[self.level - 1] - new_min
        share = self.decoder.relative_scales(self.model)
        old = tensors["log_scales"][:, 3:].exp()
        new = old + delta / share.mean(1)
        tensors["log_scales"] = torch.cat([tensors["log_scales"][:, :3], new.log()], 1)
        if self.parameters.direct:
            change = ((old[:, None] * share + delta) / new[:, None]).logit() - share.logit()
            looks = tensors["looks"].clone()
            looks[..., 1:4] += change.nan_to_num(0.0, 0.0, 0.0)
            tensors["looks"] = looks
        return tensors

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        return super().state_dict() | {"level": self.level}

    def load_state_dict(self, state: dict) -> None:
        self._use_level(state["level"])
        self.start_anchors()  # sets the schedule of the level
        self._constrain()
        super().load_state_dict(state)


def smallest_log_scale(s_min: float) -> np.float32:
    """Return the smallest float32 log scale whose exponential is at least ``s_min``."""
    if not s_min:
        return np.float32(-np.inf)
    log_scale = np.float32(np.log(s_min))
    while np.exp(log_scale) < np.float32(s_min) or np.exp(np.float64(log_scale)) < s_min:
        log_scale = np.nextafter(log_scale, np.float32(np.inf))
    return log_scale
