"""Reference implementation of splatting and of the photometric loss, in plain torch and any float type.

EWA splatting as in "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023), Eq. 3
to 6. Every splat is evaluated at every pixel, so memory limits it to small images.
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
    means = gaussians.means
    view = settings.view
    kind = {"dtype": means.dtype, "device": means.device}
    weights = settings.mask_weights(weights, gaussians.means)
    projected = ellipses(gaussians, weights, settings)
    drawn, mean2d, opacity = projected.drawn, projected.mean2d, projected.opacity
    xx, xy, yy = projected.covariance
    grad2d = torch.zeros(len(means), 2, dtype=torch.float32, device=means.device)
    absgrad2d = torch.zeros_like(grad2d) if settings.absolute else None
    to_ndc = torch.tensor([view.width / 2, view.height / 2], **kind)

    def store_gradient(gradient: torch.Tensor) -> None:
        grad2d[drawn] = (gradient * to_ndc).float()

    if mean2d.requires_grad:
        mean2d.register_hook(store_gradient)

    values: list = [None] * harmonics.coefficient_count(settings.degree)
    x, y, z = normalize(means[drawn] - torch.as_tensor(view.position, **kind), dim=1).unbind(1)
    harmonics.basis(x, y, z, settings.degree, values)
    color = (
        (torch.stack(values, 1)[:, :, None] * gaussians.sh[drawn, : len(values)]).sum(1).add(0.5).clamp_min(0)
    )

    order = projected.depth.argsort(stable=True)
    offsets = pixel_offsets(mean2d[order], view)
    hidden = None if settings.limit is None else projected.depth[order][:, None, None] > settings.limit
    weight, transmittance = blend(offsets, xx[order], xy[order], yy[order], opacity[order], hidden)
    image = torch.einsum("nhw,nc->hwc", weight, color[order])
    image = image + transmittance[..., None] * torch.tensor(settings.background, **kind)
    if settings.absolute:  # features do not affect absgrad2d, so they get separate offsets
        feature_offsets = pixel_offsets(mean2d[order], view)
        weight, _ = blend(feature_offsets, xx[order], xy[order], yy[order], opacity[order], hidden)
    blended = torch.einsum("nhw,nc->hwc", weight, features[drawn[order]])
    if absgrad2d is not None and mean2d.requires_grad:
        for axis, offset in enumerate(offsets):

            def store_absolute(gradient: torch.Tensor, axis: int = axis) -> None:
                absgrad2d[drawn[order], axis] = (gradient.abs().sum((1, 2)) * to_ndc[axis]).float()

            offset.register_hook(store_absolute)
    counts = tile_counts(projected, view)
    median = None
    if settings.median:
        remaining = 1 - weight.detach().cumsum(0)  # the transmittance, as Σ w = 1 - T
        reached = (remaining <= 0.5).to(torch.int32)
        splats = torch.cat([drawn[order], drawn.new_tensor([-1])])
        sentinel = reached.new_ones(1, view.height, view.width)
        median = splats[torch.cat([reached, sentinel]).argmax(0)].int()
    return BackendOutput(
        image, 1 - transmittance, projected.radii, grad2d, counts, absgrad2d, blended, median
    )


class Ellipses(NamedTuple):
    """The n splats in front of a camera, projected to ellipses on its image.

    Attributes:
        drawn: (n,) int64, indices of the splats.
        depth: (n,) along the camera's z axis.
        mean2d, covariance, determinant: see :func:`project`.
        opacity: (n,), including weights and the antialiasing factor.
        inside: (n,) bool, true if the ellipse alpha = ALPHA_MIN intersects the image.
        radii: (N,) float32 of all splats, see ``Rendering.radii``.
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
    """Project splats onto the image plane; differentiable except for ``inside`` and ``radii``."""
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
    filtered = torch.as_tensor(settings.antialias, device=means.device).expand(len(means))[drawn]
    dilation = torch.where(filtered, means.new_tensor(MIP_VARIANCE), means.new_tensor(DILATION))
    mean2d, covariance, determinant, area = project(position, half_covariance, view, dilation)
    opacity = torch.where(filtered, opacity * area, opacity)
    with torch.no_grad():
        xx, xy, yy = covariance
        # distance at which alpha reaches its minimum: sigma² = 2 ln(opacity / minimum), along x and along y
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
    """Return dᵀ cov⁻¹ d at the contour of minimum alpha."""
    return 2 * torch.log((opacity / ALPHA_MIN).clamp_min(1))


def project(
    position: torch.Tensor, half_covariance: torch.Tensor, view: KernelCamera, dilation: float | torch.Tensor
) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor, torch.Tensor]:
    """Project means and covariances onto the image plane.

    Args:
        position: (N, 3) in camera coordinates.
        half_covariance: (N, 3, 3) M with covariance M Mᵀ, in camera coordinates.
        dilation: variance in square pixels, a number or (N,).

    Returns:
        Means (N, 2) in pixels; xx, xy and yy of the dilated covariances, their determinant, and sqrt(det
        before / det after), each (N,).
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
    root = torch.linalg.cross(row_x, row_y).norm(dim=1)  # xx yy - xy² would cancel in float32
    determinant = root**2 + dilation * (xx + yy) + dilation**2
    return mean2d, (xx + dilation, xy, yy + dilation), determinant, root / determinant.sqrt()


def pixel_offsets(mean2d: torch.Tensor, view: KernelCamera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the offsets from means (N, 2) to pixel centres, along x and along y, each (N, H, W)."""
    kind = {"dtype": mean2d.dtype, "device": mean2d.device}
    ys = torch.arange(view.height, **kind) + 0.5
    xs = torch.arange(view.width, **kind) + 0.5
    dx = xs[None, None, :] - mean2d[:, 0, None, None]
    dy = ys[None, :, None] - mean2d[:, 1, None, None]
    return dx.expand(-1, view.height, -1), dy.expand(-1, -1, view.width)


@torch.no_grad()
def tile_counts(projected: Ellipses, view: KernelCamera) -> torch.Tensor:
    """Count the ellipses alpha = ALPHA_MIN that intersect the rectangle of each 16x16 tile's pixel
    centres."""
    mean2d = projected.mean2d[:, :, None, None]
    xx, xy, yy = (v[:, None, None] for v in projected.covariance)
    left = 16 * torch.arange(-(-view.width // 16), device=xx.device)
    top = 16 * torch.arange(-(-view.height // 16), device=xx.device)[:, None]
    conic = yy, -xy, xx
    offset = left + 0.5 - mean2d[:, 0], top + 0.5 - mean2d[:, 1]
    determinant = projected.determinant[:, None, None]
    reach = squared_reach(projected.opacity)[:, None, None]
    return (intersects_tile(offset, conic, determinant, reach) & projected.inside[:, None, None]).sum(0)


def intersects_tile(
    offset: tuple[torch.Tensor, torch.Tensor] | torch.Tensor,
    conic: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    determinant: torch.Tensor,
    reach: torch.Tensor,
) -> torch.Tensor:
    """Test if ellipses intersect the rectangle of a tile's pixel centres; all arguments broadcast.

    Args:
        offset: x and y from the ellipse's centre to the tile's first pixel centre.
        conic, determinant, reach: the ellipse is a x² + 2 b x y + c y² = reach · determinant.
    """
    (x0, y0), (a, b, c) = offset, conic
    x1, y1 = x0 + 15, y0 + 15

    def distance(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (a * x * x + 2 * b * x * y + c * y * y) / determinant

    # the form is convex, so its minimum on the rectangle is at the mean or on an edge
    minimum = torch.where((x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0), 0.0, torch.inf)
    for x in (x0, x1):
        minimum = torch.minimum(minimum, distance(x, torch.maximum(torch.minimum(-b * x / c, y1), y0)))
    for y in (y0, y1):
        minimum = torch.minimum(minimum, distance(torch.maximum(torch.minimum(-b * y / a, x1), x0), y))
    return minimum <= reach


def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return largest weights, sums, pixel counts and radii of one view; see :mod:`training.rasterize`."""
    count = len(gaussians)
    means = gaussians.means
    gaussians = replace(gaussians, sh=means.new_zeros(count, 1, 3))
    output = rasterize(gaussians, weights, torch.eye(count).to(means), settings)
    shares = output.features.flatten(0, 1)  # one-hot features blend to each splat's weight in every pixel
    return shares.amax(0).float(), shares.sum(0).float(), (shares > 0).sum(0), output.radii


def blend(
    offsets: tuple[torch.Tensor, torch.Tensor],
    xx: torch.Tensor,
    xy: torch.Tensor,
    yy: torch.Tensor,
    opacity: torch.Tensor,
    hidden: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend splats front to back; return weights alpha T (N, H, W) and the transmittance T (H, W) behind all.

    Args:
        hidden: (N, H, W) bool, pixels in which a splat is not drawn; None means no pixels.
    """
    dx, dy = offsets
    xx, xy, yy = xx[:, None, None], xy[:, None, None], yy[:, None, None]
    distance = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    alpha = (opacity[:, None, None] * torch.exp(-0.5 * distance)).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    if hidden is not None:
        alpha = alpha.masked_fill(hidden, 0)

    back = torch.cumprod(1 - alpha, 0)
    front = torch.cat([torch.ones_like(back[:1]), back[:-1]]) if len(back) else back
    alive = back > TRANSMITTANCE_MIN
    weight = torch.where(alive, alpha * front, 0)
    transmittance = torch.where(alive, 1 - alpha, 1).prod(0)
    return weight, transmittance


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    truth = target.image.to(image)
    return loss_with_moments(image, truth, moments(truth), ssim_weight)


def loss_with_moments(
    image: torch.Tensor, truth: torch.Tensor, truth_moments: Moments, ssim_weight: float
) -> torch.Tensor:
    """Compute the loss against a photo (H, W, 3) with precomputed moments."""
    difference = (image - truth).abs().mean()
    return (1 - ssim_weight) * difference + ssim_weight * (1 - ssim(image, truth, truth_moments))


def ssim(image: torch.Tensor, truth: torch.Tensor, truth_moments: Moments) -> torch.Tensor:
    """Compute the mean structural similarity of two images (H, W, 3) in [0, 1] (Wang et al. 2004).

    The 11x11 Gaussian window has sigma 1.5, with zeros outside the image, as in 3DGS.
    """
    x, y = image.permute(2, 0, 1), truth.permute(2, 0, 1)
    mean_x, square_x, product = windowed(torch.cat([x, x * x, x * y])).split(3)
    mean_y, variance_y = truth_moments
    variance_x = square_x - mean_x**2
    covariance = product - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean()


def moments(image: torch.Tensor) -> Moments:
    """Compute the local means and variances (3, H, W) of an image (H, W, 3)."""
    planes = image.permute(2, 0, 1)
    mean, square = windowed(torch.cat([planes, planes * planes])).split(3)
    return mean, square - mean**2


def windowed(planes: torch.Tensor) -> torch.Tensor:
    """Compute the local means of planes (C, H, W)."""
    offsets = torch.arange(11, dtype=planes.dtype, device=planes.device) - 5
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = (line / line.sum()).expand(len(planes), 1, 1, 11)
    # depthwise convolutions use full float32 on GPUs; others may use TF32
    along_x = conv2d(planes[None], line, padding=(0, 5), groups=len(planes))
    return conv2d(along_x, line.mT, padding=(5, 0), groups=len(planes))[0]
