"""Octree-GS (Ren et al. 2024) with neural anchors, as Scaffold-GS has them (Lu et al. 2024, Sec. 3).

An anchor stands in the middle of a voxel. It has a feature, and offsets to its Gaussians; small networks say
for each view, from the feature and the direction in which the anchor is seen, what opacity, covariance and
colour the Gaussians have. For Blender and for files they are baked: see :meth:`Method.bake`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np
import torch
from torch import nn
from torch.nn.functional import normalize

from ...lod.rules.octree import BIAS, fade_weights
from ...optimize import method
from ...optimize.density_control import require_rows
from ...optimize.model import Model
from ...optimize.schedules import log_linear
from ...optimize.training_data import TrainingView
from ...rasterize import Adam, Contributions, Gaussians, Rendering, contributions, rasterize
from ...rasterize.adam import LearningRate
from ...rasterize.rendering import ALPHA_MIN
from ...scenes.cameras import Camera
from ...splats import sh as harmonics
from ...splats.gaussians import SH_C0, Splats
from ...splats.levels import Level
from ..octree import growing
from . import NeuralOctreeParameters

HIDDEN = 32
"""Width of each network's one hidden layer."""
LOOKS, UNDRAWN = 11, -30.0
"""Opacity, three scales, a quaternion and a colour, before their activations; the opacity of one that is
never drawn again."""
SIGMAS = 3.5
"""Standard deviations that a Gaussian may reach into the image from outside."""
SOLVED_AT_ONCE = 100_000
"""Gaussians whose colours baking fits together: a few hundred megabytes."""


@dataclass
class NeuralGaussians:
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

    def gaussians(self) -> Gaussians:
        """These as the rasterizer takes them."""
        logits = self.opacities.clamp(1e-6, 1 - 1e-6).logit()
        return Gaussians(self.means, self.quats, self.scales.clamp_min(1e-12).log(), logits, self.colors)


@dataclass
class Drawing(method.Drawing):
    """A picture of anchors.

    Attributes:
        anchors: (A,) indices of those that were asked for Gaussians.
        decoded: their Gaussians.
    """

    anchors: torch.Tensor
    decoded: NeuralGaussians


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


class Method(method.Method[NeuralOctreeParameters, Drawing]):
    """One run with neural anchors.

    Attributes:
        schedule: which levels a step draws, with the octree.
        networks: shared by all anchors.
    """

    def setup(self, base: Splats | None) -> None:
        p, seed = self.parameters, self.seed
        places = np.random.default_rng(seed).uniform(-0.5, 0.5, (p.offsets, 3))
        self._spread = torch.from_numpy(places).float()
        """Where in their voxel new anchors' Gaussians begin if they have looks of their own."""
        self._most = self.growth_limit(0) // p.offsets
        self.schedule, points, colors, level = growing.plant(self.data, p, seed, self._most)
        self._rates: dict[str, LearningRate] = {
            "means": 0.0,
            "features": p.lr_features,
            "offsets": p.lr_offsets,
            "log_scales": p.lr_scales,
        }
        if p.direct:
            self._rates["looks"] = p.lr_looks * torch.tensor([5.0] + [1.0] * 3 + [0.2] * 4 + [1.0] * 3)
        rows = self._anchors(torch.from_numpy(points).float(), torch.from_numpy(level))
        rows["log_scales"] = growing.log_spacing(points, level, columns=6)
        if p.direct:
            rows["looks"][..., 8:] = torch.from_numpy(colors / 255.0).clamp(0.01, 0.99).logit()[:, None]
        self.model = self._new_model(rows, torch.from_numpy(level).float(), torch.zeros(len(points)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.networks = Networks(p.features, p.offsets, p.appearance, len(self.data.train)).to(
                self.device
            )
        names = {name: tensor for name, tensor in self.networks.named_parameters() if tensor.numel()}
        self._networks_adam = Adam(names, dict.fromkeys(names, 0.0))

    def _new_model(self, rows: Mapping[str, torch.Tensor], level: torch.Tensor, bias: torch.Tensor) -> Model:
        """A model of anchors; what is added up is of each of their Gaussians where that is asked for."""
        count, device = len(level), self.device
        single = {name: torch.zeros(count, device=device) for name in ("opacity_sum", "anchor_seen")}
        each = {
            name: torch.zeros(count, self.parameters.offsets, device=device)
            for name in ("gradient_sum", "seen")
        }
        return Model(
            {name: row.to(device) for name, row in rows.items()},
            self._rates,
            columns={"level": level.to(device), "bias": bias.to(device)},
            stats=single | each,
        )

    @property
    def levels(self) -> int:
        return self.schedule.tree.levels

    @property
    def splats(self) -> int:
        if not self.parameters.direct:
            return len(self.model) * self.parameters.offsets
        return int((self.model["looks"][..., 0] > UNDRAWN / 2).sum())

    def level_at(self, step: int) -> int:
        return self.schedule.level_at(step)

    def levels_after(self, step: int) -> list[Level]:
        """All levels, baked, when the last one has joined and at the end."""
        if not self.schedule.hands_over(step):
            return []
        splats = self.with_margins(self.bake())
        level = splats.extras["lod_level"]
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def facts(self) -> dict[str, float]:
        return self.schedule.tree.facts()

    def meta(self) -> dict:
        tree = self.schedule.tree
        return {"voxel": tree.voxel, **super().meta()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Anchors by name, ``network.<name>`` for the networks' weights."""
        model = self.model.adam.tensors | {name: self.model.columns[name] for name in ("level", "bias")}
        networks = {f"network.{name}": tensor for name, tensor in self.networks.state_dict().items()}
        return {name: tensor.detach().cpu().numpy() for name, tensor in (model | networks).items()}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        count = len(arrays["means"])
        for name, ours in self.arrays().items():
            shape = ours.shape if name.startswith("network.") else (count, *ours.shape[1:])
            if arrays[name].shape != shape or arrays[name].dtype != ours.dtype:
                raise ValueError(f"{name} is {arrays[name].shape} of {arrays[name].dtype}, not {shape}")
        rows = {name: torch.from_numpy(arrays[name]) for name in self.model.adam.tensors}
        self.model = self._new_model(rows, *(torch.from_numpy(arrays[name]) for name in ("level", "bias")))
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

    # -- a step ----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        return self.schedule.shrink(step)

    def draw(self, view: TrainingView, step: int) -> list[Drawing]:
        weights = self.schedule.weights(view.camera, self.model, step, full=view.shrink == 1)
        anchors = self.visible(view.camera, weights)
        decoded = self.decode(view.camera, anchors, view.index)
        rendering = self.rasterize_decoded(
            decoded, view.camera, background=self.background(step), outputs=self.outputs
        )
        return [Drawing(rendering, anchors, decoded)]

    def loss(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> torch.Tensor:
        """With the volume of what is drawn (Octree-GS, Sec. 7.1)."""
        scales = drawings[0].decoded.scales / self.data.median_depth
        volume = self.parameters.volume_weight * scales.prod(1).mean()
        return super().loss(drawings, view, step) + volume

    def accumulate_stats(self, drawings: Sequence[Drawing], view: TrainingView, step: int) -> None:
        if not self.schedule.collects_stats(view, step):
            return
        stats, rendering, decoded = self.model.stats, drawings[0].rendering, drawings[0].decoded
        rendering.grad2d /= view.shrink  # as TrainingData.threshold_scale has it for smaller photographs
        seen = rendering.radii > 0
        flat = (decoded.anchor * self.parameters.offsets + decoded.which)[seen]
        stats["gradient_sum"].view(-1)[flat] += rendering.grad2d.norm(dim=1)[seen]
        stats["seen"].view(-1)[flat] += 1
        stats["opacity_sum"].index_add_(0, decoded.anchor, decoded.opacities.detach())
        stats["anchor_seen"][drawings[0].anchors] += 1

    def set_learning_rates(self, step: int) -> None:
        p, share = self.parameters, step / self.steps
        self.model.adam.lr = self.schedule.learning_rates(self._rates, step)
        self.model.adam.lr["offsets"] = log_linear(p.lr_offsets, p.lr_offsets_final, share)
        rates = {
            "opacity": p.lr_network * p.lr_network_final**share,
            "covariance": 2 * p.lr_network,
            "color": 4 * p.lr_network * p.lr_network_final**share,
            "appearance": p.lr_appearance * p.lr_network_final**share,
        }
        for name in self._networks_adam.tensors:
            self._networks_adam.lr[name] = rates[name.split(".")[0]]

    def optimizers(self) -> list[Adam]:
        return [self.model.adam, self._networks_adam]

    def control_density(self, step: int) -> None:
        """An anchor's level is its voxel's, for good; that of its Gaussians is found when they are baked."""
        if self.schedule.grows_after(step):
            self.grow(step)
        if self.schedule.prunes_unseen_after(step):
            self.prune_unseen(step)

    # -- drawing ---------------------------------------------------------------------------------------

    def decode(self, camera: Camera, anchors: torch.Tensor, view: int | None = None) -> NeuralGaussians:
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
        return NeuralGaussians(
            anchor=anchor,
            which=which,
            means=places[index] + model["offsets"][anchor, which] * extents[:, :3],
            quats=looks[:, 3:],
            scales=extents[:, 3:] * looks[:, :3].sigmoid(),
            opacities=opacity[index, which],
            colors=colors,
        )

    def render_image(self, camera: Camera) -> torch.Tensor:
        """What the networks show a camera, (H, W, 3), levels fading as the distance asks."""
        with torch.no_grad():
            weights = fade_weights(self.schedule.wanted(camera, self.model), self.model.columns["level"])
            decoded = self.decode(camera, self.visible(camera, weights))
            return self.rasterize_decoded(decoded, camera, weights[decoded.anchor]).image

    def rasterize_decoded(
        self,
        decoded: NeuralGaussians,
        camera: Camera,
        weights: torch.Tensor | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        outputs: tuple[str, ...] = (),
    ) -> Rendering:
        """What a camera sees of Gaussians, with weights (M,) on their opacities, over a background."""
        return rasterize(
            decoded.gaussians(),
            camera,
            weights=weights,
            near=self.data.near,
            antialias=self.parameters.antialias,
            background=background,
            outputs=outputs,
            backend=self.backend,
        )

    def contributions_of(self, decoded: NeuralGaussians, camera: Camera) -> Contributions:
        """What Gaussians give to the pixels of a view."""
        return contributions(
            decoded.gaussians(),
            [camera],
            near=self.data.near,
            antialias=self.parameters.antialias,
            backend=self.backend,
        )

    def visible(self, camera: Camera, weights: torch.Tensor) -> torch.Tensor:
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

    # -- anchors ---------------------------------------------------------------------------------------

    def _anchors(self, places: torch.Tensor, level: torch.Tensor) -> dict[str, torch.Tensor]:
        """New anchors in the middle of the voxels of places (C, 3), without a feature yet."""
        p, count = self.parameters, len(places)
        size = self.schedule.tree.voxel * 2 ** (1 - level.double()[:, None])
        origin = torch.from_numpy(self.schedule.tree.origin).to(size)
        means = (((places.double() - origin) / size).floor() + 0.5) * size + origin
        rows = {
            "means": means.float(),
            "features": torch.zeros(count, p.features, device=places.device),
            "offsets": torch.zeros(count, p.offsets, 3, device=places.device),
            "log_scales": size.log().float().expand(-1, 6).clone(),
        }
        if p.direct:
            rows["looks"] = torch.zeros(count, p.offsets, LOOKS, device=places.device)
            rows["looks"][..., 0], rows["looks"][..., 4] = growing.FAINT, 1
            rows["offsets"] += self._spread.to(places)
        return rows

    @torch.no_grad()
    def grow(self, step: int) -> None:
        """New anchors in free voxels that Gaussians with large gradients are in; faint ones go.

        New ones have the feature of the Gaussian's anchor, and its looks. Faint are those whose Gaussians'
        opacities add up to too little on average in the views that drew the anchor.
        """
        p, model = self.parameters, self.model
        source, which, level = growing.steep(self.schedule, model, step)
        extents = model["log_scales"][source, :3].exp()
        rows = self._anchors(model["means"][source] + model["offsets"][source, which] * extents, level)
        rows["features"] = model["features"][source].clone()
        if p.direct:
            rows["looks"][..., 1:] = model["looks"][source, which, None, 1:]
        rows |= {"level": level, "bias": model.columns["bias"][source]}
        rows = growing.with_room(self.schedule, model, rows, step, self._most)
        model.keep(model.stats["opacity_sum"] >= p.min_opacity * model.stats["anchor_seen"])
        model.append(rows)
        model.reset_stats()
        require_rows(model, step, "min_opacity")

    @torch.no_grad()
    def prune_unseen(self, step: int) -> None:
        """Gaussians of which no view, near or far, sees much are never drawn again; anchors of none go."""
        poor = growing.unseen(self.schedule, self.model, step, self._largest_weights)
        if self.parameters.direct:
            self.model["looks"][..., 0][poor] = UNDRAWN
        self.model.keep(~poor.all(1))
        require_rows(self.model, step, "least_weight")

    def _largest_weights(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        decoded = self.decode(camera, self.visible(camera, weights), view)
        found = self.contributions_of(decoded, camera)
        largest = torch.zeros(len(weights), self.parameters.offsets, device=self.device)
        largest[decoded.anchor, decoded.which] = found.largest
        return largest

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
        places, columns, terms = (
            self.model["means"],
            self.model.columns,
            harmonics.coefficient_count(p.sh_degree),
        )

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(count, *shape, device=self.device)

        distances = torch.full((len(self.data.train), count), torch.nan, device=self.device)
        for view, camera in enumerate(self.data.train):
            drawn = self.drawn_by(camera)
            eye = torch.as_tensor(camera.center).to(places)
            distances[view, drawn] = (places[drawn] - eye).norm(dim=1)
        median_view = torch.cat([
            (some - some.nanmedian(0).values).abs().nan_to_num(torch.inf).argmin(0)
            for some in distances.split(SOLVED_AT_ONCE, 1)
        ])  # fmt: skip

        means, quats, scales = zeros(p.offsets, 3), zeros(p.offsets, 4), zeros(p.offsets, 3)
        opacities = zeros(p.offsets)
        products, colors = zeros(p.offsets, terms, terms), zeros(p.offsets, terms, 3)
        for view, camera in enumerate(self.data.train):
            g = self.decode(camera, torch.nonzero(~distances[view].isnan())[:, 0])
            x, y, z = normalize(g.means - torch.as_tensor(camera.center).to(places), dim=1).unbind(1)
            basis: list = [None] * terms
            harmonics.basis(x, y, z, p.sh_degree, basis)
            values = torch.stack(basis, 1)
            seen = self.contributions_of(g, camera)
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
        level = growing.fitting_levels(
            self.schedule, columns["level"][anchor], means[kept], log_scales, self.levels
        )
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

    def with_margins(self, baked: Splats) -> Splats:
        """Baked splats with those that continue the photographs, in the coarsest level."""
        if not self.parameters.margin or self.data.transparent:
            return baked
        room = self.parameters.margin_room(self.parameters.max_splats)
        margins = self.margins().extend(Gaussians.of(baked, self.device), room)
        level, bias = np.ones(len(margins), np.uint8), np.zeros(len(margins), np.float32)
        arrays = {name: tensor.cpu().numpy() for name, tensor in vars(margins).items()}
        return Splats.concatenated([baked, Splats(**arrays, extras={"lod_level": level, BIAS: bias})])

    def drawn_by(self, camera: Camera) -> torch.Tensor:
        """The anchors (indices) that a view draws, with all levels joined."""
        weights = fade_weights(self.schedule.wanted(camera, self.model), self.model.columns["level"])
        return self.visible(camera, (weights >= 0.5).float())
