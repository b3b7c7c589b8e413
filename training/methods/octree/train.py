"""Octree-GS (Ren et al. 2024) with explicit anchors: levels of an octree that add up, chosen by distance.

An anchor is one Gaussian with parameters of its own and no network. It belongs to a level, and began in a
voxel of that level in which no other anchor was. What a view draws follows ``lod.rules.octree``,
rounded while training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ...lod.rules.octree import BIAS
from ...optimize import method
from ...optimize.density_control import require_rows, sample_gaussians
from ...optimize.initialize import from_points
from ...optimize.method import Drawing
from ...optimize.model import Model, splat_rates
from ...optimize.schedules import log_linear
from ...optimize.training_data import TrainingView
from ...rasterize import contributions
from ...rasterize.rendering import ALPHA_MIN
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from ...splats.levels import Level
from . import OctreeParameters, growing

MARGIN = "margin"
"""Column: whether a splat continues a photograph beyond its edge."""


class Method(method.Method[OctreeParameters, Drawing]):
    """One run of Octree-GS.

    Attributes:
        schedule: which levels a step draws, with the octree.
    """

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        self.schedule, points, colors, level = growing.plant(self.data, p, self.seed, self.growth_limit(0))
        tensors = from_points(points, colors, p.sh_degree, self.device)
        tensors["log_scales"] = growing.log_spacing(points, level, columns=3).to(self.device)
        zeros = torch.zeros(len(points), device=self.device)
        levels = torch.from_numpy(level).float().to(self.device)
        columns = {"level": levels, "bias": zeros, MARGIN: torch.zeros_like(levels, dtype=torch.bool)}
        self._rates = splat_rates(p, self.data.extent)
        self.model = Model(tensors, self._rates, columns, stats={"opacity_sum": zeros.clone()})

    @property
    def levels(self) -> int:
        return self.schedule.tree.levels

    def level_at(self, step: int) -> int:
        return self.schedule.level_at(step)

    def levels_after(self, step: int) -> list[Level]:
        """All levels, when the last one has joined and at the end."""
        if not self.schedule.hands_over(step):
            return []
        splats, level = self.model.splats(), self.model.columns["level"].cpu().numpy()
        splats.extras |= {"lod_level": level.astype(np.uint8), BIAS: self.model.columns["bias"].cpu().numpy()}
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def facts(self) -> dict[str, float]:
        return self.schedule.tree.facts()

    def meta(self) -> dict:
        tree = self.schedule.tree
        return {"voxel": tree.voxel, **super().meta()}

    # -- a step ----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        return self.schedule.shrink(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        return [Drawing(self.rasterize_model(view.camera, step, *self.render_weights(view, step)))]

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        weights = self.schedule.weights(view.camera, self.model, step, full=view.shrink == 1)
        left = self.dropout_weights(step, step / self.parameters.steps)
        return (weights if left is None else weights * left), 0.0

    def allows_device_step(self, step: int) -> bool:
        return not self.parameters.volume_weight

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return self.schedule.collects_stats(view, step)

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """With the volume of what is drawn (Octree-GS, Sec. 7.1)."""
        loss = super().loss(drawings, view, step)
        if not self.parameters.volume_weight:
            return loss
        drawn = drawings[0].rendering.radii > 0
        scales = self.model["log_scales"][drawn].exp() / self.data.median_depth
        return loss + self.parameters.volume_weight * scales.prod(1).mean()

    def accumulate_stats(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> None:
        super().accumulate_stats(drawings, view, step)
        if self.collects_stats(view, step):
            opacity = self.model["opacity_logits"].detach().sigmoid()
            drawn = drawings[0].rendering.radii > 0
            self.model.stats["opacity_sum"] += torch.where(drawn, opacity, 0)

    def set_learning_rates(self, step: int) -> None:
        p, lr = self.parameters, self.schedule.learning_rates(self._rates, step)
        lr["means"] = log_linear(p.lr_means, p.lr_means_final, step / p.steps) * self.data.extent
        self.model.lr = lr

    def control_density(self, step: int) -> None:
        if self.schedule.grows_after(step):
            self.grow(step)
        if self.schedule.prunes_unseen_after(step):
            self.prune_unseen(step)
        if self.schedule.reassigns_after(step):
            self.reassign_levels(step)

    def adds_margins(self, step: int) -> bool:
        return self.schedule.growing(step) and not self.schedule.growing(step + 1)

    def append_margins(self, rows: Mapping[str, torch.Tensor], step: int) -> None:
        """They are of the coarsest level, for every distance, whatever photographs show of them."""
        ones = torch.ones_like(rows["opacity_logits"])
        super().append_margins({**rows, "level": ones, MARGIN: ones.bool()}, step)

    # -- anchors ---------------------------------------------------------------------------------------

    @torch.no_grad()
    def grow(self, step: int) -> None:
        """New anchors in free voxels where gradients are large (Octree-GS, Sec. 4.2); faint ones go.

        A splat proposes its likeness, smaller and faint, at places drawn from itself. Faint are those whose
        opacity was too low on average in the views that drew them, or is for any.
        """
        p, model = self.parameters, self.model
        source, _, level = growing.steep(self.schedule, model, step)
        source, level = (column.repeat_interleave(p.candidates) for column in (source, level))
        rows = model.read_rows(source)
        rng = np.random.default_rng([self.seed, step, 1])
        rows["means"] += sample_gaussians(rows["quats"], rows["log_scales"].exp(), rng)
        rows["log_scales"] -= float(np.log(1.6))
        rows["opacity_logits"].clamp_max_(growing.FAINT)
        rows |= {"level": level, "bias": model.columns["bias"][source]}
        rows = growing.with_room(self.schedule, model, rows, step, self.growth_limit(step))

        opacity = model.read("opacity_logits").sigmoid()
        faint = model.read("opacity_sum") < p.min_opacity * model.read("seen")
        model.keep(~(faint | (opacity < min(p.min_opacity, ALPHA_MIN))))
        model.append(rows)
        model.reset_stats()
        require_rows(model, step, "min_opacity")

    def prune_unseen(self, step: int) -> None:
        """Splats go of which no view, near or far, sees much, by their largest blending weight (RadSplat)."""
        unseen = growing.unseen(self.schedule, self.model, step, self._largest_weights)
        self.model.keep(~unseen | self.model.columns[MARGIN])
        require_rows(self.model, step, "least_weight")

    def _largest_weights(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        return contributions(
            self.model.gaussians, [camera], weights=weights, near=self.data.near,
            antialias=self.parameters.antialias, backend=self.backend,
        ).largest  # fmt: skip

    def reassign_levels(self, step: int) -> None:
        """Splats that have become too wide or too narrow for their level move to one that they fit."""
        columns, newest = self.model.columns, self.level_at(step)
        means, log_scales = self.model.read("means"), self.model.read("log_scales")
        columns["level"] = growing.fitting_levels(self.schedule, columns["level"], means, log_scales, newest)
