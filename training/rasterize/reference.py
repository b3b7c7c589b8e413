"""The definition: splatting and the photometric loss in plain torch, in any float type.

EWA splatting as in "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023), Eq. 3
to 6, every splat against every pixel: memory grows with their product, so this is for small pictures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch.nn.functional import conv2d, normalize

from ..editing.bake_filter import MIP_VARIANCE
from ..splats import sh as harmonics
from .features import rotation_matrices
from .gaussians import Gaussians
from .rendering import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION,
    TRANSMITTANCE_MIN,
    BackendOutput,
    KernelCamera,
    RasterSettings,
    Target,
)

Moments = tuple[torch.Tensor, torch.Tensor]


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`."""
    means, view = gaussians.means, settings.view
    kind = {"dtype": means.dtype, "device": means.device}
    weights = settings.weights(weights, gaussians.means)
    seen = ellipses(gaussians, weights, settings)
    drawn, mean2d, (xx, xy, yy), opacity = seen.drawn, seen.mean2d, seen.covariance, seen.opacity
    grad2d = torch.zeros(len(means), 2, dtype=torch.float32, device=means.device)
    absgrad2d = torch.zeros_like(grad2d) if settings.absolute else None
    to_ndc = torch.tensor([view.width / 2, view.height / 2], **kind)

    def keep_gradient(gradient: torch.Tensor) -> None:
        grad2d[drawn] = (gradient * to_ndc).float()

    if mean2d.requires_grad:
        mean2d.register_hook(keep_gradient)

    values: list = [None] * harmonics.coefficient_count(settings.degree)
    x, y, z = normalize(means[drawn] - torch.as_tensor(view.eye, **kind), dim=1).unbind(1)
    harmonics.basis(x, y, z, settings.degree, values)
    colour = (
        (torch.stack(values, 1)[:, :, None] * gaussians.sh[drawn, : len(values)]).sum(1).add(0.5).clamp_min(0)
    )

    order = seen.depth.argsort(stable=True)
    offsets = pixel_offsets(mean2d[order], view)
    hidden = None if settings.limit is None else seen.depth[order][:, None, None] > settings.limit
    weight, transmittance = blend(offsets, xx[order], xy[order], yy[order], opacity[order], hidden)
    image = torch.einsum("nhw,nc->hwc", weight, colour[order])
    image = image + transmittance[..., None] * torch.tensor(settings.background, **kind)
    if settings.absolute:  # features have no part in absgrad2d, so their gradient takes a way of its own
        offsets_again = pixel_offsets(mean2d[order], view)
        weight, _ = blend(offsets_again, xx[order], xy[order], yy[order], opacity[order], hidden)
    blended = torch.einsum("nhw,nc->hwc", weight, features[drawn[order]])
    if absgrad2d is not None and mean2d.requires_grad:
        for axis, offset in enumerate(offsets):

            def keep_absolute(gradient: torch.Tensor, axis: int = axis) -> None:
                absgrad2d[drawn[order], axis] = (gradient.abs().sum((1, 2)) * to_ndc[axis]).float()

            offset.register_hook(keep_absolute)
    counts = tile_counts(seen, view)
    middle = None
    if settings.median:
        left = 1 - weight.detach().cumsum(0)  # the transmittance, as Σ w = 1 - T
        past = (left <= 0.5).to(torch.int32)
        splats = torch.cat([drawn[order], drawn.new_tensor([-1])])
        none = past.new_ones(1, view.height, view.width)
        middle = splats[torch.cat([past, none]).argmax(0)].int()
    return BackendOutput(image, 1 - transmittance, seen.radii, grad2d, counts, absgrad2d, blended, middle)


class Ellipses(NamedTuple):
    """The n splats in front of a camera as ellipses on its image.

    Attributes:
        drawn: (n,) int64, which splats they are.
        depth: (n,) along the camera's z axis.
        mean2d, covariance, determinant: see :func:`project`.
        opacity: (n,), with weights and the antialiasing's loss in it.
        inside: (n,) bool, where the ellipse alpha = ALPHA_MIN meets the image.
        radii: (N,) float32 of all splats, as ``Rendering.radii``.
    """

    drawn: torch.Tensor
    depth: torch.Tensor
    mean2d: torch.Tensor
    covariance: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    determinant: torch.Tensor
    opacity: torch.Tensor
    inside: torch.Tensor
    radii: torch.Tensor


def ellipses(gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings) -> Ellipses:
    """Which splats a camera sees, and where: differentiable in all but what is inside."""
    means, view = gaussians.means, settings.view
    rotation, translation = (
        torch.as_tensor(v, dtype=means.dtype, device=means.device) for v in (view.rotation, view.translation)
    )
    opacity = torch.sigmoid(gaussians.opacity_logits)
    opacity = opacity if weights is None else opacity * weights
    with torch.no_grad():
        depth = means @ rotation[2] + translation[2]
        drawn = ((depth > view.near) & (opacity > ALPHA_MIN)).nonzero()[:, 0]
    position = means[drawn] @ rotation.T + translation
    opacity = opacity[drawn]
    scales = gaussians.log_scales[drawn].exp() + settings.min_scale
    half_covariance = rotation @ rotation_matrices(gaussians.quats[drawn]) * scales[:, None]
    each = torch.as_tensor(settings.antialias, device=means.device).expand(len(means))[drawn]
    dilation = torch.where(each, means.new_tensor(MIP_VARIANCE), means.new_tensor(DILATION))
    mean2d, covariance, determinant, area = project(position, half_covariance, view, dilation)
    opacity = torch.where(each, opacity * area, opacity)
    with torch.no_grad():
        xx, xy, yy = covariance
        # where alpha falls to its minimum: sigma² = 2 ln(opacity / minimum), along x and along y
        reach = squared_reach(opacity).sqrt()
        half_width, half_height = reach * xx.sqrt(), reach * yy.sqrt()
        inside = (mean2d[:, 0] + half_width > 0) & (mean2d[:, 0] - half_width < view.width)
        inside &= opacity > ALPHA_MIN
        inside &= (mean2d[:, 1] + half_height > 0) & (mean2d[:, 1] - half_height < view.height)
        longest = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy**2).sqrt()
        radii = torch.zeros(len(means), dtype=torch.float32, device=means.device)
        radii[drawn] = torch.where(inside, 3 * longest.sqrt(), 0).float()
    return Ellipses(drawn, position[:, 2], mean2d, covariance, determinant, opacity, inside, radii)


def squared_reach(opacity: torch.Tensor) -> torch.Tensor:
    """dᵀ cov⁻¹ d where alpha is at its minimum."""
    return 2 * torch.log((opacity / ALPHA_MIN).clamp_min(1))


def project(
    position: torch.Tensor, half_covariance: torch.Tensor, view: KernelCamera, dilation: float | torch.Tensor
):
    """Means (N, 2) in pixels, dilated covariances' xx, xy, yy, their determinant, and sqrt(det before / det
    after), each (N,).

    Args:
        position: (N, 3) in camera coordinates.
        half_covariance: (N, 3, 3) M with covariance M Mᵀ, in camera coordinates.
        dilation: in square pixels, of all or of each (N,).
    """
    x, y, z = position.unbind(1)
    clamped_x = (x / z).clamp(*view.x_limits) * z
    clamped_y = (y / z).clamp(*view.y_limits) * z
    # the rows of the Jacobian of (fx x/z, fy y/z), times M
    row_x = (view.fx / z)[:, None] * half_covariance[:, 0]
    row_x = row_x - (view.fx * clamped_x / z**2)[:, None] * half_covariance[:, 2]
    row_y = (view.fy / z)[:, None] * half_covariance[:, 1]
    row_y = row_y - (view.fy * clamped_y / z**2)[:, None] * half_covariance[:, 2]
    mean2d = torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], 1)
    xx, xy, yy = (row_x**2).sum(1), (row_x * row_y).sum(1), (row_y**2).sum(1)
    before = torch.linalg.cross(row_x, row_y).norm(dim=1)  # xx yy - xy² would cancel in float32
    determinant = before**2 + dilation * (xx + yy) + dilation**2
    return mean2d, (xx + dilation, xy, yy + dilation), determinant, before / determinant.sqrt()


def pixel_offsets(mean2d: torch.Tensor, view: KernelCamera) -> tuple[torch.Tensor, torch.Tensor]:
    """From the means (N, 2) to the pixels' centres, along x and along y, each (N, H, W)."""
    kind = {"dtype": mean2d.dtype, "device": mean2d.device}
    ys = torch.arange(view.height, **kind) + 0.5
    xs = torch.arange(view.width, **kind) + 0.5
    dx = xs[None, None, :] - mean2d[:, 0, None, None]
    dy = ys[None, :, None] - mean2d[:, 1, None, None]
    return dx.expand(-1, view.height, -1), dy.expand(-1, -1, view.width)


@torch.no_grad()
def tile_counts(seen: Ellipses, view: KernelCamera) -> torch.Tensor:
    """How many ellipses alpha = ALPHA_MIN meet the rectangle of the pixel centres of each 16x16 tile."""
    mean2d, (xx, xy, yy) = seen.mean2d[:, :, None, None], (v[:, None, None] for v in seen.covariance)
    left = 16 * torch.arange(-(-view.width // 16), device=xx.device)
    top = 16 * torch.arange(-(-view.height // 16), device=xx.device)[:, None]
    conic = yy, -xy, xx
    offset = left + 0.5 - mean2d[:, 0], top + 0.5 - mean2d[:, 1]
    determinant, reach = seen.determinant[:, None, None], squared_reach(seen.opacity)[:, None, None]
    return (meets_tile(offset, conic, determinant, reach) & seen.inside[:, None, None]).sum(0)


def meets_tile(offset, conic, determinant, reach) -> torch.Tensor:
    """Whether ellipses meet the rectangle of a tile's pixel centres; all arguments broadcast.

    Args:
        offset: x and y from the ellipse's middle to the tile's first pixel centre.
        conic, determinant, reach: the ellipse is a x² + 2 b x y + c y² = reach · determinant.
    """
    (x0, y0), (a, b, c) = offset, conic
    x1, y1 = x0 + 15, y0 + 15

    def distance(x, y):
        return (a * x * x + 2 * b * x * y + c * y * y) / determinant

    # the form is convex: its least value on the rectangle is at the mean or on an edge
    least = torch.where((x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0), 0.0, torch.inf)
    for x in (x0, x1):
        least = torch.minimum(least, distance(x, torch.maximum(torch.minimum(-b * x / c, y1), y0)))
    for y in (y0, y1):
        least = torch.minimum(least, distance(torch.maximum(torch.minimum(-b * y / a, x1), x0), y))
    return least <= reach


def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """See :func:`training.rasterize.contributions`: of one view, the largest, the sum, pixels and radii."""
    count, means = len(gaussians), gaussians.means
    gaussians = replace(gaussians, sh=means.new_zeros(count, 1, 3))
    drawn = rasterize(gaussians, weights, torch.eye(count).to(means), settings)
    shares = drawn.features.flatten(0, 1)  # a feature of each splat's own: its weight in every pixel
    return shares.amax(0).float(), shares.sum(0).float(), (shares > 0).sum(0), drawn.radii


def blend(offsets, xx, xy, yy, opacity, hidden=None) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights alpha T (N, H, W) of splats given front to back, and the T (H, W) left behind the last.

    Args:
        hidden: (N, H, W) bool, where a splat is not drawn; None: nowhere.
    """
    dx, dy = offsets
    xx, xy, yy = xx[:, None, None], xy[:, None, None], yy[:, None, None]
    distance = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    alpha = (opacity[:, None, None] * torch.exp(-0.5 * distance)).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    if hidden is not None:
        alpha = alpha.masked_fill(hidden, 0)

    behind = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(behind[:1]), behind[:-1]]) if len(behind) else behind
    alive = behind > TRANSMITTANCE_MIN
    weight = torch.where(alive, alpha * before, 0)
    transmittance = torch.where(alive, 1 - alpha, 1).prod(0)
    return weight, transmittance


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    truth = target.image.to(image)
    return loss_to(image, truth, moments(truth), ssim_weight)


def loss_to(image: torch.Tensor, truth: torch.Tensor, of_truth: Moments, ssim_weight: float) -> torch.Tensor:
    """The loss against a photograph (H, W, 3) whose moments are known."""
    difference = (image - truth).abs().mean()
    return (1 - ssim_weight) * difference + ssim_weight * (1 - ssim(image, truth, of_truth))


def ssim(image: torch.Tensor, truth: torch.Tensor, of_truth: Moments) -> torch.Tensor:
    """Mean structural similarity of two images (H, W, 3) in [0, 1] (Wang et al. 2004), as 3DGS has it:
    11x11 Gaussian window of sigma 1.5, zeros outside the image."""
    x, y = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    mean_x, square_x, product = windowed(torch.cat([x, x * x, x * y])).split(3)
    mean_y, variance_y = of_truth
    variance_x = square_x - mean_x**2
    covariance = product - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean()


def moments(image: torch.Tensor) -> Moments:
    """Local means and variances (3, H, W) of an image (H, W, 3)."""
    planes = image.permute(2, 0, 1)
    mean, square = windowed(torch.cat([planes, planes * planes])).split(3)
    return mean, square - mean**2


def windowed(planes: torch.Tensor) -> torch.Tensor:
    """Local means of planes (C, H, W)."""
    offsets = torch.arange(11, dtype=planes.dtype, device=planes.device) - 5
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = (line / line.sum()).expand(len(planes), 1, 1, 11)
    # every plane a channel of its own: such convolutions keep float32's digits on GPUs, others may not (TF32)
    along_x = conv2d(planes[None], line, padding=(0, 5), groups=len(planes))
    return conv2d(along_x, line.mT, padding=(5, 0), groups=len(planes))[0]
