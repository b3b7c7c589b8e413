"""FLoD (Seo et al. 2025): levels trained one after another under a shrinking 3D scale constraint.

With one level there is no constraint, and this is plain 3DGS (Kerbl et al. 2023).
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import accumulate

import numpy as np
import torch
from scipy.spatial import KDTree

from ..errors import LodgsError
from ..lod.rules import flod_s_min
from ..rasterize import Target, device_of, photometric_loss, rasterize
from ..splats.bundle import Level
from . import Method as Interface
from .data import TrainingData
from .model import (
    NAMES,
    Model,
    constrained_log,
    densify,
    distinct,
    from_points,
    means_rate,
    neighbour_distances,
    splat_model,
)
from .parameters import FlodParameters

REFERENCE_PIXELS = 1e6
"""Image size for which 3DGS's gradient threshold was chosen (about one megapixel)."""


class Method(Interface):
    """One run of FLoD; see ``methods.Method`` for what it does for the loop."""

    cumulative = False

    def __init__(self, data: TrainingData, parameters: FlodParameters, seed: int, backend: str) -> None:
        self.data, self.parameters, self.seed, self.backend = data, parameters, seed, backend
        self.device = device_of(backend)
        p = parameters
        s_min_1 = p.s_min_1 or p.footprint * data.median_depth / data.focal
        self.s_min = flod_s_min(s_min_1, p.rho, p.levels)
        self._ends = list(accumulate(p.steps))
        self._points, self._colors = distinct(data.scene.points, data.scene.point_colors)
        if len(self._points) > p.max_splats:
            some = np.random.default_rng(seed).choice(len(self._points), p.max_splats, replace=False)
            self._points, self._colors = self._points[np.sort(some)], self._colors[np.sort(some)]
        self.model = self._new_model(self._from_points(1))

    # -- what the loop asks of every method ------------------------------------------------------------

    @property
    def steps(self) -> int:
        return self._ends[-1]

    @property
    def levels(self) -> int:
        return self.parameters.levels

    @property
    def splats(self) -> int:
        return len(self.model)

    def level_at(self, step: int) -> int:
        return bisect_right(self._ends, step) + 1

    def train_step(self, step: int) -> tuple[float, torch.Tensor, Target]:
        p, level = self.parameters, self.level_at(step)
        local = step - (self._ends[level - 2] if level > 1 else 0)
        min_scale = self.s_min[level - 1]
        view = self.data.training_view(step, self.seed)
        rendering = rasterize(
            *(self.model[name] for name in NAMES),
            camera=self.data.train[view],
            min_scale=min_scale,
            sh_degree=min(p.sh_degree, step // max(p.sh_interval, 1)),
            near=self.data.near,
            backend=self.backend,
        )
        target = self.data.target(view)
        loss = photometric_loss(rendering.image, target, p.ssim_weight, backend=self.backend)
        loss.backward()
        until = p.densify_until[level - 1] * p.steps[level - 1]
        if local < until:
            self.model.remember(rendering)
        share = local / (p.lr_means_steps or p.steps[level - 1])
        self.model.adam.lr["means"] = means_rate(p, share, self.data.extent)
        self.model.adam.step()
        self.model.adam.zero_grad()
        self._control_density(step, local + 1, level, until)
        return float(loss.detach()), rendering.image.detach(), target

    def levels_after(self, step: int) -> list[Level]:
        """The level that the step completed; the next one is then prepared."""
        if step + 1 not in self._ends:
            return []
        level = self.level_at(step)
        finished = Level(level, self.model.splats(self.s_min[level - 1]), self.s_min[level - 1])
        if level < self.parameters.levels:
            self._rise_to(level + 1)
        return [finished]

    def meta(self) -> dict:
        p, data = self.parameters, self.data
        return {
            "rho": p.rho,
            "gamma": 1.0,
            "camera_center": data.mean_camera.tolist(),
            "focal_px": data.focal,
            "focal_width": data.train[0].width,
            "scene_extent": data.extent,
            "median_depth": data.median_depth,
            "footprint_px": self.s_min[0] * data.focal / data.median_depth,
        }

    def state_dict(self) -> dict:
        return {"model": self.model.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        self.model.load_state_dict(state["model"])

    # -- inside ----------------------------------------------------------------------------------------

    def _from_points(self, level: int) -> dict[str, torch.Tensor]:
        tensors = from_points(self._points, self._colors, self.parameters.sh_degree, self.device)
        tensors["log_scales"] = constrained_log(tensors["log_scales"].exp(), self.s_min[level - 1])
        return tensors

    def _budget(self, level: int) -> int:
        """Most splats that a level may have."""
        p = self.parameters
        return int(p.max_splats * p.budget_ratio ** (p.levels - level))

    def _new_model(self, tensors: dict[str, torch.Tensor]) -> Model:
        return splat_model(tensors, self.parameters, self.data.extent)

    def _control_density(self, step: int, local: int, level: int, until: float) -> None:
        """Adds, prunes and resets, after the ``local``-th step of a level (counted from 1)."""
        p, before = self.parameters, len(self.model)
        if local > until:
            return
        rng = np.random.default_rng([self.seed, step, 1])
        if local % p.densify_interval[level - 1] == 0:
            densify(
                self.model,
                self.model.mean_gradient(),
                threshold=p.grad_threshold * self.data.threshold_scale,
                clone_below=p.clone_extent * self.data.extent,
                max_splats=self._budget(level),
                min_scale=self.s_min[level - 1],
                rng=rng,
            )
            self.model.forget()
        if p.prune_interval and local % p.prune_interval == 0:
            self.model.keep(self.model["opacity_logits"].detach().sigmoid() >= p.min_opacity)
        if p.overlap_interval and local % p.overlap_interval == 0 and level < p.levels:
            means = self.model["means"].detach().cpu()
            self.model.keep(_apart(means, self.s_min[level - 1] / 2))
        if p.opacity_reset_interval and local % p.opacity_reset_interval == 0:
            logits = self.model["opacity_logits"].detach()
            self.model.assign("opacity_logits", logits.clamp_max(float(np.log(0.01 / 0.99))))
        if before and not len(self.model):
            raise LodgsError(
                f"Level {level} lost all its splats at step {step + 1}.",
                "Lower 'footprint' (or 's_min_1'), so that coarse levels keep more splats.",
            )

    def _rise_to(self, level: int) -> None:
        """The next level starts from this one: same scales, a smaller constraint, Adam anew (Eq. 5)."""
        before, after = self.s_min[level - 2], self.s_min[level - 1]
        tensors = {name: self.model[name].detach() for name in NAMES}
        tensors["log_scales"] = constrained_log(tensors["log_scales"].exp() + before, after)
        if self.parameters.rejoin_points:
            # What overlap pruning counts as too close is now half of a smaller size.
            distances, _ = KDTree(tensors["means"].cpu().numpy()).query(self._points)
            free = np.flatnonzero(distances >= after / 2)
            room = max(self._budget(level) - len(tensors["means"]), 0)
            if len(free) > room:
                rng = np.random.default_rng([self.seed, level, 2])
                free = np.sort(rng.choice(free, room, replace=False))
            points = self._from_points(level)
            tensors = {name: torch.cat([tensors[name], points[name][free]]) for name in NAMES}
        self.model = self._new_model(tensors)


def _apart(means: torch.Tensor, distance: float) -> torch.Tensor:
    """Overlap pruning (FLoD, Eq. 6): where the mean distance to the 3 nearest neighbours is at least this.

    As in the published code all splats are judged at once, so that both of a close pair go.
    """
    if len(means) <= 3:
        return torch.ones(len(means), dtype=torch.bool)
    return torch.from_numpy(neighbour_distances(means.numpy()).mean(1) >= distance)
