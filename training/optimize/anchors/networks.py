"""Neural anchors as in Scaffold-GS (Lu et al. 2024, Sec. 3).

An anchor has a feature vector and offsets to its Gaussians. Small networks compute opacity, covariance and
colour of the Gaussians for each view, from the feature and the view direction.

A model of neural anchors has the tensors ``means`` (N, 3), ``features`` (N, F), ``offsets`` (N, n, 3) in
units of the extents, ``log_scales`` (N, 6) of extents and Gaussians, and, if Gaussians have looks of their
own, ``looks`` (N, n, LOOK_CHANNELS).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

import torch
from torch import nn
from torch.nn.functional import normalize

from ...rasterize import Contributions, Gaussians, Rendering, contributions, rasterize
from ...rasterize.rendering import ALPHA_MIN
from ...scenes.cameras import Camera
from ..model import Model

HIDDEN = 32
"""Width of the single hidden layer of each network."""
LOOK_CHANNELS = 11
"""Number of look channels before activation: opacity, three scales, quaternion and colour."""
REACH_SIGMAS = 3.5
"""Standard deviations by which a Gaussian may reach into the image from outside."""


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


@dataclass(frozen=True)
class AnchorDecoder:
    """Decoding of anchors into Gaussians of a view, and rendering of these.

    Attributes:
        networks: networks shared by all anchors.
        direct: add the networks' output to looks of the Gaussians' own.
        view_shapes: let opacity and covariance depend on the view direction.
        near: near plane, in scene units.
        antialias, backend: see ``rasterize``.
        min_scale: FLoD's minimum standard deviation of Gaussians, added to their scales (FLoD, Eq. 4).
        rendered_views: training views whose mean appearance renders use; empty for all.
    """

    networks: Networks
    direct: bool
    view_shapes: bool
    near: float
    antialias: bool
    backend: str
    min_scale: float = 0.0
    rendered_views: tuple[int, ...] = ()

    def decode(
        self, model: Model, camera: Camera, anchors: torch.Tensor, view: int | None = None
    ) -> NeuralGaussians:
        """Decode anchors (indices) for a view; return only Gaussians of positive opacity.

        Args:
            view: training view whose appearance to use; None for that of renders.
        """
        count = model["offsets"].shape[1]
        positions = model["means"][anchors].detach()
        center = torch.as_tensor(camera.center).to(positions)
        inputs = torch.cat([model["features"][anchors], normalize(positions - center, dim=1)], 1)
        static_inputs = inputs
        if not self.view_shapes:
            static_inputs = torch.cat([inputs[:, :-3], torch.zeros_like(inputs[:, -3:])], 1)
        own_looks = model["looks"][anchors] if self.direct else inputs.new_zeros(1, 1, LOOK_CHANNELS)
        opacity = self.networks.opacity(static_inputs) + own_looks[..., 0]
        # tanh as in the paper: Gaussians below 0 are not drawn and get no gradients
        opacity, min_opacity = (opacity.sigmoid(), ALPHA_MIN) if self.direct else (opacity.tanh(), 0.0)
        index, offset_index = torch.nonzero(opacity.detach() > min_opacity).unbind(1)

        looks = self.networks.covariance(static_inputs).view(-1, count, 7) + own_looks[..., 1:8]
        looks = looks[index, offset_index]
        views = self.rendered_views if view is None else (view,)
        appearance = self.networks.appearance[list(views) if views else slice(None)].mean(0)
        color_inputs = torch.cat([inputs, appearance.expand(len(inputs), -1)], 1)
        colors = self.networks.color(color_inputs).view(-1, count, 3) + own_looks[..., 8:]
        anchor = anchors[index]
        extents = model["log_scales"][anchor].exp()
        return NeuralGaussians(
            anchor=anchor,
            offset_index=offset_index,
            means=positions[index] + model["offsets"][anchor, offset_index] * extents[:, :3],
            quats=looks[:, 3:],
            scales=extents[:, 3:] * looks[:, :3].sigmoid() + self.min_scale,
            opacities=opacity[index, offset_index],
            colors=colors.sigmoid()[index, offset_index],
        )

    @torch.no_grad()
    def relative_scales(self, model: Model) -> torch.Tensor:
        """Return the scales (N, n, 3) of all Gaussians as fractions of their anchor's, without direction."""
        features = model["features"]
        inputs = torch.cat([features, features.new_zeros(len(features), 3)], 1)
        looks = self.networks.covariance(inputs).view(*model["offsets"].shape[:2], 7)[..., :3]
        return (looks + model["looks"][..., 1:4] if self.direct else looks).sigmoid()

    def visible_anchors(self, model: Model, camera: Camera, weights: torch.Tensor) -> torch.Tensor:
        """Return the anchors (indices) of positive weight whose Gaussians may be in the image."""
        means, extents = model["means"].detach(), model["log_scales"].detach().exp()
        reach = (model["offsets"].detach() * extents[:, None, :3]).norm(dim=2).amax(1)
        reach = reach + REACH_SIGMAS * (extents[:, 3:].amax(1) + self.min_scale)
        pose = torch.as_tensor(camera.world_to_camera).to(means)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        visible = (weights > 0) & (z + reach > self.near)
        for focal, middle, size, across in (
            (camera.fx, camera.cx, camera.width, x), (camera.fy, camera.cy, camera.height, y),
        ):  # fmt: skip
            # inside the two planes through the camera centre and the image's edges
            visible &= focal * across + middle * z > -reach * hypot(focal, middle)
            visible &= focal * across + (middle - size) * z < reach * hypot(focal, middle - size)
        return torch.nonzero(visible)[:, 0]

    def rasterize(
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
            near=self.near,
            antialias=self.antialias,
            background=background,
            outputs=outputs,
            backend=self.backend,
        )

    def contributions(self, decoded: NeuralGaussians, camera: Camera) -> Contributions:
        """Return the contributions of Gaussians to the pixels of a view."""
        return contributions(
            decoded.gaussians(), [camera], near=self.near, antialias=self.antialias, backend=self.backend
        )
