"""Octree-GS (Ren et al. 2024) with neural anchors as in Scaffold-GS (Lu et al. 2024, Sec. 3).

An anchor is at the centre of a voxel, with a feature vector and offsets to its Gaussians. Small networks
compute opacity, covariance and colour of the Gaussians for each view, from the feature and the view
direction. Anchors are baked for Blender and for files, see :meth:`Method.bake`.
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
"""Width of the single hidden layer of each network."""
LOOK_CHANNELS, DISABLED_LOGIT = 11, -30.0
"""Number of look channels before activation (opacity, three scales, quaternion, colour), and the opacity of
Gaussians that are disabled for good."""
REACH_SIGMAS = 3.5
"""Standard deviations by which a Gaussian may reach into the image from outside."""
SOLVE_BATCH = 100_000
"""Number of Gaussians whose colours are solved at a time in baking: a few hundred megabytes."""


@dataclass
class NeuralGaussians:
    """M Gaussians of anchors, decoded for one view.

    Attributes:
        anchor, offset_index: (M,) the anchor of each Gaussian, and its index among the anchor's offsets.
        means, quats, scales, opacities, colors: (M, 3), (M, 4), (M, 3), (M,) and (M, 3).
    """

    anchor: torch.Tensor
    offset_index: torch.Tensor
    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor

    def gaussians(self) -> Gaussians:
        """Convert to the rasterizer's type."""
        logits = self.opacities.clamp(1e-6, 1 - 1e-6).logit()
        return Gaussians(self.means, self.quats, self.scales.clamp_min(1e-12).log(), logits, self.colors)


@dataclass
class NeuralDrawing(method.Drawing):
    """An image of anchors.

    Attributes:
        anchors: (A,) indices of the decoded anchors.
        decoded: their Gaussians.
    """

    anchors: torch.Tensor
    decoded: NeuralGaussians


class Networks(nn.Module):
    """Networks from feature, view direction and (for colour) a view's appearance to the looks of n
    Gaussians.
    """

    def __init__(self, features: int, offsets: int, appearance: int, views: int) -> None:
        super().__init__()

        def network(inputs: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(inputs, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))

        self.opacity = network(features + 3, offsets)
        self.covariance = network(features + 3, 7 * offsets)
        self.color = network(features + 3 + appearance, 3 * offsets)
        self.appearance = nn.Parameter(torch.zeros(views, appearance))


class Method(method.Method[NeuralOctreeParameters, NeuralDrawing]):
    """Training of Octree-GS with neural anchors.

    Attributes:
        schedule: schedule of levels, with the octree.
        networks: networks shared by all anchors.
    """

    def setup(self, base: Splats | None) -> None:
        p, seed = self.parameters, self.seed
        positions = np.random.default_rng(seed).uniform(-0.5, 0.5, (p.offsets, 3))
        self._spread = torch.from_numpy(positions).float()
        """Initial offsets of new anchors' Gaussians within the voxel, used if they have their own looks."""
        self._max_anchors = self.growth_limit(0) // p.offsets
        self.schedule, points, colors, level = growing.create_anchors(self.data, p, seed, self._max_anchors)
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
        """Create a model of anchors; gradient statistics are per Gaussian."""
        count, device = len(level), self.device
        single = {name: torch.zeros(count, device=device) for name in ("opacity_sum", "anchor_seen")}
        per_gaussian = {
            name: torch.zeros(count, self.parameters.offsets, device=device)
            for name in ("gradient_sum", "seen")
        }
        return Model(
            {name: row.to(device) for name, row in rows.items()},
            self._rates,
            columns={"level": level.to(device), "bias": bias.to(device)},
            stats=single | per_gaussian,
        )

    @property
    def levels(self) -> int:
        return self.schedule.tree.levels

    @property
    def splats(self) -> int:
        if not self.parameters.direct:
            return len(self.model) * self.parameters.offsets
        return int((self.model["looks"][..., 0] > DISABLED_LOGIT / 2).sum())

    def level_at(self, step: int) -> int:
        return self.schedule.level_at(step)

    def levels_after(self, step: int) -> list[Level]:
        """Return all levels, baked, when the last one has joined and at the end."""
        if not self.schedule.completes_levels(step):
            return []
        splats = self.add_margins(self.bake())
        level = splats.extras["lod_level"]
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def facts(self) -> dict[str, float]:
        return self.schedule.tree.facts()

    def meta(self) -> dict:
        tree = self.schedule.tree
        return {"voxel": tree.voxel, **super().meta()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return anchors by name, and the networks' weights as ``network.<name>``."""
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

    # -- steps -----------------------------------------------------------------------------------------

    def shrink(self, step: int) -> float:
        return self.schedule.shrink(step)

    def draw(self, view: TrainingView, step: int) -> list[NeuralDrawing]:
        weights = self.schedule.weights(view.camera, self.model, step, full=view.shrink == 1)
        anchors = self.visible_anchors(view.camera, weights)
        decoded = self.decode(view.camera, anchors, view.index)
        rendering = self.rasterize_decoded(
            decoded, view.camera, background=self.background(step), outputs=self.outputs
        )
        return [NeuralDrawing(rendering, anchors, decoded)]

    def loss(self, drawings: Sequence[NeuralDrawing], view: TrainingView, step: int) -> torch.Tensor:
        """Return the loss with volume regularization (Octree-GS, Sec. 7.1)."""
        scales = drawings[0].decoded.scales / self.data.median_depth
        volume = self.parameters.volume_weight * scales.prod(1).mean()
        return super().loss(drawings, view, step) + volume

    def accumulate_stats(self, drawings: Sequence[NeuralDrawing], view: TrainingView, step: int) -> None:
        if not self.schedule.collects_stats(view, step):
            return
        stats, rendering, decoded = self.model.stats, drawings[0].rendering, drawings[0].decoded
        rendering.grad2d /= (
            view.shrink
        )  # thresholds apply to full-size photos, see TrainingData.threshold_scale
        drawn = rendering.radii > 0
        flat = (decoded.anchor * self.parameters.offsets + decoded.offset_index)[drawn]
        stats["gradient_sum"].view(-1)[flat] += rendering.grad2d.norm(dim=1)[drawn]
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
        """Grow and prune anchors; levels of anchors are constant, and those of Gaussians are chosen in
        baking.
        """
        if self.schedule.grows_after(step):
            self.grow(step)
        if self.schedule.prunes_unseen_after(step):
            self.prune_unseen(step)

    # -- drawing ---------------------------------------------------------------------------------------

    def decode(self, camera: Camera, anchors: torch.Tensor, view: int | None = None) -> NeuralGaussians:
        """Decode anchors (indices) for a view; returns only Gaussians of positive opacity.

        Args:
            view: training view whose appearance to use; None for the mean.
        """
        p, model = self.parameters, self.model
        positions = model["means"][anchors].detach()
        center = torch.as_tensor(camera.center).to(positions)
        inputs = torch.cat([model["features"][anchors], normalize(positions - center, dim=1)], 1)
        static_inputs = (
            inputs if p.view_shapes else torch.cat([inputs[:, :-3], torch.zeros_like(inputs[:, -3:])], 1)
        )
        own_looks = model["looks"][anchors] if p.direct else inputs.new_zeros(1, 1, LOOK_CHANNELS)
        opacity = self.networks.opacity(static_inputs) + own_looks[..., 0]
        # tanh as in the paper: Gaussians below 0 are not drawn and get no gradients
        opacity, min_opacity = (opacity.sigmoid(), ALPHA_MIN) if p.direct else (opacity.tanh(), 0.0)
        index, offset_index = torch.nonzero(opacity.detach() > min_opacity).unbind(1)

        looks = (self.networks.covariance(static_inputs).view(-1, p.offsets, 7) + own_looks[..., 1:8])[
            index, offset_index
        ]
        appearance = self.networks.appearance
        appearance = appearance.mean(0) if view is None else appearance[view]
        color_inputs = torch.cat([inputs, appearance.expand(len(inputs), -1)], 1)
        colors = (self.networks.color(color_inputs).view(-1, p.offsets, 3) + own_looks[..., 8:]).sigmoid()[
            index, offset_index
        ]
        anchor = anchors[index]
        extents = model["log_scales"][anchor].exp()
        return NeuralGaussians(
            anchor=anchor,
            offset_index=offset_index,
            means=positions[index] + model["offsets"][anchor, offset_index] * extents[:, :3],
            quats=looks[:, 3:],
            scales=extents[:, 3:] * looks[:, :3].sigmoid(),
            opacities=opacity[index, offset_index],
            colors=colors,
        )

    def render_image(self, camera: Camera) -> torch.Tensor:
        """Render the networks' image for a camera, (H, W, 3), with levels faded by distance."""
        with torch.no_grad():
            weights = fade_weights(
                self.schedule.target_levels(camera, self.model), self.model.columns["level"]
            )
            decoded = self.decode(camera, self.visible_anchors(camera, weights))
            return self.rasterize_decoded(decoded, camera, weights[decoded.anchor]).image

    def rasterize_decoded(
        self,
        decoded: NeuralGaussians,
        camera: Camera,
        weights: torch.Tensor | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        outputs: tuple[str, ...] = (),
    ) -> Rendering:
        """Render Gaussians for a camera, with opacity weights (M,), over a background."""
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
        """Return the contributions of Gaussians to the pixels of a view."""
        return contributions(
            decoded.gaussians(),
            [camera],
            near=self.data.near,
            antialias=self.parameters.antialias,
            backend=self.backend,
        )

    def visible_anchors(self, camera: Camera, weights: torch.Tensor) -> torch.Tensor:
        """Return the anchors (indices) of positive weight whose Gaussians may be in the image."""
        model = self.model
        means, extents = model["means"].detach(), model["log_scales"].detach().exp()
        reach = (model["offsets"].detach() * extents[:, None, :3]).norm(dim=2).amax(1)
        reach = reach + REACH_SIGMAS * extents[:, 3:].amax(1)
        pose = torch.as_tensor(camera.world_to_camera).to(means)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        visible = (weights > 0) & (z + reach > self.data.near)
        for focal, middle, size, across in (
            (camera.fx, camera.cx, camera.width, x), (camera.fy, camera.cy, camera.height, y),
        ):  # fmt: skip
            # inside the two planes through the camera centre and the image's edges
            visible &= focal * across + middle * z > -reach * hypot(focal, middle)
            visible &= focal * across + (middle - size) * z < reach * hypot(focal, middle - size)
        return torch.nonzero(visible)[:, 0]

    # -- anchors ---------------------------------------------------------------------------------------

    def _anchors(self, positions: torch.Tensor, level: torch.Tensor) -> dict[str, torch.Tensor]:
        """Create anchors at the centres of the voxels of positions (C, 3), with zero features."""
        p, count = self.parameters, len(positions)
        size = self.schedule.tree.voxel * 2 ** (1 - level.double()[:, None])
        origin = torch.from_numpy(self.schedule.tree.origin).to(size)
        means = (((positions.double() - origin) / size).floor() + 0.5) * size + origin
        rows = {
            "means": means.float(),
            "features": torch.zeros(count, p.features, device=positions.device),
            "offsets": torch.zeros(count, p.offsets, 3, device=positions.device),
            "log_scales": size.log().float().expand(-1, 6).clone(),
        }
        if p.direct:
            rows["looks"] = torch.zeros(count, p.offsets, LOOK_CHANNELS, device=positions.device)
            rows["looks"][..., 0], rows["looks"][..., 4] = growing.MAX_NEW_LOGIT, 1
            rows["offsets"] += self._spread.to(positions)
        return rows

    @torch.no_grad()
    def grow(self, step: int) -> None:
        """Add anchors in free voxels that contain Gaussians with large gradients, and remove faint anchors.

        New anchors copy the feature of the Gaussian's anchor, and the Gaussian's look. An anchor is faint
        if the sum of its Gaussians' opacities, averaged over the views that drew it, is too low.
        """
        p, model = self.parameters, self.model
        source, offset_index, level = growing.select_growth(self.schedule, model, step)
        extents = model["log_scales"][source, :3].exp()
        rows = self._anchors(model["means"][source] + model["offsets"][source, offset_index] * extents, level)
        rows["features"] = model["features"][source].clone()
        if p.direct:
            rows["looks"][..., 1:] = model["looks"][source, offset_index, None, 1:]
        rows |= {"level": level, "bias": model.columns["bias"][source]}
        rows = growing.limit_growth(self.schedule, model, rows, step, self._max_anchors)
        model.keep(model.stats["opacity_sum"] >= p.min_opacity * model.stats["anchor_seen"])
        model.append(rows)
        model.reset_stats()
        require_rows(model, step, "min_opacity")

    @torch.no_grad()
    def prune_unseen(self, step: int) -> None:
        """Disable Gaussians of low weight in all views, near or far; remove anchors without enabled ones."""
        low_weight = growing.find_unseen(self.schedule, self.model, step, self._largest_weights)
        if self.parameters.direct:
            self.model["looks"][..., 0][low_weight] = DISABLED_LOGIT
        self.model.keep(~low_weight.all(1))
        require_rows(self.model, step, "least_weight")

    def _largest_weights(self, camera: Camera, view: int, weights: torch.Tensor) -> torch.Tensor:
        decoded = self.decode(camera, self.visible_anchors(camera, weights), view)
        contribution = self.contributions_of(decoded, camera)
        largest = torch.zeros(len(weights), self.parameters.offsets, device=self.device)
        largest[decoded.anchor, decoded.offset_index] = contribution.largest
        return largest

    # -- baking ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def bake(self) -> Splats:
        """Convert the anchors to Gaussians without networks, with their anchor's bias and a matching level.

        Opacity and covariance come from the median view, by distance, of the training views that draw the
        anchor. The colour is a least-squares fit of spherical harmonics to the networks' colours in all
        these views, with the mean appearance, weighted by visibility. Gaussians without opacity in the
        median view are dropped.
        """
        p, count = self.parameters, len(self.model)
        positions, columns, terms = (
            self.model["means"],
            self.model.columns,
            harmonics.coefficient_count(p.sh_degree),
        )

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(count, *shape, device=self.device)

        distances = torch.full((len(self.data.train), count), torch.nan, device=self.device)
        for view, camera in enumerate(self.data.train):
            drawn = self.drawn_anchors(camera)
            center = torch.as_tensor(camera.center).to(positions)
            distances[view, drawn] = (positions[drawn] - center).norm(dim=1)
        median_view = torch.cat([
            (part - part.nanmedian(0).values).abs().nan_to_num(torch.inf).argmin(0)
            for part in distances.split(SOLVE_BATCH, 1)
        ])  # fmt: skip

        means, quats, scales = zeros(p.offsets, 3), zeros(p.offsets, 4), zeros(p.offsets, 3)
        opacities = zeros(p.offsets)
        products, colors = zeros(p.offsets, terms, terms), zeros(p.offsets, terms, 3)
        for view, camera in enumerate(self.data.train):
            g = self.decode(camera, torch.nonzero(~distances[view].isnan())[:, 0])
            x, y, z = normalize(g.means - torch.as_tensor(camera.center).to(positions), dim=1).unbind(1)
            basis: list = [None] * terms
            harmonics.basis(x, y, z, p.sh_degree, basis)
            values = torch.stack(basis, 1)
            contribution = self.contributions_of(g, camera)
            # a small weight gives Gaussians that are hidden in every view a colour, too
            weighted = values * (contribution.largest + 1e-3 * g.opacities)[:, None]
            products[g.anchor, g.offset_index] += weighted[:, :, None] * values[:, None]
            colors[g.anchor, g.offset_index] += weighted[:, :, None] * (g.colors - 0.5)[:, None]
            is_median = median_view[g.anchor] == view
            target = g.anchor[is_median], g.offset_index[is_median]
            means[target], quats[target], scales[target] = (
                g.means[is_median],
                g.quats[is_median],
                g.scales[is_median],
            )
            opacities[target] = g.opacities[is_median]
        visible = opacities > 0
        anchor, offset_index = torch.nonzero(visible).unbind(1)
        # a few directions do not determine the higher harmonics, so pull them to zero
        ridge = torch.full((terms,), p.bake_ridge, device=self.device).double()
        ridge[0] *= 1e-3
        coefficients = []
        for part in torch.arange(len(anchor), device=self.device).split(SOLVE_BATCH):
            product = products[anchor[part], offset_index[part]].double()
            product += ridge.diag() * (product[:, :1, :1] / SH_C0**2)
            coefficients.append(
                torch.linalg.solve(product, colors[anchor[part], offset_index[part]].double()).float()
            )
        log_scales = scales[visible].clamp_min(1e-12).log()
        level = growing.matching_levels(
            self.schedule, columns["level"][anchor], means[visible], log_scales, self.levels
        )
        return Splats(
            means=means[visible].cpu().numpy(),
            quats=quats[visible].cpu().numpy(),
            log_scales=log_scales.cpu().numpy(),
            opacity_logits=opacities[visible].clamp(1e-6, 1 - 1e-6).logit().cpu().numpy(),
            sh=torch.cat(coefficients).cpu().numpy(),
            extras={
                "lod_level": level.cpu().numpy().astype(np.uint8),
                BIAS: columns["bias"][anchor].cpu().numpy(),
            },
        )

    def add_margins(self, baked: Splats) -> Splats:
        """Add margin splats to baked splats, in the coarsest level."""
        if not self.parameters.margin or self.data.transparent:
            return baked
        room = self.parameters.margin_room(self.parameters.max_splats)
        margins = self.margins().extend(Gaussians.of(baked, self.device), room)
        level, bias = np.ones(len(margins), np.uint8), np.zeros(len(margins), np.float32)
        arrays = {name: tensor.cpu().numpy() for name, tensor in vars(margins).items()}
        return Splats.concatenated([baked, Splats(**arrays, extras={"lod_level": level, BIAS: bias})])

    def drawn_anchors(self, camera: Camera) -> torch.Tensor:
        """Return the anchors (indices) that a view draws once all levels have joined."""
        weights = fade_weights(self.schedule.target_levels(camera, self.model), self.model.columns["level"])
        return self.visible_anchors(camera, (weights >= 0.5).float())
