"""CLoD-GS (arXiv 2510.09997, 2025): 3DGS with splats that fade with distance, each at its own rate.

Once the decay has begun, each step renders two images: at scale 1, and at a random virtual distance scale
s_v > 1, where fewer splats have to reproduce the same photo (Sec. 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt

import numpy as np
import torch

from ...lod.rules.decay import SIGMA, attenuation
from ...optimize.density_control import require_rows
from ...optimize.method import Drawing
from ...optimize.model import Model, splat_rates
from ...optimize.schedules import due
from ...optimize.splat_method import SplatMethod
from ...optimize.training_data import TrainingView
from ...rasterize import contributions
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from ...splats.levels import Level
from . import ClodParameters

SIGMAS = (1e-3, 50.0)
"""Range of initial decays."""
VANISH_SCALES = (1.1, 5.0)
"""Range of virtual scales at which splats vanish if decays are initialized by importance: the minimum, and
the maximum as a multiple of ``s_v_most``."""
MAX_POINTS = 50_000
"""Approximate number of scene points for measuring view distances."""
MAX_OPACITY = 0.99
"""Maximum initial opacity of splats when the decay begins."""


@dataclass
class ClodDrawing(Drawing):
    """An image rendered at a virtual distance scale.

    Attributes:
        s_v: the scale.
        attenuated: (N,) attenuated opacities.
        drawn: (N,) True if they are above the threshold.
        in_view: (N,) True if the splat's mean is in the image.
    """

    s_v: float
    attenuated: torch.Tensor
    drawn: torch.Tensor
    in_view: torch.Tensor


class Method(SplatMethod):
    """Training of CLoD-GS.

    Attributes:
        reference: reference distance of the rule in scene units.
        decay_start: step at which the decay begins.
    """

    parameters: ClodParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        super().setup(base)
        tensors = {name: tensor.detach() for name, tensor in self.model.adam.tensors.items()}
        self.decay_start = round(p.begin * p.steps)
        if base is not None:
            self.decay_start = self._densify_until = 0
        self.device_steps = self.decay_start
        sigma = torch.full((len(tensors["means"]),), p.sigma_init or 1.0, device=self.device)
        rates = splat_rates(p, self.data.extent) | {SIGMA: p.lr_sigma}
        peaks = p.densify_by == "max" or p.prune_oversized
        self.model = Model(tensors | {SIGMA: self._encode(sigma)}, rates, peaks=peaks)
        self.reference = self._point_distance(p.reference_quantile or 1.0)
        self.facts = {"reference": self.reference, "tau": p.tau}

    def levels_after(self, step: int) -> list[Level]:
        """Return the single level at the end, sorted by mean weight over the training views, so that
        prefixes are coarser.

        It omits splats of σ_d <= 0: Eq. 2 never draws them, and its ReLU gives them no gradient to return.
        """
        if step + 1 != self.steps:
            return []
        self.model.keep(self.sigma.detach() > 0)
        require_rows(self.model, step, "lr_sigma")
        splats = self.model.splats()
        far = self.mean_far_distance()
        splats.extras[SIGMA] = (self.sigma.detach() * (far / self.reference)).cpu().numpy()
        order = torch.argsort(self.mean_weight(far), descending=True, stable=True)
        return [Level(1, splats.select(order.cpu().numpy()))]

    # -- the decay -------------------------------------------------------------------------------------

    @property
    def sigma(self) -> torch.Tensor:
        """σ_d (N,) of all splats."""
        return self.model[SIGMA].exp() if self.parameters.log_sigma else self.model[SIGMA]

    @torch.no_grad()
    def far_distance(self, camera: Camera) -> float:
        """Return the distance where d′ is 1: the reference, or the farthest splat's in view (Sec. 3.2)."""
        if self.parameters.reference_quantile:
            return self.reference
        distances = self._distances_from(camera)[self._in_view(camera)]
        return float(distances.max()) if len(distances) else self.reference

    def mean_far_distance(self) -> float:
        """Return the mean of :meth:`far_distance` over the training views, which the bundle uses for all
        views: without it, detail would change as the camera turns.
        """
        if self.parameters.reference_quantile:
            return self.reference
        return float(np.mean([self.far_distance(camera) for camera in self.data.train]))

    def attenuate(
        self, camera: Camera, s_v: float, far: float | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return attenuations, attenuated opacities and whether these exceed τ s_v, (N,) each (Eq. 2).

        Args:
            far: distance where d′ is 1; None uses :meth:`far_distance`.
        """
        normalized = self._distances_from(camera) / (self.far_distance(camera) if far is None else far)
        falloff = attenuation(normalized, self.sigma, s_v)
        logits = self.model["opacity_logits"]
        if not self.parameters.count_opacities:  # only images decide how a splat looks
            logits = logits.detach()
        opacities = logits.sigmoid() * falloff
        return falloff, opacities, opacities > self.parameters.tau * s_v

    @torch.no_grad()
    def mean_weight(self, far: float) -> torch.Tensor:
        """Return the rule's mean weight (N,) at s_v = 1 over the training views."""
        total = torch.zeros(len(self.model), device=self.device)
        for camera in self.data.train:
            falloff, _, drawn = self.attenuate(camera, 1.0, far)
            total += falloff * drawn
        return total / len(self.data.train)

    def _distances_from(self, camera: Camera) -> torch.Tensor:
        """Return the distances (N,) of all splats from a camera."""
        means = self.model["means"].detach()
        return (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)

    def _in_view(self, camera: Camera) -> torch.Tensor:
        """Return the splats (N,) whose mean is in a camera's image."""
        means = self.model["means"].detach().cpu().numpy()
        return torch.from_numpy(camera.sees(means, near=self.data.near)).to(self.device)

    def _encode(self, sigma: torch.Tensor) -> torch.Tensor:
        """Convert σ_d to the trained parameter."""
        return sigma.log() if self.parameters.log_sigma else sigma

    # -- steps -----------------------------------------------------------------------------------------

    def draw(self, view: TrainingView, step: int) -> Sequence[Drawing]:
        if step < self.decay_start:
            return super().draw(view, step)
        if step == self.decay_start:
            self.begin_decay()
        in_view, far = self._in_view(view.camera), self.far_distance(view.camera)
        drawings: list[Drawing] = []
        for s_v in (1.0, self.random_scale(step)):
            falloff, opacities, drawn = self.attenuate(view.camera, s_v, far)
            rendering = self.rasterize_model(view.camera, step, weights=falloff * drawn)
            drawings.append(ClodDrawing(rendering, s_v, opacities, drawn, in_view))
        return drawings

    def random_scale(self, step: int) -> float:
        """Draw a virtual distance scale from 1 to ``s_v_most``."""
        p, share = self.parameters, np.random.default_rng([self.seed, step, 7]).random()
        return float(p.s_v_most**share if p.log_uniform else 1 + (p.s_v_most - 1) * share)

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """Return the 3DGS loss of both images plus the splat count regularization at the random scale (Eq.
        3, 4).
        """
        first, *random_drawings = drawings
        loss = super().loss([first], view, step)
        for drawing in random_drawings:
            assert isinstance(drawing, ClodDrawing)
            excess = self.parameters.count_weight * self.count_excess(drawing)
            loss = loss + self.parameters.random_weight * (super().loss([drawing], view, step) + excess)
        return loss

    def count_excess(self, drawing: ClodDrawing) -> torch.Tensor:
        """Return w_s ReLU(η − η_target)², with η the drawn fraction of the splats (Eq. 3).

        w_s is (s_v − 1)², or 1 without ``scale_weight``. η_target is min(1, (s_v / onset)^-exponent).
        Counting has no gradient; a straight-through estimator uses the sigmoid of ln(α″ / τ s_v).
        """
        p, s_v = self.parameters, drawing.s_v
        margin = (drawing.attenuated.clamp_min(1e-12) / (p.tau * s_v)).log()
        soft = (margin / p.count_softness).sigmoid()
        counted = drawing.drawn + soft - soft.detach()
        if p.count_of == "view":
            counted = counted[drawing.in_view]
        share = counted.sum() / max(len(counted), 1)
        weight = (s_v - 1) ** 2 if p.scale_weight else 1.0
        return weight * (share - min(1.0, (s_v / p.onset) ** -p.exponent)).relu() ** 2

    def control_density(self, step: int) -> None:
        super().control_density(step)
        p = self.parameters
        if p.prune_undrawn and step >= self.decay_start and due(p.prune_interval, step + 1):
            self.model.keep(self.drawn_anywhere())
            require_rows(self.model, step, "tau")

    def add_margins(self, step: int) -> None:
        """Add margins if due: once the decay has begun, which removes splats of low weight in the photos."""
        if step == self.decay_start > 0:
            rows = self.margin_rows()
            sigma = self.parameters.sigma_init or float(self.sigma.detach().median())
            sigma = torch.full_like(rows["opacity_logits"], sigma)
            self.model.append({**rows, SIGMA: self._encode(sigma)})

    @torch.no_grad()
    def drawn_anywhere(self) -> torch.Tensor:
        """Return the splats (N,) that are drawn at s_v = 1 from any training camera."""
        visible = torch.zeros(len(self.model), dtype=torch.bool, device=self.device)
        for camera in self.data.train:
            visible |= self.attenuate(camera, 1.0)[2]
        return visible

    # -- initial decay ---------------------------------------------------------------------------------

    @torch.no_grad()
    def begin_decay(self) -> None:
        """Remove the least important splats, and initialize the decay of the others.

        Importance is a splat's mean contribution to the pixels of the training views that draw it.
        """
        gaussians = self.model.gaussians.detach()
        contribution = contributions(
            gaussians, self.data.train, near=self.data.near, antialias=self.parameters.antialias,
            backend=self.backend,
        )  # fmt: skip
        importance = contribution.total / contribution.views.clamp_min(1)
        order = importance.argsort(descending=True, stable=True)
        drawn = contribution.views[order].cumsum(0)
        count = int((drawn <= self.parameters.keep_share * float(drawn[-1])).sum())
        order = order[: min(max(count, 1), self.parameters.splat_limit)]
        keep = torch.zeros(len(gaussians), dtype=torch.bool, device=self.device)
        keep[order] = True
        self.model.keep(keep)
        if self.parameters.by_importance:
            self._begin_by_importance(importance[keep])
        elif not self.parameters.sigma_init:
            self._begin_by_distance()

    def _begin_by_distance(self) -> None:
        """Set σ_d so that each splat's opacity is halved at the scale s = √s_v_most.

        With its mean distance d′ in the views that contain it, exp(−(d′ s)² / 2σ_d²) = 1/2. A σ_d that all
        splats share would either never attenuate the near splats, or remove the far ones at scale 1.
        """
        mean, _ = self._distances()
        half_scale = sqrt(self.parameters.s_v_most)
        sigma = mean / self.mean_far_distance() * half_scale / sqrt(2 * log(2))
        self.model.assign(SIGMA, self._encode(sigma.clamp(*SIGMAS)))

    def _begin_by_importance(self, importance: torch.Tensor) -> None:
        """Set opacities and σ_d so that splats look unchanged from near and vanish in order of importance.

        The fraction r of more important splats is drawn up to the scale s = onset · r^(-1/exponent). With
        c = d′² / 2σ_d² at the mean distance d′ of the views that contain a splat, and its current opacity
        o: α exp(−c (d′_nearest / d′)²) = o, and α exp(−c s²) = τ s. If α would exceed MAX_OPACITY, the first
        equation is dropped.
        """
        p, count = self.parameters, len(self.model)
        rank = torch.empty(count, device=self.device)
        order = importance.argsort(descending=True, stable=True)
        rank[order] = (torch.arange(count, device=self.device) + 0.5) / count
        scale = (p.onset * rank ** (-1 / p.exponent)).clamp(VANISH_SCALES[0], VANISH_SCALES[1] * p.s_v_most)

        mean, nearest = self._distances()
        near = (nearest / mean) ** 2

        opacity, threshold = self.model["opacity_logits"].detach().sigmoid(), p.tau * scale
        c = (opacity / threshold).clamp_min(1.05).log() / (scale**2 - near)
        alpha = opacity * (c * near).exp()
        c = torch.where(alpha > MAX_OPACITY, (MAX_OPACITY / threshold).clamp_min(1.05).log() / scale**2, c)
        self.model.assign("opacity_logits", alpha.clamp(1e-4, MAX_OPACITY).logit())
        sigma = mean / self.mean_far_distance() / (2 * c).sqrt()
        self.model.assign(SIGMA, self._encode(sigma.clamp(*SIGMAS)))

    def _distances(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return each splat's mean and minimum distance (N,) from the training views that contain it.

        Both are the distance of the nearest view if no view contains the splat.
        """
        total = torch.zeros(len(self.model), device=self.device)
        views = torch.zeros_like(total)
        nearest, closest = torch.full_like(total, torch.inf), torch.full_like(total, torch.inf)
        for camera in self.data.train:
            in_view, distances = self._in_view(camera), self._distances_from(camera)
            total, views = total + distances * in_view, views + in_view
            nearest = torch.where(in_view, torch.minimum(nearest, distances), nearest)
            closest = torch.minimum(closest, distances)
        visible = views > 0
        return torch.where(visible, total / views.clamp_min(1), closest), torch.where(
            visible, nearest, closest
        )

    def _point_distance(self, quantile: float) -> float:
        """Return a quantile of the distances between training views and their visible scene points."""
        points = self.data.full_scene.points
        points = points[:: max(1, len(points) // MAX_POINTS)]
        visible = [
            np.linalg.norm(points[camera.sees(points, near=self.data.near)] - camera.center, axis=1)
            for camera in self.data.full_train
        ]
        return float(np.quantile(np.concatenate(visible), quantile))
