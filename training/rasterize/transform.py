"""Affine transforms of splats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..splats.similarity import is_similarity
from .features import rotation_matrices
from .gaussians import Gaussians


def transform_gaussians(gaussians: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Apply an affine transform (4, 4) to splats. Their harmonics are not rotated."""
    linear, shift = torch.from_numpy(matrix).to(gaussians.means.device)[:3].split([3, 1], 1)
    means = (gaussians.means.double() @ linear.T + shift[:, 0]).float()
    turned, lengths = rotation_matrices(gaussians.quats.double()), gaussians.log_scales.double().exp()
    if is_similarity(matrix):
        unit = torch.linalg.det(linear) ** (1 / 3)
        turned, lengths = linear @ turned / unit, lengths * unit
    else:
        # the columns of A = L Q diag(s) are no longer orthogonal: use the principal axes of A Aᵀ
        turned, lengths, _ = torch.linalg.svd(linear @ turned * lengths[:, None])
        turned = turned * torch.linalg.det(turned).sign()[:, None, None]
    quats = Rotation.from_matrix(turned.cpu().numpy()).as_quat()[:, [3, 0, 1, 2]]
    return replace(
        gaussians,
        means=means,
        quats=torch.from_numpy(quats).to(means),
        log_scales=lengths.clamp_min(1e-30).log().float(),
    )
