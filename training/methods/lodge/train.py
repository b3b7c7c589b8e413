"""LODGE (2025): levels from the finest to the coarsest, each a copy of the finest for a distance.

A level is smoothed as its distance allows, pruned of what hardly shows, and tuned beside the finer ones,
which stay as they are (Sec. 3, A.2). The finest is a base, or 3DGS in the first steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ...errors import LodgsError
from ...rasterize import Gaussians
from ...splats.bundle import Level
from ...splats.gaussians import Splats
from ..data import TrainingView
from ..density import require_rows
from ..method import Drawing
from ..model import NAMES
from ..start import from_splats
from ..threedgs import train as threedgs_train
from . import ROUNDS, LodgeParameters
from .composite import composite, filtered, importance
from .thresholds import Thresholds


class Method(threedgs_train.Method):
    """One run of LODGE.

    Attributes:
        finest_steps: so many steps come before the coarser levels; none with a base.
        d_l: the distance from which on each level is shown, in scene units, by number; those known so far.
        finished: the levels that no step changes any more, as they are drawn, by number.
        costs: what finding the distances has told, see ``Thresholds``.
    """

    parameters: LodgeParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        if base is not None and p.levels == 1:
            raise LodgsError("A base is the one level itself: there is nothing to train.", "Give levels = 2.")
        self.finest_steps = 0 if base is not None else p.steps
        if base is None:
            super().setup(None)
        else:
            tensors = from_splats(base, p.sh_degree, self.device)
            self.model = self.new_model(tensors)
            self._densify_until = 0
        self.d_l = {p.levels: 0.0}
        self.finished: dict[int, Gaussians] = {}
        self.costs: list[dict] = []

    @property
    def steps(self) -> int:
        return self.finest_steps + self.parameters.level_steps * (self.levels - 1)

    @property
    def levels(self) -> int:
        return self.parameters.levels

    def level_at(self, step: int) -> int:
        if step < self.finest_steps:
            return self.levels
        return (
            self.levels - 1 - min((step - self.finest_steps) // self.parameters.level_steps, self.levels - 2)
        )

    def ends_level(self, step: int) -> bool:
        done = step + 1
        return done == self.finest_steps or (done > self.finest_steps and self._local(done) == 0)

    def levels_after(self, step: int) -> list[Level]:
        """The finest as soon as it is there, each coarser one when it is tuned."""
        found = []
        if step + 1 == max(self.finest_steps, 1):
            found.append(self._level(self.levels))
        if step >= self.finest_steps and self._local(step + 1) == 0:
            found.insert(0, self._level(self.level_at(step)))
        return found

    def meta(self) -> dict:
        return {**super().meta(), "filter_variance": self.parameters.filter_variance, "costs": self.costs}

    # -- a step ----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        if step < self.finest_steps:
            return super().shrink(step)
        return self._farther(self.level_at(step)) if self._alone(step) else 1

    def choose_view(self, step: int) -> TrainingView:
        if step >= self.finest_steps and self._local(step) % self.parameters.tune_steps == 0:
            self.begin_round(step)
        return super().choose_view(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        if step < self.finest_steps:
            return super().draw(view, step)
        number = self.level_at(step)
        if self._alone(step):
            gaussians, weights = self.smoothed(number), None
        else:
            rng, spread = np.random.default_rng([self.seed, step, 8]), self.parameters.tune_range
            scale = 1 / rng.uniform(1 - spread, 1 + spread)
            gaussians, weights = composite(self._levels_to(number), self.d_l, view.camera, scale)
        return [Drawing(self.rasterize_model(view.camera, step, weights, gaussians=gaussians))]

    def background(self, step: int) -> tuple[float, float, float]:
        """Black for the coarser levels, which the finest covers for: what is nothing may be black."""
        return super().background(step) if step < self.finest_steps else (0.0, 0.0, 0.0)

    def sh_degree(self, step: int) -> int:
        return super().sh_degree(step) if step < self.finest_steps else self.parameters.sh_degree

    def accumulate_stats(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> None:
        if step < self.finest_steps:
            super().accumulate_stats(drawings, view, step)

    def set_learning_rates(self, step: int) -> None:
        if step < self.finest_steps:
            super().set_learning_rates(step)
        else:  # a finished model's (the paper says nothing)
            self.model.adam.lr["means"] = self.parameters.lr_means_final * self.data.extent

    def keep_supported(self, step: int) -> None:
        if step < self.finest_steps:
            super().keep_supported(step)

    def control_density(self, step: int) -> None:
        if step < self.finest_steps:
            super().control_density(step)

    # -- levels ----------------------------------------------------------------------------------------

    def begin_round(self, step: int) -> None:
        """Before a step: what hardly shows leaves the level; a new level begins as a copy of the finest."""
        number, local = self.level_at(step), self._local(step)
        if local == 0:
            self._begin_level(number)
        threshold = self.parameters.prune_weight * ROUNDS[local // self.parameters.tune_steps]
        self.model.keep(self.importance(number) >= threshold)
        require_rows(self.model, step, "prune_weight")

    def _begin_level(self, number: int) -> None:
        p, data = self.parameters, self.data
        above = number + 1
        self.finished[above] = self.smoothed(above).detach()
        finest = self.finished[self.levels]
        given = p.distances[number - 1] * data.median_depth
        if given:
            self.d_l[number] = given
        else:
            thresholds = Thresholds(
                data.train, data.near, self.backend, p.prune_weight, self._std, p.antialias
            )
            self.d_l[number], costs = thresholds.next(self.finished, self.d_l)
            self.costs.append({"level": number, **costs})
        tensors = {name: getattr(finest, name).clone() for name in NAMES}
        self.model = self.new_model(tensors)

    def smoothed(self, number: int) -> Gaussians:
        """The model as a level: with the filter of its distance (Eq. 3), which no step can undo."""
        gaussians, d_l = self.model.gaussians, self.d_l[number]
        return filtered(gaussians, self._std(d_l)) if d_l else gaussians

    def _levels_to(self, number: int) -> dict[int, Gaussians]:
        """The finished levels and the one in training, finest first."""
        return {**self.finished, number: self.smoothed(number)}

    @torch.no_grad()
    def importance(self, number: int) -> torch.Tensor:
        """The largest share (N,) of a pixel that each splat of the level in training has.

        In the training views, beside the finer levels; and alone in views as far away as its distance, which
        see what continues the photographs, too.
        """
        data, count, backend = self.data, len(self.model), self.backend
        levels, alone, farther = self._levels_to(number), self.smoothed(number), self._farther(number)
        beside = ((camera, *composite(levels, self.d_l, camera)) for camera in data.train)
        antialias = self.parameters.antialias
        found = importance(beside, count, data.near, backend, antialias)
        if not self.parameters.tune_alone:
            return found
        margin = self.parameters.margin
        away = ((camera.widened(margin).scaled(1 / farther), alone, None) for camera in data.train)
        return torch.maximum(found, importance(away, count, data.near, backend, antialias))

    def _level(self, number: int) -> Level:
        g = self.finished[number] if number in self.finished else self.smoothed(number).detach()
        splats = Splats(*(tensor.cpu().numpy().copy() for tensor in vars(g).values()))
        return Level(number, splats, {"d_l": self.d_l[number]})

    def _local(self, step: int) -> int:
        """Steps that the level in training has seen before a step."""
        return (step - self.finest_steps) % self.parameters.level_steps

    def _std(self, distance: float) -> float:
        """The filter's standard deviation for a distance, in scene units (Eq. 3, as Mip-Splatting has it)."""
        return self.parameters.filter_variance**0.5 * distance / self.data.focal

    def _farther(self, number: int) -> float:
        """How many times farther away than the median depth a level begins; at least 1."""
        return max(self.d_l.get(number, 0.0) / self.data.median_depth, 1.0)

    def _alone(self, step: int) -> bool:
        draw = np.random.default_rng([self.seed, step, 9]).random()
        return draw < self.parameters.tune_alone

    # -- what lasts ------------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        finished = {number: dict(vars(gaussians)) for number, gaussians in self.finished.items()}
        return {**super().state_dict(), "d_l": self.d_l, "finished": finished, "costs": self.costs}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.d_l, self.costs = state["d_l"], state["costs"]
        self.finished = {number: Gaussians(**tensors) for number, tensors in state["finished"].items()}
