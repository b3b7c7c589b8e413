"""Matryoshka Gaussian Splatting (arXiv 2603.19234): 3DGS of an ordered set, with a random prefix per step.

Each step renders all splats and one random prefix of the order; both images have to reproduce the photo
(stochastic budget training). Not in the paper: the first steps train all splats only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ...lod.rules.prefix import RANK, VIEW_DISTANCE
from ...optimize.initialize import from_splats
from ...optimize.merging import merge
from ...optimize.method import Drawing
from ...optimize.model import NAMES, Model, splat_rates
from ...optimize.schedules import due
from ...optimize.splat_method import SplatMethod
from ...optimize.training_data import TrainingView
from ...rasterize import contributions
from ...splats.gaussians import Splats
from ...splats.levels import Level
from . import MatryoshkaParameters

BASE = "base"
"""Column that is 1 for the splats of the base."""
IMPORTANCE = "importance"
"""Column with the importance of each splat at the last ordering; 0 for newer splats."""


class Method(SplatMethod):
    """Training of Matryoshka.

    Attributes:
        order_start: step at which splats are ordered for the first time.
    """

    parameters: MatryoshkaParameters

    def setup(self, base: Splats | None) -> None:
        p = self.parameters
        super().setup(base)
        self.levels = p.levels
        self.order_start = round(p.begin * p.steps)
        if base is not None:
            self.order_start = self._densify_until = 0
        self.device_steps = self.order_start
        self.model = self._new_model({name: self.model[name].detach() for name in NAMES})

    def _new_model(self, tensors: Mapping[str, torch.Tensor]) -> Model:
        p, zeros = self.parameters, torch.zeros(len(tensors["means"]), device=self.device)
        peaks = p.densify_by == "max" or p.prune_oversized
        columns = {IMPORTANCE: zeros, BASE: zeros.clone()}
        return Model(tensors, splat_rates(p, self.data.extent), columns, peaks=peaks)

    def level_at(self, step: int) -> int:
        return self.parameters.levels

    def levels_after(self, step: int) -> list[Level]:
        """Return the prefixes at the end; each level holds its additions to the coarser ones."""
        if step + 1 != self.steps:
            return []
        p, splats = self.parameters, self.model.splats()
        splats = splats.select(self.order().cpu().numpy())
        splats.extras[RANK] = np.arange(len(splats), dtype=np.float32)
        splats.extras[VIEW_DISTANCE] = self._view_distances(splats.means)
        self.facts = {"share": p.drawn, "share_focal": self.data.focal, "splats": float(len(splats))}
        ends = [
            round(len(splats) * p.level_ratio ** (p.levels - number)) for number in range(1, p.levels + 1)
        ]
        begins = [0, *ends[:-1]]
        parts = [slice(begin, end) for begin, end in zip(begins, ends, strict=True)]
        return [Level(number, splats.select(part)) for number, part in enumerate(parts, 1)]

    def order(self) -> torch.Tensor:
        """Return the splats' indices (N,) in descending order of importance."""
        columns = self.model.columns
        order = torch.argsort(columns[IMPORTANCE], descending=True, stable=True)
        return order[torch.argsort(columns[BASE][order], descending=True, stable=True)]

    def _view_distances(self, means: np.ndarray) -> np.ndarray:
        """Return the mean distance (N,) of the training views that contain each splat, or the distance of the
        nearest view if none does.
        """
        total, views, nearest = np.zeros(len(means)), np.zeros(len(means)), np.full(len(means), np.inf)
        for camera in self.data.train:
            distance = np.linalg.norm(means - camera.center, axis=1) * (self.data.focal / camera.focal)
            seen = camera.sees(means, near=self.data.near)
            total, views = total + distance * seen, views + seen
            nearest = np.minimum(nearest, distance)
        return np.where(views > 0, total / np.maximum(views, 1), nearest).astype(np.float32)

    # -- steps -----------------------------------------------------------------------------------------

    def begin_step(self, step: int) -> None:
        """Compute the order if due."""
        local = step - self.order_start
        if local == 0:
            self.add_base()
        if local == 0 or (local > 0 and due(self.parameters.order_interval, local)):
            self.compute_order()

    @torch.no_grad()
    def add_base(self) -> None:
        """Replace the splats by two merges of them, a coarse one as base, and as many splats in total."""
        p, splats = self.parameters, self.model.splats()
        count = round(p.base_share * len(splats))
        if not count:
            return
        base, detail = merge(splats, count), merge(splats, len(splats) - count)
        joined = Splats.concatenated([base, detail])
        self.model = self._new_model(from_splats(joined, p.sh_degree, self.device))
        self.model.columns[BASE][:count] = 1

    def draw(self, view: TrainingView, step: int) -> Sequence[Drawing]:
        drawings = list(super().draw(view, step))
        if step >= self.order_start:
            weights = self.prefix_weights(self.random_length(step))
            drawings.append(Drawing(self.rasterize_model(view.camera, step, weights=weights)))
        return drawings

    def random_length(self, step: int) -> int:
        """Draw the number of splats of a prefix."""
        p, random = self.parameters, np.random.default_rng([self.seed, step, 12]).random()
        share = p.min_prefix ** (1 - random) if p.log_uniform else p.min_prefix + (1 - p.min_prefix) * random
        return max(round(share * len(self.model)), 1)

    def prefix_weights(self, count: int) -> torch.Tensor:
        """Return weights (N,): 1 for the first ``count`` splats of the order, else 0."""
        weights = torch.zeros(len(self.model), device=self.device)
        weights[self.order()[:count]] = 1
        return weights

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """Return the 3DGS loss of the full image plus that of the prefix."""
        first, *prefixes = drawings
        loss = super().loss([first], view, step)
        for drawing in prefixes:
            loss = loss + self.parameters.prefix_weight * super().loss([drawing], view, step)
        return loss

    @torch.no_grad()
    def compute_order(self) -> None:
        """Compute the importance of all splats in the training views, which include the margins."""
        p, data = self.parameters, self.data
        if p.order_by == "opacity":
            importance = self.model["opacity_logits"].detach().sigmoid()
        else:
            measured = contributions(
                self.model.gaussians.detach(),
                (camera.widened(p.margin) for camera in data.train),
                near=data.near,
                antialias=p.antialias,
                backend=self.backend,
            )
            importance = measured.total if p.order_by == "total" else measured.largest
        self.model.columns[IMPORTANCE] = importance.clone()

    # -- checkpoints -----------------------------------------------------------------------------------

    def state_dict(self) -> dict:
        return {**super().state_dict(), "facts": self.facts}

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.facts = state["facts"]
