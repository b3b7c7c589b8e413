"""3D Gaussian splatting (Kerbl et al. 2023): a single level, and the base class of methods that extend it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf

import numpy as np
import torch

from ..rasterize import contributions
from ..splats.gaussians import Splats
from ..splats.levels import Level
from .density_control import (
    OVERSIZED_EXTENT,
    densify,
    peak_scores,
    prune,
    prune_oversized,
    require_rows,
    reset_opacities,
)
from .initialize import from_points, from_splats, initial_points
from .method import Drawing, Method
from .model import Model, rates_at, splat_rates
from .parameters import SplatParameters
from .schedules import FAR_END, due, few_photos, random_reduction, shrink_at
from .training_data import TrainingView

PRUNE_AT = (8 / 30, 16 / 30, 24 / 30)
"""Fractions of the steps after which splats of low weight are pruned, if enabled."""


class SplatMethod(Method[SplatParameters, Drawing]):
    """Training of a 3DGS model."""

    device_steps = inf

    def setup(self, base: Splats | None) -> None:
        p, data = self.parameters, self.data
        if base is not None:
            self.parameters = p = replace(p, opacity_decay=0.0)  # parts that no photo sees would disappear
            self.sh_degree.full_from = 0
            tensors = from_splats(base, p.sh_degree, self.device)
        else:
            limit = p.growth_limit(p.splat_limit)
            points, colors = initial_points(
                data.scene, data.train, p.points_between, limit, self.seed, data.region
            )
            tensors = from_points(points, colors, p.sh_degree, self.device)
        self.model = self.new_model(tensors)
        self._densify_until = p.densify_until * self.scheduled_steps

    @property
    def scheduled_steps(self) -> int:
        """Number of steps over which learning rates fall and image resolution grows."""
        return self.parameters.steps

    def new_model(self, tensors: Mapping[str, torch.Tensor]) -> Model:
        """Create a model with the statistics that the densification criterion needs."""
        p = self.parameters
        peaks = p.densify_by == "max" or p.prune_oversized
        return Model(tensors, splat_rates(p, self.data.extent), peaks=peaks)

    def levels_after(self, step: int) -> list[Level]:
        """Return the single level after the last step."""
        return [Level(1, self.model.splats())] if step + 1 == self.steps else []

    def shrink(self, step: int) -> float:
        p = self.parameters
        factor = shrink_at(step / self.scheduled_steps, p.first_resolution, p.full_resolution)
        may_be_far = self._densify_until <= step < FAR_END * self.scheduled_steps
        return random_reduction(self.seed, step, p.far_share) if may_be_far and factor == 1 else factor

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        return self.dropout.weights(len(self.model), step, step / self.scheduled_steps), 0.0

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return step < self._densify_until

    def set_learning_rates(self, step: int) -> None:
        rates = rates_at(self.parameters, self.data.extent, step, self.scheduled_steps)
        self.model.lr.update(rates)  # methods may train further tensors

    def control_density(self, step: int) -> None:
        p, model, completed = self.parameters, self.model, step + 1
        if p.least_weight and completed in (round(share * p.steps) for share in PRUNE_AT):
            self.prune_unimportant(step)
        if completed <= self._densify_until:
            if due(p.densify_interval, completed) and completed >= p.densify_from:
                self._densify(step)
            if due(p.prune_interval, completed) and completed >= p.densify_from:
                prune(model, p.min_opacity, p.opacity_decay * few_photos(len(self.data.train)))
                require_rows(model, step, "min_opacity")
            if due(p.opacity_reset_interval, completed) and completed < self._densify_until:
                reset_opacities(model)  # not at the end: nothing would remove splats that stay faint
        self.add_margins(step)
        if self._ends_densification(step):  # the number of splats now remains almost the same
            self.model.sort()

    def _ends_densification(self, step: int) -> bool:
        return step < self._densify_until <= step + 1

    def _densify(self, step: int) -> None:
        """Add splats by the criterion and, if enabled, remove oversized ones."""
        p, model = self.parameters, self.model
        peaks = p.densify_by == "max"
        threshold = p.max_threshold if peaks else p.grad_threshold
        densify(
            model,
            peak_scores(model) if peaks else model.mean_gradient(),
            threshold=threshold * p.threshold_factor(self.data.threshold_scale),
            clone_below=None if p.long_axis else p.clone_extent * self.data.extent,
            max_splats=p.growth_limit(p.splat_limit),
            rng=np.random.default_rng([self.seed, step, 1]),
        )
        if p.prune_oversized and 0 < p.opacity_reset_interval < step + 1:
            prune_oversized(model, OVERSIZED_EXTENT * self.data.extent)
            require_rows(model, step, "prune_oversized")
        model.reset_stats()

    @torch.no_grad()
    def prune_unimportant(self, step: int) -> None:
        """Remove splats of low weight in all training views, which include the margins (RadSplat)."""
        p, data = self.parameters, self.data
        contribution = contributions(
            self.model.gaussians,
            (camera.widened(p.margin) for camera in data.train),
            near=data.near,
            antialias=p.antialias,
            backend=self.backend,
        )
        self.model.keep(contribution.largest >= p.least_weight)
        require_rows(self.model, step, "least_weight")

    def add_margins(self, step: int) -> None:
        """Add margins if due: when densification ends."""
        if self._ends_densification(step):
            self.model.append(self.margin_rows())

    def margin_rows(self) -> dict[str, torch.Tensor]:
        """Create margin splats within the budget, as rows of the model."""
        p = self.parameters
        return vars(self.margins.extend(self.model.gaussians, p.margin_room(p.splat_limit)))
