"""Octree-GS (Ren et al. 2024) with explicit anchors: octree levels that add up and are selected by distance.

An anchor is a single Gaussian with its own parameters and without networks. It belongs to a level, and
starts in a voxel of that level without other anchors. Views select anchors by ``lod.rules.octree``,
rounded in training.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

import numpy as np
import torch

from ...lod.rules.octree import BIAS
from ...rasterize import contributions
from ...rasterize.rendering import ALPHA_MIN
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from ...splats.levels import Level
from ..density_control import require_rows, sample_gaussians
from ..initialize import from_points
from ..method import Drawing, Method
from ..model import Model, splat_rates
from ..schedules import log_linear
from ..training_data import TrainingView
from . import growing
from .parameters import OctreeParameters

MARGIN = "margin"
"""Column that marks margin splats."""


class ExplicitAnchors(Method[OctreeParameters, Drawing]):
    """Training of Octree-GS, without merged levels.

    Attributes:
        schedule: schedule of levels, with the octree.
    """

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        self.schedule, points, colors, level = growing.create_anchors(
            self.data, p, self.seed, p.growth_limit(p.splat_limit)
        )
        self.levels = self.schedule.tree.levels
        self.facts = self.schedule.tree.facts()
        tensors = from_points(points, colors, p.sh_degree, self.device)
        tensors["log_scales"] = growing.log_spacing(points, level, columns=3).to(self.device)
        zeros = torch.zeros(len(points), device=self.device)
        levels = torch.from_numpy(level).float().to(self.device)
        columns = {"level": levels, "bias": zeros, MARGIN: torch.zeros_like(levels, dtype=torch.bool)}
        self.device_steps = 0 if p.volume_weight else inf
        self._rates = splat_rates(p, self.data.extent)
        self.model = Model(tensors, self._rates, columns, stats={"opacity_sum": zeros.clone()})

    def level_at(self, step: int) -> int:
        return self.schedule.level_at(step)

    def ends_level(self, step: int) -> bool:
        return self.schedule.ends_level(step)

    def levels_after(self, step: int) -> list[Level]:
        """Return all levels when the last one has joined and at the end."""
        if not self.schedule.completes_levels(step):
            return []
        splats, level = self.model.splats(), self.model.columns["level"].cpu().numpy()
        splats.extras |= {"lod_level": level.astype(np.uint8), BIAS: self.model.columns["bias"].cpu().numpy()}
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def meta(self) -> dict:
        tree = self.schedule.tree
        return {"voxel": tree.voxel, **super().meta()}

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        return self.schedule.shrink(step)

    def render_weights(self, view: TrainingView, step: int) -> tuple[torch.Tensor | None, float]:
        weights = self.schedule.weights(view.camera, self.model, step, full=view.shrink == 1)
        dropout = self.dropout.weights(len(weights), step, step / self.parameters.steps)
        return (weights if dropout is None else weights * dropout), 0.0

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return self.schedule.collects_stats(view, step)

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """Return the loss with volume regularization (Octree-GS, Sec. 7.1)."""
        loss = super().loss(drawings, view, step)
        if not self.parameters.volume_weight:
            return loss
        drawn = drawings[0].rendering.radii > 0
        scales = self.model["log_scales"][drawn].exp() / self.data.median_depth
        return loss + self.parameters.volume_weight * growing.mean_volume(scales)

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
        if self.schedule.is_growing(step) and not self.schedule.is_growing(step + 1):
            self._add_margins()

    def _add_margins(self) -> None:
        """Add margins to the coarsest level, for all distances."""
        room = self.parameters.margin_room(self.parameters.splat_limit)
        rows = vars(self.margins.extend(self.model.gaussians, room))
        ones = torch.ones_like(rows["opacity_logits"])
        self.model.append({**rows, "level": ones, MARGIN: ones.bool()})

    # -- anchors ---------------------------------------------------------------------------------------

    @torch.no_grad()
    def grow(self, step: int) -> None:
        """Add anchors in free voxels with large gradients (Octree-GS, Sec. 4.2), and remove faint ones.

        A splat proposes smaller, faint copies of itself at positions sampled from it. A splat is faint if
        its mean opacity over the views that drew it is too low, or too low to be visible.
        """
        p, model = self.parameters, self.model
        source, _, level = growing.select_growth(self.schedule, model, step)
        source, level = (column.repeat_interleave(p.candidates) for column in (source, level))
        rows = model.read_rows(source)
        rng = np.random.default_rng([self.seed, step, 1])
        rows["means"] += sample_gaussians(rows["quats"], rows["log_scales"].exp(), rng)
        rows["log_scales"] -= float(np.log(1.6))
        rows["opacity_logits"].clamp_max_(growing.MAX_NEW_LOGIT)
        rows |= {"level": level, "bias": model.columns["bias"][source]}
        rows = growing.limit_growth(self.schedule, model, rows, step, p.growth_limit(p.splat_limit))

        opacity = model.read("opacity_logits").sigmoid()
        faint = model.read("opacity_sum") < p.min_opacity * model.read("seen")
        model.keep(~(faint | (opacity < min(p.min_opacity, ALPHA_MIN))))
        model.append(rows)
        model.reset_stats()
        require_rows(model, step, "min_opacity")

    def prune_unseen(self, step: int) -> None:
        """Remove splats of low blending weight in all views, near or far (RadSplat)."""
        low_weight = growing.find_unseen(self.schedule, self.model, step, self._largest_weights)
        self.model.keep(~low_weight | self.model.columns[MARGIN])
        require_rows(self.model, step, "least_weight")

    def _largest_weights(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        return contributions(
            self.model.gaussians, [camera], weights=weights, near=self.data.near,
            antialias=self.parameters.antialias, backend=self.backend,
        ).largest  # fmt: skip

    def reassign_levels(self, step: int) -> None:
        """Move splats that are too wide or too narrow for their level to a matching one."""
        columns, newest = self.model.columns, self.schedule.level_at(step)
        means, log_scales = self.model.read("means"), self.model.read("log_scales")
        columns["level"] = growing.matching_levels(self.schedule, columns["level"], means, log_scales, newest)
