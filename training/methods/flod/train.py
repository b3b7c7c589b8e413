"""FLoD (Seo et al. 2025): train levels one after another, from coarse to fine or from the finest.

The paper trains from coarse to fine, under a decreasing 3D scale constraint. Not in the paper: train the
finest level first, merge each coarser one from the next finer one, and refine it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf

import numpy as np
import torch
from scipy.spatial import KDTree

from ...errors import LodgsError
from ...lod.rule import Values
from ...lod.rules.bands import initial_gamma, min_scales
from ...optimize import method
from ...optimize.density_control import (
    constrained_log_scales,
    densify,
    prune,
    require_rows,
    reset_opacities,
)
from ...optimize.initialize import (
    from_points,
    from_splats,
    initial_points,
    neighbor_distances,
    sample_points,
    to_splats,
)
from ...optimize.merged_levels import MergedLevels
from ...optimize.merging import merge
from ...optimize.method import Drawing
from ...optimize.model import Model, rates_at, splat_rates
from ...optimize.refining import refining_rates
from ...optimize.schedules import (
    FAR_END,
    LevelStages,
    due,
    few_photos,
    random_reduction,
    shrink_at,
)
from ...optimize.training_data import TrainingView
from ...splats.gaussians import Splats
from ...splats.levels import Level
from . import BLENDED_LEVELS, FlodParameters, finish


class Method(method.Method[FlodParameters, Drawing]):
    """Training of FLoD levels.

    Attributes:
        s_min: minimum standard deviation of each level, coarse to fine, in scene units.
        stages: levels in the order of training, before the finishing steps.
        merged: merging and refinement of the coarser levels, if they are merged.
        points, colors: initial points of the scene, (P, 3) both.
        completed: completed levels for the end of the run, as tensors by name.
    """

    device_steps = inf

    def setup(self, base: Splats | None) -> None:
        p, data = self.parameters, self.data
        s_min_1 = p.s_min_1 or p.footprint * data.median_depth / data.focal
        self.s_min = min_scales(s_min_1, p.rho, p.levels)
        self._skipped_steps = self.sh_degree.completed = sum(p.steps[: p.first_level - 1])
        self.stages = LevelStages(p.stages)
        self.merged = MergedLevels(self.stages, data, p, self.seed, self.backend)
        limit = p.growth_limit(p.splat_limit)
        self.points, self.colors = initial_points(
            data.scene, data.train, p.points_between, limit, self.seed, data.region
        )
        self.completed: dict[int, Mapping[str, torch.Tensor]] = {}
        self.levels = p.levels
        if p.levels > 1:
            self.controls = {"gamma": initial_gamma(self.s_min[-2] * data.focal / data.median_depth)}
        if base is None:
            first = self.stages.level_at(0)
            limit = p.growth_limit(self.budget(first))
            self.model = self._new_model(
                self._from_points(first, *sample_points(self.points, self.colors, limit, self.seed))
            )
        else:
            self._store(p.first_level - 1, base)
            tensors = from_splats(base, p.sh_degree, self.device)
            self.model = self._new_model(self._next_level_tensors(tensors, 0.0, p.first_level))

    def level_at(self, step: int) -> int:
        return self.parameters.end if self.is_finishing(step) else self.stages.level_at(step)

    def ends_level(self, step: int) -> bool:
        return step + 1 in self.stages.ends or super().ends_level(step)

    def is_finishing(self, step: int) -> bool:
        """Return whether a step is a finishing step, which trains the finest levels blended."""
        return step >= self.stages.ends[-1]

    def levels_after(self, step: int) -> list[Level]:
        """Return the level that the step completes, and start the next one; all merged levels once their
        distances are known; at the end, the finished levels.
        """
        if self.is_finishing(step) and step + 1 == self.steps:
            return [*self._completed_levels(), *finish.split_levels(self.model, self.s_min)]
        if step + 1 not in self.stages.ends:
            return self._previews(step)
        p, number = self.parameters, self.level_at(step)
        levels = [Level(number, self.model.splats(self._constraint(number)), self._facts(number))]
        self._store(number, levels[0].splats)
        if step + 1 < self.stages.ends[-1]:
            self.start_level(self.level_at(step + 1))
            return levels
        if p.merges:
            if self.data.region is None:
                self.s_min = self.merged.measure_min_sizes(self.completed, self.controls["gamma"], p.rho)
            levels = self._completed_levels()
        if p.finish_steps and self.completed:
            self.start_finishing()
        return levels

    def _previews(self, step: int) -> list[Level]:
        """Return a coarser level merged from the current splats, at equal intervals before the finest is
        finished.
        """
        p = self.parameters
        if not p.merges or step >= self.stages.ends[0]:
            return []
        number, remainder = divmod((step + 1) * p.levels, self.stages.ends[0])
        if not 0 < number < p.levels or remainder >= p.levels:
            return []
        count = round(len(self.model) * p.share_below(p.levels - number))
        return [Level(number, merge(self.model.splats(), count), self._facts(number))]

    def meta(self) -> dict:
        footprint = self.s_min[0] * self.data.focal / self.data.median_depth
        return {"rho": self.parameters.rho, **super().meta(), "footprint_px": footprint}

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        p = self.parameters
        if self.merged.refines(step):
            return self.merged.shrink(step, p.first_resolution, p.full_resolution)
        if p.merges and step < self.stages.ends[-1]:
            progress = self.stages.share(step)
        else:
            progress = self._progress(step)
        factor = shrink_at(progress, p.first_resolution, p.full_resolution)
        local, end = self.stages.local_step(step), FAR_END * self.stages.steps_at(step)
        if factor > 1 or self.is_finishing(step) or not self._densify_until(step) <= local < end:
            return factor
        return random_reduction(self.seed, self._skipped_steps + step, p.far_share)

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        if self.is_finishing(step):
            values = self._finishing_values(step)
            return finish.weights(self.model, self.s_min, view.camera, values), 0.0
        if self.merged.refines(step):  # dropout would make few splats even fewer
            return None, 0.0
        dropout = self.dropout.weights(len(self.model), step, self._progress(step))
        return dropout, self._constraint(self.level_at(step))

    def trains_drawn_only(self, step: int) -> bool:
        return self.is_finishing(step)

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return not self.is_finishing(step) and self.stages.local_step(step) < self._densify_until(step)

    def set_learning_rates(self, step: int) -> None:
        p = self.parameters
        if self.is_finishing(step):
            share = (step - self.stages.ends[-1]) / p.finish_steps
            self.model.lr = refining_rates(p, self.data.extent, share)
            return
        if self.merged.refines(step):
            self.model.lr = self.merged.learning_rates(step)
            return
        steps = self.stages.steps_at(step)
        self.model.lr = rates_at(p, self.data.extent, self.stages.local_step(step), steps)

    def control_density(self, step: int) -> None:
        if self.is_finishing(step):
            self._raise_to_min_sizes()
            return
        completed, end = self.stages.local_step(step) + 1, self._densify_until(step)
        if completed <= end:
            self._densify_and_prune(step)
        if completed - 1 < end <= completed:
            self._add_margins(self.level_at(step))

    def _densify_and_prune(self, step: int) -> None:
        """Add, remove and reset splats if due, while the level in training has density control."""
        p, model, level = self.parameters, self.model, self.level_at(step)
        local = self.stages.local_step(step) + 1
        old_count, s_min = len(model), self._constraint(level)
        if due(p.densify_interval[level - 1], local) and local >= p.densify_from:
            densify(
                model,
                model.mean_gradient(),
                threshold=p.grad_threshold * p.threshold_factor(self.data.threshold_scale),
                clone_below=None if p.long_axis else p.clone_extent * self.data.extent,
                max_splats=p.growth_limit(self.budget(level)),
                rng=np.random.default_rng([self.seed, step, 1]),
                min_scale=s_min,
            )
            model.reset_stats()
        if due(p.prune_interval, local) and local >= p.densify_from:
            prune(model, p.min_opacity, p.opacity_decay * few_photos(len(self.data.train)))
            require_rows(model, step, "min_opacity")
        if due(p.overlap_interval, local) and level < p.levels:
            model.keep(well_separated(model.read("means").cpu(), s_min / 2))
        if due(p.opacity_reset_interval, local) and local < self._densify_until(step):
            reset_opacities(model)
        if old_count and not len(model):
            raise LodgsError(
                f"Training removed all splats of level {level} at step {step + 1}.",
                "Lower 'footprint' (or 's_min_1'), so that coarse levels keep more splats.",
            )

    def _add_margins(self, level: int) -> None:
        """Add margins to a level, whose number of splats then remains almost the same."""
        s_min = self._constraint(level)
        log_scales = (self.model["log_scales"].detach().exp() + s_min).log()
        gaussians = replace(self.model.gaussians, log_scales=log_scales)
        rows = vars(self.margins.extend(gaussians, self.parameters.margin_room(self.budget(level))))
        log_scales = constrained_log_scales(rows["log_scales"].exp(), s_min)
        self.model.append({**rows, "log_scales": log_scales})
        self.model.sort()

    def _finishing_values(self, step: int) -> Values:
        """Return the rule's controls for a finishing step."""
        rng = np.random.default_rng([self.seed, step, 3])
        return finish.random_values(rng, self.controls["gamma"], self.model, self.parameters.finish_alone)

    def _progress(self, step: int) -> float:
        """Return the fraction of a run of all levels that is complete before a step."""
        return (self._skipped_steps + step) / self.parameters.all_steps

    def _densify_until(self, step: int) -> float:
        """Return the number of steps of the current level with density control."""
        if self.merged.refines(step):
            return 0.0
        return self.parameters.densify_until[self.stages.level_at(step) - 1] * self.stages.steps_at(step)

    def prune_unsupported(self, step: int, turn: int) -> None:
        super().prune_unsupported(step, turn)
        if self.is_finishing(step):  # minimum sizes take precedence
            self._raise_to_min_sizes()

    def _raise_to_min_sizes(self) -> None:
        if not self.parameters.merges:
            finish.raise_to_min_sizes(self.model, self.s_min)

    # -- levels ----------------------------------------------------------------------------------------

    def budget(self, level: int) -> int:
        """Return the maximum splat count of a level, at least 1."""
        p = self.parameters
        return max(int(p.splat_limit * p.budget_ratio ** (p.levels - level)), 1)

    def _constraint(self, level: int) -> float:
        """Return the minimum standard deviation that training imposes on a level: none on merged ones."""
        return 0.0 if self.parameters.merges else self.s_min[level - 1]

    def _facts(self, level: int) -> dict[str, float]:
        return {"s_min": self.s_min[level - 1]}

    def start_level(self, level: int) -> None:
        """Start the next level from the current one, with new Adam state.

        A merged level has fewer splats. Otherwise scales stay the same, with a smaller constraint (Eq. 5).
        """
        p = self.parameters
        if p.merges:
            finest_count = len(self.completed[p.levels]["means"])
            self.model = self.merged.start(level, self.model.splats(), finest_count)
            return
        tensors = {name: tensor.detach() for name, tensor in self.model.adam.tensors.items()}
        self.model = self._new_model(self._next_level_tensors(tensors, self.s_min[level - 2], level))

    def _next_level_tensors(
        self, tensors: dict[str, torch.Tensor], old_min: float, level: int
    ) -> dict[str, torch.Tensor]:
        """Return the initial tensors of a level: those of the level before, with its constraint added to
        their scales, and points.
        """
        new_min = self.s_min[level - 1]
        tensors = {
            **tensors,
            "log_scales": constrained_log_scales(tensors["log_scales"].exp() + old_min, new_min),
        }
        if self.parameters.rejoin_points:
            # overlap pruning now allows half of a smaller size
            distances, _ = KDTree(tensors["means"].cpu().numpy()).query(self.points)
            free = np.flatnonzero(distances >= new_min / 2)
            room = max(self.parameters.growth_limit(self.budget(level)) - len(tensors["means"]), 0)
            if len(free) > room:
                rng = np.random.default_rng([self.seed, level, 2])
                free = np.sort(rng.choice(free, room, replace=False))
            points = self._from_points(level, self.points, self.colors)
            tensors = {name: torch.cat([tensor, points[name][free]]) for name, tensor in tensors.items()}
        return tensors

    def _store(self, level: int, splats: Splats) -> None:
        p = self.parameters
        if p.merges or (p.finish_steps and level > p.levels - BLENDED_LEVELS):
            self.completed[level] = from_splats(splats, p.sh_degree, self.device)

    def _completed_levels(self) -> list[Level]:
        """Return the completed levels that finishing steps do not train, coarse to fine."""
        return [
            Level(number, to_splats(tensors), self._facts(number))
            for number, tensors in sorted(self.completed.items())
        ]

    def start_finishing(self) -> None:
        """Combine the completed levels into one model for the finishing steps; restart those of fine
        detail.
        """
        p, data = self.parameters, self.data
        in_use = sorted(self.completed)[-BLENDED_LEVELS:]
        levels = {number: self.completed.pop(number) for number in in_use}
        max_size = finish.FINE_PIXELS * data.median_depth / data.focal
        fine = [number for number in levels if 0 < self.s_min[number - 1] <= max_size]
        if fine and not p.merges:
            gamma = self.controls["gamma"]
            limits = {number: self.budget(number) for number in fine}
            levels |= finish.restart_levels(levels, limits, self.s_min, data, p, p.drawn, gamma, self.backend)
        self.model = finish.join_levels(levels, refining_rates(p, data.extent, 0.0))

    def _from_points(self, level: int, points: np.ndarray, colors: np.ndarray) -> dict[str, torch.Tensor]:
        s_min = self.s_min[level - 1]
        return from_points(points, colors, self.parameters.sh_degree, self.device, s_min)

    def _new_model(self, tensors: dict[str, torch.Tensor]) -> Model:
        return Model(tensors, splat_rates(self.parameters, self.data.extent))

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        s_min = torch.tensor(self.s_min, dtype=torch.float64)
        return {**super().state_dict(), "kept": self.completed, "s_min": s_min}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.completed = state["kept"]
        self.s_min = state["s_min"].tolist()


def well_separated(means: torch.Tensor, distance: float) -> torch.Tensor:
    """Return which splats overlap pruning keeps (FLoD, Eq. 6): mean distance to 3 nearest neighbours of at
    least ``distance``.

    As in the published code, all splats are tested at once, so that both splats of a close pair are
    removed.
    """
    if len(means) <= 3:
        return torch.ones(len(means), dtype=torch.bool)
    return torch.from_numpy(neighbor_distances(means.numpy()).mean(1) >= distance)
