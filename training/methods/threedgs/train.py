"""3D Gaussian splatting (Kerbl et al. 2023), one level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...splats.bundle import Level
from ...splats.gaussians import Splats
from .. import method
from ..data import TrainingView
from ..density import densify, prune, require_rows, reset_opacities
from ..method import Drawing
from ..model import Model, splat_rates
from ..schedules import due, log_linear, shrink_at
from ..start import distinct, from_points, sampled
from . import ThreedgsParameters


class Method(method.Method[ThreedgsParameters, Drawing]):
    """One run of 3DGS."""

    def setup(self, base: Splats | None) -> None:
        p, scene = self.parameters, self.data.scene
        points, colors = distinct(scene.points, scene.point_colors)
        points, colors = sampled(points, colors, self.growth_limit(0), self.seed)
        tensors = from_points(points, colors, p.sh_degree, self.device)
        self.model = Model(tensors, splat_rates(p, self.data.extent))
        self._densify_until = p.densify_until * p.steps

    def levels_after(self, step: int) -> list[Level]:
        """The one level, at the end."""
        return [Level(1, self.model.splats())] if step + 1 == self.steps else []

    def shrink(self, step: int) -> float:
        p = self.parameters
        return shrink_at(step / p.steps, p.first_resolution, p.full_resolution)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        return [Drawing(self.rasterize_model(view.camera, step))]

    def accumulate_stats(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> None:
        if step < self._densify_until:
            self.model.accumulate_stats(drawings[0].rendering, view.shrink)

    def set_learning_rates(self, step: int) -> None:
        p = self.parameters
        rate = log_linear(p.lr_means, p.lr_means_final, step / (p.lr_means_steps or p.steps))
        self.model.adam.lr["means"] = rate * self.data.extent

    def control_density(self, step: int) -> None:
        p, model, done = self.parameters, self.model, step + 1
        if done > self._densify_until:
            return
        if due(p.densify_interval, done):
            densify(
                model,
                model.mean_gradient(),
                threshold=p.grad_threshold * self.data.threshold_scale,
                clone_below=None if p.long_axis else p.clone_extent * self.data.extent,
                max_splats=self.growth_limit(step),
                rng=np.random.default_rng([self.seed, step, 1]),
            )
            model.reset_stats()
        if due(p.prune_interval, done):
            prune(model, p.min_opacity)
            require_rows(model, step, "min_opacity")
        if due(p.opacity_reset_interval, done):
            reset_opacities(model)

    def continues_margins(self, step: int) -> bool:
        return step < self._densify_until <= step + 1
