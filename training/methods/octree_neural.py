"""Octree-GS (Ren et al. 2024) with neural anchors, as Scaffold-GS has them (Lu et al. 2024, Sec. 3).

An anchor stands in the middle of a voxel. It has a feature, and offsets to its Gaussians; small networks say
for each view, from the feature and the direction in which the anchor is seen, what opacity, covariance and
colour the Gaussians have. For Blender and for files they are baked: see :meth:`Method.bake`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot

import numpy as np
import torch
from torch import nn
from torch.nn.functional import normalize

from ..lod.rules import octree_weights
from ..lod.selection import BIAS
from ..rasterize import Adam, Rendering, contributions, rasterize
from ..rasterize import sh as harmonics
from ..rasterize.rendering import ALPHA_MIN
from ..scenes.cameras import Camera
from ..splats.bundle import Level
from ..splats.gaussians import Splats
from . import octree
from .data import TrainingData
from .model import SH_C0, Model
from .parameters import NeuralOctreeParameters

HIDDEN = 32
"""Width of each network's one hidden layer."""
LOOKS, SILENT = 11, -30.0
"""Opacity, three scales, a quaternion and a colour, before their activations; the opacity of one that is
never drawn again."""
SIGMAS = 3.5
"""Standard deviations that a Gaussian may reach into the image from outside."""
SOLVED_AT_ONCE = 100_000
"""Gaussians whose colours baking fits together: a few hundred megabytes."""


@dataclass
class Gaussians:
    """What anchors become for one view; M Gaussians.

    Attributes:
        anchor, which: (M,) whose Gaussian each is, and which of its offsets.
        means, quats, scales, opacities, colors: (M, 3), (M, 4), (M, 3), (M,) and (M, 3).
    """

    anchor: torch.Tensor
    which: torch.Tensor
    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor


class Networks(nn.Module):
    """Feature and viewing direction (and for the colour a view's appearance) to n Gaussians' looks."""

    def __init__(self, features: int, offsets: int, appearance: int, views: int) -> None:
        super().__init__()

        def network(inputs: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(inputs, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))

        self.opacity = network(features + 3, offsets)
        self.covariance = network(features + 3, 7 * offsets)
        self.color = network(features + 3 + appearance, 3 * offsets)
        self.appearance = nn.Parameter(torch.zeros(views, appearance))


class Method(octree.Method):
    """One run with neural anchors; everything but the Gaussians themselves is that of explicit ones.

    Attributes:
        networks: shared by all anchors.
    """

    parameters: NeuralOctreeParameters

    def __init__(
        self, data: TrainingData, parameters: NeuralOctreeParameters, seed: int, backend: str
    ) -> None:
        p = parameters
        places = np.random.default_rng(seed).uniform(-0.5, 0.5, (p.offsets, 3))
        self._spread = torch.from_numpy(places).float()
        """Where in their voxel new anchors' Gaussians begin if they have looks of their own."""
        super().__init__(data, parameters, seed, backend)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.networks = Networks(p.features, p.offsets, p.appearance, len(data.train)).to(self.device)
        names = {name: tensor for name, tensor in self.networks.named_parameters() if tensor.numel()}
        self._networks_adam = Adam(names, dict.fromkeys(names, 0.0))

    # -- what the loop asks of every method ------------------------------------------------------------

    @property
    def splats(self) -> int:
        if not self.parameters.direct:
            return len(self.model) * self.parameters.offsets
        return int((self.model["looks"][..., 0] > SILENT / 2).sum())

    def levels_after(self, step: int) -> list[Level]:
        if step + 1 not in (self.joins[-1], self.steps):
            return []
        splats = self.bake()
        level = splats.extras["lod_level"]
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def arrays(self) -> dict[str, np.ndarray]:
        """Anchors by name, ``network.<name>`` for the networks' weights."""
        model = self.model.adam.tensors | {name: self.model.columns[name] for name in ("level", "bias")}
        networks = {f"network.{name}": tensor for name, tensor in self.networks.state_dict().items()}
        return {name: tensor.detach().cpu().numpy() for name, tensor in (model | networks).items()}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        def tensors(*names: str) -> dict[str, torch.Tensor]:
            return {name: torch.from_numpy(arrays[name]).to(self.device) for name in names}

        rows = tensors(*self.model.adam.tensors)
        columns = self._columns(len(rows["means"])) | tensors("level", "bias")
        self.model = Model(rows, self.model.adam.lr, columns)
        self.networks.load_state_dict(
            {name: torch.from_numpy(arrays[f"network.{name}"]) for name in self.networks.state_dict()}
        )

    def state_dict(self) -> dict:
        return super().state_dict() | {
            "networks": self.networks.state_dict(),
            "networks_adam": self._networks_adam.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self.networks.load_state_dict(state["networks"])
        self._networks_adam.load_state_dict(state["networks_adam"])

    # -- drawing ---------------------------------------------------------------------------------------

    def decode(self, camera: Camera, anchors: torch.Tensor, view: int | None = None) -> Gaussians:
        """The Gaussians of some anchors (indices) for a view; only those of positive opacity.

        Args:
            view: the training view whose appearance is meant; None: their mean.
        """
        p, model = self.parameters, self.model
        places = model["means"][anchors].detach()
        eye = torch.as_tensor(camera.center).to(places)
        seen = torch.cat([model["features"][anchors], normalize(places - eye, dim=1)], 1)
        still = seen if p.view_shapes else torch.cat([seen[:, :-3], torch.zeros_like(seen[:, -3:])], 1)
        own = model["looks"][anchors] if p.direct else seen.new_zeros(1, 1, LOOKS)
        opacity = self.networks.opacity(still) + own[..., 0]
        # tanh as in the paper: Gaussians below 0 are not drawn, and so never learn again
        opacity, least = (opacity.sigmoid(), ALPHA_MIN) if p.direct else (opacity.tanh(), 0.0)
        index, which = torch.nonzero(opacity.detach() > least).unbind(1)

        looks = (self.networks.covariance(still).view(-1, p.offsets, 7) + own[..., 1:8])[index, which]
        appearance = self.networks.appearance
        appearance = appearance.mean(0) if view is None else appearance[view]
        lit = torch.cat([seen, appearance.expand(len(seen), -1)], 1)
        colors = (self.networks.color(lit).view(-1, p.offsets, 3) + own[..., 8:]).sigmoid()[index, which]
        anchor = anchors[index]
        extents = model["log_scales"][anchor].exp()
        return Gaussians(
            anchor=anchor,
            which=which,
            means=places[index] + model["offsets"][anchor, which] * extents[:, :3],
            quats=looks[:, 3:],
            scales=extents[:, 3:] * looks[:, :3].sigmoid(),
            opacities=opacity[index, which],
            colors=colors,
        )

    def _draw(self, camera: Camera, weights: torch.Tensor, step: int) -> Rendering:
        view = self.data.training_view(step, self.seed)
        self._shown = self._visible(camera, weights)
        self._drawn = self.decode(camera, self._shown, view)
        return self._rasterize(self._drawn, camera, None)

    def picture(self, camera: Camera) -> torch.Tensor:
        """What the networks show a camera, (H, W, 3), levels fading as the distance asks."""
        with torch.no_grad():
            weights = octree_weights(self._wanted(camera), self.model.columns["level"])
            gaussians = self.decode(camera, self._visible(camera, weights))
            return self._rasterize(gaussians, camera, weights[gaussians.anchor]).image

    def _rasterize(self, g: Gaussians, camera: Camera, weights: torch.Tensor | None) -> Rendering:
        return rasterize(
            *_shapes(g), g.colors, camera, weights=weights, near=self.data.near, backend=self.backend
        )

    def _largest(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        g = self.decode(camera, self._visible(camera, weights), view)
        found = contributions(*_shapes(g), [camera], near=self.data.near, backend=self.backend).largest
        largest = torch.zeros(len(weights), self.parameters.offsets, device=self.device)
        largest[g.anchor, g.which] = found
        return largest

    def _silence(self, splats: torch.Tensor) -> None:
        if self.parameters.direct:
            self.model["looks"][..., 0][splats] = SILENT

    def _visible(self, camera: Camera, weights: torch.Tensor) -> torch.Tensor:
        """The anchors (indices) of weight above 0 whose Gaussians may be in the image."""
        model = self.model
        means, extents = model["means"].detach(), model["log_scales"].detach().exp()
        reach = (model["offsets"].detach() * extents[:, None, :3]).norm(dim=2).amax(1)
        reach = reach + SIGMAS * extents[:, 3:].amax(1)
        pose = torch.as_tensor(camera.world_to_camera).to(means)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        seen = (weights > 0) & (z + reach > self.data.near)
        for focal, middle, size, across in (
            (camera.fx, camera.cx, camera.width, x), (camera.fy, camera.cy, camera.height, y),
        ):  # fmt: skip
            # inside of the two planes through the eye and the image's edges
            seen &= focal * across + middle * z > -reach * hypot(focal, middle)
            seen &= focal * across + (middle - size) * z < reach * hypot(focal, middle - size)
        return torch.nonzero(seen)[:, 0]

    def _regularised(self, loss: torch.Tensor, rendering: Rendering) -> torch.Tensor:
        scales = self._drawn.scales / self.data.median_depth
        return loss + self.parameters.volume_weight * scales.prod(1).mean()

    # -- anchors ---------------------------------------------------------------------------------------

    def _first_model(self, points: np.ndarray, colors: np.ndarray, level: np.ndarray) -> Model:
        p, count = self.parameters, len(points)
        rows = self._anchors(torch.from_numpy(points).float(), torch.from_numpy(level))
        rows["log_scales"] = self._log_spacing(points, level, columns=6)
        if p.direct:
            rows["looks"][..., 8:] = torch.from_numpy(colors / 255.0).clamp(0.01, 0.99).logit()[:, None]
        rows = {name: row.to(self.device) for name, row in rows.items()}
        columns = self._columns(count)
        columns["level"] += torch.from_numpy(level).to(self.device)
        lr: dict[str, float | torch.Tensor] = {
            "means": 0.0,
            "features": p.lr_features,
            "offsets": p.lr_offsets,
            "log_scales": p.lr_scales,
        }
        if p.direct:
            lr["looks"] = p.lr_looks * torch.tensor([5.0] + [1.0] * 3 + [0.2] * 4 + [1.0] * 3)
        return Model(rows, lr, columns)

    def _columns(self, count: int) -> dict[str, torch.Tensor]:
        """Zeros for all that is kept of anchors; of each of their Gaussians, how often and how steep."""
        single, each = (count,), (count, self.parameters.offsets)
        shapes = dict.fromkeys(("level", "bias", "opacity_sum", "anchor_seen"), single)
        shapes |= dict.fromkeys(("gradient_sum", "seen"), each)
        return {name: torch.zeros(shape, device=self.device) for name, shape in shapes.items()}

    def _anchors(self, places: torch.Tensor, level: torch.Tensor) -> dict[str, torch.Tensor]:
        """New anchors in the middle of the voxels of places (C, 3), without a feature yet."""
        p, count = self.parameters, len(places)
        size = self.tree.voxel * 2 ** (1 - level.double()[:, None])
        origin = torch.from_numpy(self.tree.origin).to(size)
        means = (((places.double() - origin) / size).floor() + 0.5) * size + origin
        rows = {
            "means": means.float(),
            "features": torch.zeros(count, p.features, device=places.device),
            "offsets": torch.zeros(count, p.offsets, 3, device=places.device),
            "log_scales": size.log().float().expand(-1, 6).clone(),
        }
        if p.direct:
            rows["looks"] = torch.zeros(count, p.offsets, LOOKS, device=places.device)
            rows["looks"][..., 0], rows["looks"][..., 4] = octree.FAINT, 1
            rows["offsets"] += self._spread.to(places)
        return rows

    def _remember(self, rendering: Rendering) -> None:
        columns, drawn = self.model.columns, self._drawn
        seen = rendering.radii > 0
        flat = (drawn.anchor * self.parameters.offsets + drawn.which)[seen]
        columns["gradient_sum"].view(-1)[flat] += rendering.grad2d.norm(dim=1)[seen]
        columns["seen"].view(-1)[flat] += 1
        columns["opacity_sum"].index_add_(0, drawn.anchor, drawn.opacities.detach())
        columns["anchor_seen"][self._shown] += 1

    def _optimise(self, step: int) -> None:
        p, share = self.parameters, step / self.steps
        self.model.adam.lr = self._fallen_rates(step)
        self.model.adam.lr["offsets"] = p.lr_offsets ** (1 - share) * p.lr_offsets_final**share
        self.model.adam.step()
        self.model.adam.zero_grad()
        rates = {
            "opacity": p.lr_network * p.lr_network_final**share,
            "covariance": 2 * p.lr_network,
            "color": 4 * p.lr_network * p.lr_network_final**share,
            "appearance": p.lr_appearance * p.lr_network_final**share,
        }
        for name in self._networks_adam.tensors:
            self._networks_adam.lr[name] = rates[name.split(".")[0]]
        self._networks_adam.step()
        self._networks_adam.zero_grad()

    def _grow_and_prune(self, step: int) -> None:
        super()._grow_and_prune(step)
        self.model.columns["anchor_seen"].zero_()

    def _settle(self, step: int) -> None:
        """Nothing: an anchor's level is its voxel's; that of its Gaussians is found when they are baked."""

    def _room(self) -> int:
        return self.parameters.max_splats // self.parameters.offsets

    def _faint(self) -> torch.Tensor:
        columns, p = self.model.columns, self.parameters
        return columns["opacity_sum"] < p.min_opacity * columns["anchor_seen"]

    def _children(
        self, source: torch.Tensor, which: torch.Tensor, level: torch.Tensor, rng: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        """Anchors in the voxels that the Gaussians with the large gradients are in, with their features."""
        model = self.model
        extents = model["log_scales"][source, :3].exp()
        rows = self._anchors(model["means"][source] + model["offsets"][source, which] * extents, level)
        rows["features"] = model["features"][source].clone()
        if self.parameters.direct:
            rows["looks"][..., 1:] = model["looks"][source, which, None, 1:]
        return rows | {"level": level, "bias": model.columns["bias"][source]}

    # -- baking ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def bake(self) -> Splats:
        """The anchors' Gaussians without networks, with their anchor's bias and a level that they fit.

        Opacity and covariance are those of the median, by distance, of the training views that draw the
        anchor; the colour is the spherical harmonics that fit best, in least squares weighted by how much
        of the Gaussian is seen, what the networks say in all of those views, with the mean appearance.
        Gaussians of no opacity in the median view are left out.
        """
        p, count = self.parameters, len(self.model)
        places, columns, terms = self.model["means"], self.model.columns, harmonics.coefficients(p.sh_degree)

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(count, *shape, device=self.device)

        distances = torch.stack([zeros()] * len(self.data.train)) + torch.nan
        for view, camera in enumerate(self.data.train):
            drawn = self._drawn_by(camera)
            eye = torch.as_tensor(camera.center).to(places)
            distances[view, drawn] = (places[drawn] - eye).norm(dim=1)
        middle = distances.nanmedian(0).values
        median_view = (distances - middle).abs().nan_to_num(torch.inf).argmin(0)

        means, quats, scales = zeros(p.offsets, 3), zeros(p.offsets, 4), zeros(p.offsets, 3)
        opacities = zeros(p.offsets)
        products, colors = zeros(p.offsets, terms, terms), zeros(p.offsets, terms, 3)
        for view, camera in enumerate(self.data.train):
            g = self.decode(camera, torch.nonzero(~distances[view].isnan())[:, 0])
            x, y, z = normalize(g.means - torch.as_tensor(camera.center).to(places), dim=1).unbind(1)
            basis: list = [None] * terms
            harmonics.basis(x, y, z, p.sh_degree, basis)
            values = torch.stack(basis, 1)
            seen = contributions(*_shapes(g), [camera], near=self.data.near, backend=self.backend)
            # what is hidden in every view has a colour too
            weighted = values * (seen.largest + 1e-3 * g.opacities)[:, None]
            products[g.anchor, g.which] += weighted[:, :, None] * values[:, None]
            colors[g.anchor, g.which] += weighted[:, :, None] * (g.colors - 0.5)[:, None]
            here = median_view[g.anchor] == view
            at = g.anchor[here], g.which[here]
            means[at], quats[at], scales[at] = g.means[here], g.quats[here], g.scales[here]
            opacities[at] = g.opacities[here]
        kept = opacities > 0
        anchor, which = torch.nonzero(kept).unbind(1)
        # few directions leave the higher harmonics open: they are held to zero
        held = torch.full((terms,), p.bake_ridge, device=self.device).double()
        held[0] *= 1e-3
        fitted = []
        for some in torch.arange(len(anchor), device=self.device).split(SOLVED_AT_ONCE):
            product = products[anchor[some], which[some]].double()
            product += held.diag() * (product[:, :1, :1] / SH_C0**2)
            fitted.append(torch.linalg.solve(product, colors[anchor[some], which[some]].double()).float())
        log_scales = scales[kept].clamp_min(1e-12).log()
        level = self._fitting(columns["level"][anchor], means[kept], log_scales, self.levels)
        return Splats(
            means=means[kept].cpu().numpy(),
            quats=quats[kept].cpu().numpy(),
            log_scales=log_scales.cpu().numpy(),
            opacity_logits=opacities[kept].clamp(1e-6, 1 - 1e-6).logit().cpu().numpy(),
            sh=torch.cat(fitted).cpu().numpy(),
            extras={
                "lod_level": level.cpu().numpy().astype(np.uint8),
                BIAS: columns["bias"][anchor].cpu().numpy(),
            },
        )

    def _drawn_by(self, camera: Camera) -> torch.Tensor:
        """The anchors (indices) that a view draws, with all levels joined."""
        weights = octree_weights(self._wanted(camera), self.model.columns["level"])
        return self._visible(camera, (weights >= 0.5).float())


def _shapes(g: Gaussians) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means, quats, log_scales and opacity_logits, as the rasterizer takes them."""
    opacities = g.opacities.clamp(1e-6, 1 - 1e-6)
    return g.means, g.quats, g.scales.clamp_min(1e-12).log(), opacities.logit()
