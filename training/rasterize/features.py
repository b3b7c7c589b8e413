"""Depths and normals of splats, which backends blend like colours."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch.nn.functional import normalize

from .gaussians import Gaussians
from .rendering import BackendOutput, KernelCamera, Rendering


def blended_values(
    gaussians: Gaussians, view: KernelCamera, outputs: Collection[str], features: torch.Tensor | None
) -> torch.Tensor:
    """Return the values (N, F) that a backend blends: the caller's features, depths and normals."""
    means = gaussians.means
    values = [] if features is None else [features]
    if planes := _planes(outputs):
        depth = depths(means, view)[:, None]
        by_name = {"depth": depth, "inverse_depth": 1 / depth.clamp_min(view.near or 1e-6)}
        values += [by_name[name] for name in planes]
    if "normals" in outputs:
        values.append(normals(gaussians, view))
    return torch.cat(values, 1) if values else means.new_zeros(len(means), 0)


def name_outputs(
    output: BackendOutput,
    gaussians: Gaussians,
    view: KernelCamera,
    outputs: Collection[str],
    feature_count: int | None,
) -> Rendering:
    """Split the blended values into the caller's features, depths and normals.

    Args:
        feature_count: number of the caller's features; None without features.
    """
    rendering = Rendering(
        output.image, output.alpha, output.radii, output.grad2d, output.tile_counts, output.absgrad2d
    )
    first = feature_count or 0
    if feature_count is not None:
        rendering.features = output.features[..., :first]
    by_name = dict(zip(_planes(outputs), output.features[..., first:].unbind(-1), strict=False))
    if "depth" in outputs:
        empty = output.alpha == 0
        rendering.depth = torch.where(empty, 0, by_name["depth"] / output.alpha.masked_fill(empty, 1))
    rendering.inverse_depth = by_name.get("inverse_depth")
    if "normals" in outputs:
        rendering.normals = output.features[..., -3:]
    if output.median is not None:
        means = gaussians.means
        padded = torch.cat([depths(means, view), means.new_zeros(1)])  # index -1 selects the zero
        rendering.median_depth = padded[output.median.long()]
    return rendering


def _planes(outputs: Collection[str]) -> list[str]:
    """Return the requested kinds of depth, in the order in which they are blended."""
    return [name for name in ("depth", "inverse_depth") if name in outputs]


def depths(means: torch.Tensor, view: KernelCamera) -> torch.Tensor:
    """Return the depths (N,) of means (N, 3) along the camera's z axis, in world units."""
    return means @ torch.as_tensor(view.rotation[2]).to(means) + float(view.translation[2])


def normals(gaussians: Gaussians, view: KernelCamera) -> torch.Tensor:
    """Return the unit vectors (N, 3) along the shortest axes, towards the camera, in camera coordinates."""
    means, quats = gaussians.means, gaussians.quats
    shortest = gaussians.log_scales.detach().argmin(dim=1)
    axis = rotation_matrices(quats)[torch.arange(len(quats), device=quats.device), :, shortest]
    with torch.no_grad():
        away = (axis * (means - torch.as_tensor(view.position).to(means))).sum(1, keepdim=True) > 0
    return torch.where(away, -axis, axis) @ torch.as_tensor(view.rotation).to(means).T


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """Convert quaternions (N, 4), wxyz, of any non-zero length, to rotation matrices (N, 3, 3)."""
    w, x, y, z = normalize(quats, dim=1).unbind(1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)
