"""Octree-GS (Ren et al. 2024) with neural anchors as in Scaffold-GS (Lu et al. 2024, Sec. 3).

Anchors are at the centres of voxels. Their networks are trained (``optimize.anchors.networks``), and baked
for Blender and for files (``optimize.anchors.baking``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ...documents import quote
from ...errors import LodgsError
from ...lod.rules.octree import BIAS, fade_weights
from ...optimize import method
from ...optimize.anchors import growing
from ...optimize.anchors.baking import bake
from ...optimize.anchors.networks import LOOK_CHANNELS, AnchorDecoder, Networks, NeuralGaussians
from ...optimize.density_control import require_rows
from ...optimize.model import Model
from ...optimize.schedules import log_linear
from ...optimize.training_data import TrainingView
from ...rasterize import Adam, Gaussians, Rendering
from ...rasterize.adam import LearningRate
from ...scenes.cameras import Camera
from ...splats.gaussians import Splats
from ...splats.levels import Level
from . import NeuralOctreeParameters

DISABLED_LOGIT = -30.0
"""Opacity logit of Gaussians that are disabled until the end."""


@dataclass
class NeuralDrawing(method.Drawing):
    """An image of anchors.

    Attributes:
        anchors: (A,) indices of the decoded anchors.
        decoded: their Gaussians.
    """

    anchors: torch.Tensor
    decoded: NeuralGaussians

    def accumulate_stats(self, model: Model, shrink: float) -> None:
        """Add the statistics of Gaussians and anchors, after ``backward``."""
        stats, rendering, decoded = model.stats, self.rendering, self.decoded
        rendering.grad2d /= shrink  # thresholds apply to full-size photos, see TrainingData.threshold_scale
        drawn = rendering.radii > 0
        flat = (decoded.anchor * model["offsets"].shape[1] + decoded.offset_index)[drawn]
        stats["gradient_sum"].view(-1)[flat] += rendering.grad2d.norm(dim=1)[drawn]
        stats["seen"].view(-1)[flat] += 1
        stats["opacity_sum"].index_add_(0, decoded.anchor, decoded.opacities.detach())
        stats["anchor_seen"][self.anchors] += 1


class Method(method.Method[NeuralOctreeParameters, NeuralDrawing]):
    """Training of Octree-GS with neural anchors.

    Attributes:
        schedule: schedule of levels, with the octree.
        networks: networks shared by all anchors.
        decoder: decoding of anchors with these networks.
        min_voxel: minimum edge of level 1's voxels, in scene units.
    """

    min_voxel = 0.0

    def setup(self, base: Splats | None) -> None:
        p, seed = self.parameters, self.seed
        positions = np.random.default_rng(seed).uniform(-0.5, 0.5, (p.offsets, 3))
        self._spread = torch.from_numpy(positions).float()
        """Initial offsets of new anchors' Gaussians within the voxel, used if they have their own looks."""
        self.image_model = self
        self._rates: dict[str, LearningRate] = {
            "means": 0.0,
            "features": p.lr_features,
            "offsets": p.lr_offsets,
            "log_scales": p.lr_scales,
        }
        if p.direct:
            self._rates["looks"] = p.lr_looks * torch.tensor([5.0] + [1.0] * 3 + [0.2] * 4 + [1.0] * 3)
        rows = self.start_anchors()
        level = rows.pop("level")
        self.levels = self.schedule.tree.levels
        self.facts = self.schedule.tree.facts()
        self.model = self._new_model(rows, level, torch.zeros(len(level)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.networks = Networks(p.features, p.offsets, p.appearance, len(self.data.train)).to(
                self.device
            )
        self.restart_networks_adam()
        self.decoder = AnchorDecoder(
            self.networks,
            p.direct,
            p.view_shapes,
            self.data.near,
            p.antialias,
            self.backend,
        )
        if p.appearance_of:
            self.use_appearance([p.appearance_of])

    def restart_networks_adam(self) -> None:
        """Give the networks a new optimizer."""
        names = {name: tensor for name, tensor in self.networks.named_parameters() if tensor.numel()}
        self._networks_adam = Adam(names, dict.fromkeys(names, 0.0))
        self.extra_optimizers = [self._networks_adam]

    def use_appearance(self, photos: Sequence[str]) -> None:
        """Render and bake with the mean appearance of training photos (Sec. 7.2, Fig. 10)."""
        names = [camera.name for camera in self.data.train]
        if not self.parameters.appearance:
            raise LodgsError(
                "Cannot choose an appearance: the photos have no appearance vectors.",
                "Train again with appearance=32.",
            )
        for name in photos:
            if name not in names:
                raise LodgsError(
                    f"Cannot use the appearance of {quote(name)}: no training photo has this name.",
                    f"Name one of them, such as {quote(names[0])}.",
                )
        self.decoder = replace(self.decoder, rendered_views=tuple(names.index(name) for name in photos))

    def start_anchors(self) -> dict[str, torch.Tensor]:
        """Build the octree and its schedule; return anchors at the scene's points, and their ``level``."""
        p = self.parameters
        self._max_anchors = p.growth_limit(p.splat_limit) // p.offsets
        self.schedule, points, colors, level = growing.create_anchors(
            self.data, p, self.seed, self._max_anchors, self.min_voxel
        )
        rows = self._anchors(torch.from_numpy(points).float(), torch.from_numpy(level))
        rows["log_scales"] = growing.log_spacing(points, level, columns=6)
        if p.direct:
            rows["looks"][..., 8:] = torch.from_numpy(colors / 255.0).clamp(0.01, 0.99).logit()[:, None]
        return rows | {"level": torch.from_numpy(level).float()}

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
        splats = self.with_margins(self.bake())
        level = splats.extras["lod_level"]
        return [Level(number, splats.select(level == number)) for number in range(1, self.levels + 1)]

    def meta(self) -> dict:
        tree = self.schedule.tree
        return {"voxel": tree.voxel, **super().meta()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return anchors by name, and the networks' weights as ``network.<name>``."""
        model = self.model.adam.tensors | {name: self.model.columns[name] for name in ("level", "bias")}
        networks = {f"network.{name}": tensor for name, tensor in self.networks.state_dict().items()}
        return {name: tensor.detach().cpu().numpy() for name, tensor in (model | networks).items()}

    def load_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the result of :meth:`arrays`. Invalid arrays leave the model unchanged.

        Raises:
            KeyError, ValueError: an array is missing, or has another shape or type.
        """
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
        anchors = self.decoder.visible_anchors(self.model, view.camera, weights)
        decoded = self.decoder.decode(self.model, view.camera, anchors, view.index)
        rendering = self.decoder.rasterize(
            decoded, view.camera, background=self.background(step), outputs=self.depth_loss.outputs
        )
        return [NeuralDrawing(rendering, anchors, decoded)]

    def collects_stats(self, view: TrainingView, step: int) -> bool:
        return self.schedule.collects_stats(view, step)

    def loss(self, drawings: Sequence[NeuralDrawing], view: TrainingView, step: int) -> torch.Tensor:
        """Return the loss with volume regularization (Octree-GS, Sec. 7.1)."""
        scales = drawings[0].decoded.scales / self.data.median_depth
        volume = self.parameters.volume_weight * growing.mean_volume(scales)
        return super().loss(drawings, view, step) + volume

    def set_learning_rates(self, step: int) -> None:
        p, share = self.parameters, step / self.parameters.steps
        self.model.adam.lr = self.schedule.learning_rates(self._rates, step)
        self.model.adam.lr["offsets"] = log_linear(p.lr_offsets, p.lr_offsets_final, share)
        if p.scale_offset_rate:
            self.model.adam.lr["offsets"] *= self.data.extent
        rates = {
            "opacity": p.lr_network * p.lr_network_final**share,
            "covariance": 2 * p.lr_network,
            "color": 4 * p.lr_network * p.lr_network_final**share,
            "appearance": p.lr_appearance * p.lr_network_final**share,
        }
        for name in self._networks_adam.tensors:
            self._networks_adam.lr[name] = rates[name.split(".")[0]]

    def control_density(self, step: int) -> None:
        """Grow and prune anchors; levels of anchors are constant, and those of Gaussians are chosen in
        baking.
        """
        if self.schedule.grows_after(step):
            self.grow(step)
        if self.schedule.prunes_unseen_after(step):
            self.prune_unseen(step)

    # -- drawing ---------------------------------------------------------------------------------------

    def render(self, camera: Camera) -> Rendering:
        """Render the Gaussians that the networks decode for a camera, with levels faded by distance."""
        with torch.no_grad():
            weights = self._fade_weights(camera)
            anchors = self.decoder.visible_anchors(self.model, camera, weights)
            decoded = self.decoder.decode(self.model, camera, anchors)
            return self.decoder.rasterize(decoded, camera, weights[decoded.anchor])

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
        views = p.success_threshold * p.grow_interval
        drawn = model.stats["anchor_seen"]
        ready = model.stats["seen"] > views / 2 if views else None
        source, offset_index, level = growing.select_growth(self.schedule, model, step, ready)
        extents = model["log_scales"][source, :3].exp()
        rows = self._anchors(model["means"][source] + model["offsets"][source, offset_index] * extents, level)
        rows["features"] = model["features"][source].clone()
        if p.direct:
            rows["looks"][..., 1:] = model["looks"][source, offset_index, None, 1:]
        rows |= {"level": level} if views else {"level": level, "bias": model.columns["bias"][source]}
        rows = growing.limit_growth(self.schedule, model, rows, step, self._max_anchors)
        faint = model.stats["opacity_sum"] < p.min_opacity * drawn
        if ready is None:
            model.reset_stats()
        else:
            decided = drawn > views
            faint &= decided
            for name in ("gradient_sum", "seen"):
                model.stats[name][ready] = 0
            for name in ("opacity_sum", "anchor_seen"):
                model.stats[name][decided] = 0
        model.keep(~faint)
        model.append(rows)
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
        anchors = self.decoder.visible_anchors(self.model, camera, weights)
        decoded = self.decoder.decode(self.model, camera, anchors, view)
        contribution = self.decoder.contributions(decoded, camera)
        largest = torch.zeros(len(weights), self.parameters.offsets, device=self.device)
        largest[decoded.anchor, decoded.offset_index] = contribution.largest
        return largest

    # -- baking ----------------------------------------------------------------------------------------

    def bake(self) -> Splats:
        """Bake the anchors, with their anchor's bias and a matching level."""
        p, columns = self.parameters, self.model.columns
        baked = bake(self.model, self.decoder, self.data.train, self.drawn_anchors, p.sh_degree, p.bake_ridge)
        level = growing.matching_levels(
            self.schedule, columns["level"][baked.anchor], baked.means, baked.log_scales, self.levels
        )
        splats = baked.splats()
        splats.extras = {
            "lod_level": level.cpu().numpy().astype(np.uint8),
            BIAS: columns["bias"][baked.anchor].cpu().numpy(),
        }
        return splats

    def with_margins(self, baked: Splats) -> Splats:
        """Add margin splats to baked splats, in the coarsest level."""
        room = self.parameters.margin_room(self.parameters.splat_limit)
        margins = self.margins.extend(Gaussians.of(baked, self.device), room)
        level, bias = np.ones(len(margins), np.uint8), np.zeros(len(margins), np.float32)
        arrays = {name: tensor.cpu().numpy() for name, tensor in vars(margins).items()}
        return Splats.concatenated([baked, Splats(**arrays, extras={"lod_level": level, BIAS: bias})])

    def drawn_anchors(self, camera: Camera) -> torch.Tensor:
        """Return the anchors (indices) that a view draws once all levels have joined."""
        drawn = (self._fade_weights(camera) >= 0.5).float()
        return self.decoder.visible_anchors(self.model, camera, drawn)

    def _fade_weights(self, camera: Camera) -> torch.Tensor:
        """Return the rule's weights (N,) of all anchors."""
        return fade_weights(self.schedule.target_levels(camera, self.model), self.model.columns["level"])
