"""Baking of neural anchors: Gaussians without networks, for files and other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch.nn.functional import normalize

from ...scenes.cameras import Camera
from ...splats import sh as harmonics
from ...splats.gaussians import SH_C0, Splats
from ..model import Model
from .networks import AnchorDecoder, NeuralGaussians

SOLVE_BATCH = 100_000
"""Number of Gaussians whose colours are solved at a time: a few hundred megabytes."""


@dataclass
class BakedGaussians:
    """M Gaussians without networks.

    Attributes:
        anchor: (M,) the anchor of each Gaussian.
        means, log_scales, quats, opacities: (M, 3), (M, 3), (M, 4) and (M,).
        sh: (M, K, 3) harmonics.
    """

    anchor: torch.Tensor
    means: torch.Tensor
    log_scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor

    def splats(self) -> Splats:
        """Convert to arrays."""
        return Splats(
            means=self.means.cpu().numpy(),
            quats=self.quats.cpu().numpy(),
            log_scales=self.log_scales.cpu().numpy(),
            opacity_logits=self.opacities.clamp(1e-6, 1 - 1e-6).logit().cpu().numpy(),
            sh=self.sh.cpu().numpy(),
        )


@torch.no_grad()
def bake(
    model: Model,
    decoder: AnchorDecoder,
    cameras: Sequence[Camera],
    drawn_anchors: Callable[[Camera], torch.Tensor],
    sh_degree: int,
    ridge: float,
) -> BakedGaussians:
    """Convert anchors to Gaussians.

    Opacity and covariance come from the median view, by distance, of the views that draw the anchor. The
    colour is a least-squares fit of spherical harmonics to the networks' colours in all these views, with
    the mean appearance, weighted by visibility. Gaussians without opacity in the median view are dropped.

    Args:
        cameras: training views.
        drawn_anchors: function that returns the anchors (indices) that a view draws.
        sh_degree: degree of the harmonics.
        ridge: ridge regularization of the higher harmonics.
    """
    count, offsets = model["offsets"].shape[:2]
    terms, device = harmonics.coefficient_count(sh_degree), model["means"].device
    distances = _view_distances(model["means"], cameras, drawn_anchors)
    median_view = _median_views(distances)
    shapes = {
        name: torch.zeros(count, offsets, *shape, device=device)
        for name, shape in {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}.items()
    }
    products = torch.zeros(count, offsets, terms, terms, device=device)
    colors = torch.zeros(count, offsets, terms, 3, device=device)
    for view, camera in enumerate(cameras):
        g = decoder.decode(model, camera, torch.nonzero(~distances[view].isnan())[:, 0])
        values = _basis(g, camera, sh_degree)
        contribution = decoder.contributions(g, camera)
        # a small weight gives Gaussians that are hidden in every view a colour, too
        weighted = values * (contribution.largest + 1e-3 * g.opacities)[:, None]
        products[g.anchor, g.offset_index] += weighted[:, :, None] * values[:, None]
        colors[g.anchor, g.offset_index] += weighted[:, :, None] * (g.colors - 0.5)[:, None]
        is_median = median_view[g.anchor] == view
        for name, shape in shapes.items():
            shape[g.anchor[is_median], g.offset_index[is_median]] = getattr(g, name)[is_median]
    visible = shapes["opacities"] > 0
    return BakedGaussians(
        anchor=torch.nonzero(visible)[:, 0],
        means=shapes["means"][visible],
        log_scales=shapes["scales"][visible].clamp_min(1e-12).log(),
        quats=shapes["quats"][visible],
        opacities=shapes["opacities"][visible],
        sh=_solve(products, colors, visible, ridge),
    )


def _view_distances(
    positions: torch.Tensor, cameras: Sequence[Camera], drawn_anchors: Callable[[Camera], torch.Tensor]
) -> torch.Tensor:
    """Return the distances (V, N) of anchors from the cameras, NaN where a view does not draw the anchor."""
    distances = torch.full((len(cameras), len(positions)), torch.nan, device=positions.device)
    for view, camera in enumerate(cameras):
        drawn = drawn_anchors(camera)
        center = torch.as_tensor(camera.center).to(positions)
        distances[view, drawn] = (positions[drawn] - center).norm(dim=1)
    return distances


def _median_views(distances: torch.Tensor) -> torch.Tensor:
    """Return the view (N,) of median distance of each anchor, from distances (V, N)."""
    return torch.cat([
        (part - part.nanmedian(0).values).abs().nan_to_num(torch.inf).argmin(0)
        for part in distances.split(SOLVE_BATCH, 1)
    ])  # fmt: skip


def _basis(gaussians: NeuralGaussians, camera: Camera, sh_degree: int) -> torch.Tensor:
    """Return the harmonics (M, K) in the view directions of Gaussians."""
    center = torch.as_tensor(camera.center).to(gaussians.means)
    x, y, z = normalize(gaussians.means - center, dim=1).unbind(1)
    basis: list = [None] * harmonics.coefficient_count(sh_degree)
    harmonics.basis(x, y, z, sh_degree, basis)
    return torch.stack(basis, 1)


def _solve(products: torch.Tensor, colors: torch.Tensor, visible: torch.Tensor, ridge: float) -> torch.Tensor:
    """Solve the normal equations (N, n, K, K) and (N, n, K, 3) of visible Gaussians, M of (N, n)."""
    terms, device = products.shape[-1], products.device
    anchor, offset_index = torch.nonzero(visible).unbind(1)
    # a few directions do not determine the higher harmonics, so pull them to zero
    pull = torch.full((terms,), ridge, device=device).double()
    pull[0] *= 1e-3
    coefficients = []
    for part in torch.arange(len(anchor), device=device).split(SOLVE_BATCH):
        product = products[anchor[part], offset_index[part]].double()
        product += pull.diag() * (product[:, :1, :1] / SH_C0**2)
        color = colors[anchor[part], offset_index[part]].double()
        coefficients.append(torch.linalg.solve(product, color).float())
    return torch.cat(coefficients)
