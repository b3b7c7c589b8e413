"""CLoD-GS (arXiv 2510.09997, 2025): 3DGS whose splats fade with distance, each at its own pace.

From the step on at which the decay begins, each step draws twice: as it is, and at a random virtual distance
scale s_v > 1, where fewer splats shall give the same photograph (Sec. 3.3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ...lod.rules.decay import SIGMA, attenuation
from ...optimize.density_control import require_rows
from ...optimize.method import Drawing
from ...optimize.model import Model, splat_rates
from ...optimize.schedules import due
from ...optimize.training_data import TrainingView
from ...rasterize import contributions
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from ...splats.levels import Level
from ..threedgs import train as threedgs_train
from . import ClodParameters

SIGMAS = (1e-3, 50.0)
"""Range of the decays that splats begin with."""
VANISH = (1.1, 5.0)
"""Range of the virtual scales at which splats vanish when decays begin by importance: the least one, and the
largest in multiples of ``s_v_most``."""
POINTS = 50_000
"""About as many of the scene's points tell how far views see."""
OPAQUE = 0.99
"""The largest opacity that splats begin their decay with."""


@dataclass
class ClodDrawing(Drawing):
    """A picture at a virtual distance scale.

    Attributes:
        s_v: the scale.
        attenuated: (N,) attenuated opacities.
        shown: (N,) those above the threshold.
        inside: (N,) those whose mean is in the image.
    """

    s_v: float
    attenuated: torch.Tensor
    shown: torch.Tensor
    inside: torch.Tensor


class Method(threedgs_train.Method):
    """One run of CLoD-GS.

    Attributes:
        reference: the distance that all distances are taken in, in scene units; 0 takes the farthest splat of
            each view.
        begins: the step at which the decay begins.
    """

    parameters: ClodParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        super().setup(base)
        tensors = {name: tensor.detach() for name, tensor in self.model.adam.tensors.items()}
        self.begins = round(p.begin * p.steps)
        if base is not None:
            self.begins = self._densify_until = 0
        sigma = torch.full((len(tensors["means"]),), p.sigma_init, device=self.device)
        rates = splat_rates(p, self.data.extent) | {SIGMA: p.lr_sigma}
        peaks = p.densify_by == "max"
        self.model = Model(tensors | {SIGMA: self._stored(sigma)}, rates, peaks=peaks)
        self.reference = self._far_distance(p.reference_quantile) if p.reference_quantile else 0.0

    def levels_after(self, step: int) -> list[Level]:
        """The one level, at the end; by mean weight over the training views, so that a prefix is coarser."""
        if step + 1 != self.steps:
            return []
        splats = self.model.splats()
        splats.extras[SIGMA] = self.sigma.detach().cpu().numpy()
        order = torch.argsort(self.mean_weight(), descending=True, stable=True)
        return [Level(1, splats.select(order.cpu().numpy()))]

    def facts(self) -> dict[str, float]:
        return {"reference": self.reference, "tau": self.parameters.tau}

    # -- the decay -------------------------------------------------------------------------------------

    @property
    def sigma(self) -> torch.Tensor:
        """σ_d (N,) of every splat."""
        return self.model[SIGMA].exp() if self.parameters.log_sigma else self.model[SIGMA]

    def normalized(self, camera: Camera) -> torch.Tensor:
        """d′ (N,): distances from a camera over the reference (Sec. 3.2)."""
        means = self.model["means"].detach()
        away = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
        return away / (self.reference or away.max().clamp_min(1e-20))

    def attenuated(self, camera: Camera, s_v: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Attenuations, attenuated opacities and where these are above τ s_v, (N,) each (Eq. 2)."""
        falloff = attenuation(self.normalized(camera), self.sigma, s_v)
        opacities = self.model["opacity_logits"].sigmoid() * falloff
        return falloff, opacities, opacities > self.parameters.tau * s_v

    @torch.no_grad()
    def mean_weight(self) -> torch.Tensor:
        """The rule's mean weight (N,) at s_v = 1 over the training views."""
        total = torch.zeros(len(self.model), device=self.device)
        for camera in self.data.train:
            falloff, _, shown = self.attenuated(camera, 1.0)
            total += falloff * shown
        return total / len(self.data.train)

    def _stored(self, sigma: torch.Tensor) -> torch.Tensor:
        """σ_d as the model trains it."""
        return sigma.log() if self.parameters.log_sigma else sigma

    # -- a step ----------------------------------------------------------------------------------------

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        if step < self.begins:
            return super().draw(view, step)
        if step == self.begins:
            self.begin_decay()
        means = self.model["means"].detach().cpu().numpy()
        inside = torch.from_numpy(view.camera.sees(means, near=self.data.near)).to(self.device)
        drawings: list[Drawing] = []
        for s_v in (1.0, self.random_scale(step)):
            falloff, opacities, shown = self.attenuated(view.camera, s_v)
            rendering = self.rasterize_model(view.camera, step, weights=falloff * shown)
            drawings.append(ClodDrawing(rendering, s_v, opacities, shown, inside))
        return drawings

    def allows_device_step(self, step: int) -> bool:
        return step < self.begins

    def random_scale(self, step: int) -> float:
        """A virtual distance scale from 1 to ``s_v_most``."""
        p, share = self.parameters, np.random.default_rng([self.seed, step, 7]).random()
        return float(p.s_v_most**share if p.log_uniform else 1 + (p.s_v_most - 1) * share)

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """3DGS's of the pictures, and what regularises the count of splats at the random scale (Eq. 3, 4)."""
        first, *others = drawings
        loss = super().loss([first], view, step)
        for drawing in others:
            assert isinstance(drawing, ClodDrawing)
            excess = self.parameters.count_weight * self.count_excess(drawing)
            loss = loss + self.parameters.random_weight * (super().loss([drawing], view, step) + excess)
        return loss

    def count_excess(self, drawing: ClodDrawing) -> torch.Tensor:
        """(s_v − 1)² ReLU(η − η_target)², η the share of splats in view that is drawn (Eq. 3).

        η_target is min(1, (s_v / onset)^-exponent). Counting has no gradient; that of a sigmoid of
        ln(α″ / τ s_v) goes straight through.
        """
        p, s_v = self.parameters, drawing.s_v
        margin = (drawing.attenuated.clamp_min(1e-12) / (p.tau * s_v)).log()
        soft = (margin / p.count_softness).sigmoid()
        counted = drawing.shown + soft - soft.detach()
        share = counted[drawing.inside].sum() / drawing.inside.sum().clamp_min(1)
        return (s_v - 1) ** 2 * (share - min(1.0, (s_v / p.onset) ** -p.exponent)).relu() ** 2

    def control_density(self, step: int) -> None:
        super().control_density(step)
        if step >= self.begins and due(self.parameters.prune_interval, step + 1):
            self.model.keep(self.seen_somewhere())
            require_rows(self.model, step, "tau")

    def adds_margins(self, step: int) -> bool:
        """Right after the decay has begun, which removes what photographs show little of."""
        return step == self.begins > 0

    def append_margins(self, rows: Mapping[str, torch.Tensor], step: int) -> None:
        sigma = torch.full_like(rows["opacity_logits"], self.parameters.sigma_init)
        super().append_margins({**rows, SIGMA: self._stored(sigma)}, step)

    @torch.no_grad()
    def seen_somewhere(self) -> torch.Tensor:
        """Splats (N,) that are drawn at s_v = 1 from the place of some training view."""
        seen = torch.zeros(len(self.model), dtype=torch.bool, device=self.device)
        for camera in self.data.train:
            seen |= self.attenuated(camera, 1.0)[2]
        return seen

    # -- how the decay begins --------------------------------------------------------------------------

    @torch.no_grad()
    def begin_decay(self) -> None:
        """Removes what matters least, and gives every other splat its first σ_d.

        What matters is how much a splat gives to the pixels of a training view that draws it, on average.
        """
        gaussians = self.model.gaussians.detach()
        found = contributions(
            gaussians, self.data.train, near=self.data.near, antialias=self.parameters.antialias,
            backend=self.backend,
        )  # fmt: skip
        importance = found.total / found.views.clamp_min(1)
        order = importance.argsort(descending=True, stable=True)
        drawn = found.views[order].cumsum(0)
        count = int((drawn <= self.parameters.keep_share * float(drawn[-1])).sum())
        order = order[: min(max(count, 1), self.parameters.max_splats)]
        keep = torch.zeros(len(gaussians), dtype=torch.bool, device=self.device)
        keep[order] = True
        self.model.keep(keep)
        if self.parameters.by_importance:
            self._begin_by_importance(importance[keep])

    def _begin_by_importance(self, importance: torch.Tensor) -> None:
        """Opacities and σ_d with which splats look as before from near, and vanish when it is their turn.

        The share r of splats that matter more is drawn up to the scale s = onset · r^(-1/exponent). With
        c = d′² / 2σ_d² at the mean distance d′ of the views that a splat is in, and its opacity o until now:
        α exp(−c (d′_nearest / d′)²) = o, and α exp(−c s²) = τ s. Where α would exceed OPAQUE the first gives
        way.
        """
        p, count = self.parameters, len(self.model)
        rank = torch.empty(count, device=self.device)
        order = importance.argsort(descending=True, stable=True)
        rank[order] = (torch.arange(count, device=self.device) + 0.5) / count
        scale = (p.onset * rank ** (-1 / p.exponent)).clamp(VANISH[0], VANISH[1] * p.s_v_most)

        mean, nearest = self._distances()
        near = (nearest / mean) ** 2

        opacity, least = self.model["opacity_logits"].detach().sigmoid(), p.tau * scale
        c = (opacity / least).clamp_min(1.05).log() / (scale**2 - near)
        alpha = opacity * (c * near).exp()
        c = torch.where(alpha > OPAQUE, (OPAQUE / least).clamp_min(1.05).log() / scale**2, c)
        self.model.assign("opacity_logits", alpha.clamp(1e-4, OPAQUE).logit())
        sigma = mean / (self.reference or float(mean.max())) / (2 * c).sqrt()
        self.model.assign(SIGMA, self._stored(sigma.clamp(*SIGMAS)))

    def _distances(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Each splat's mean distance (N,) from the training views that it is in, and its least.

        Of a splat that is in none, both are the distance of the nearest view.
        """
        means = self.model["means"].detach()
        points = means.cpu().numpy()
        total, views = torch.zeros_like(means[:, 0]), torch.zeros_like(means[:, 0])
        nearest, closest = torch.full_like(total, torch.inf), torch.full_like(total, torch.inf)
        for camera in self.data.train:
            inside = torch.from_numpy(camera.sees(points, near=self.data.near)).to(self.device)
            away = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
            total, views = total + away * inside, views + inside
            nearest = torch.where(inside, torch.minimum(nearest, away), nearest)
            closest = torch.minimum(closest, away)
        seen = views > 0
        return torch.where(seen, total / views.clamp_min(1), closest), torch.where(seen, nearest, closest)

    def _far_distance(self, quantile: float) -> float:
        """A quantile of the distances between training views and the scene's points that they see."""
        points = self.data.full_scene.points
        points = points[:: max(1, len(points) // POINTS)]
        seen = [
            np.linalg.norm(points[camera.sees(points, near=self.data.near)] - camera.center, axis=1)
            for camera in self.data.full_train
        ]
        return float(np.quantile(np.concatenate(seen), quantile))
