"""Depths and normals of splats, which backends blend like colours."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize

from .gaussians import Gaussians
from .rendering import KernelCamera


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
