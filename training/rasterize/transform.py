"""Splats that stand somewhere in a world: what a transform makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..splats.similarity import is_similarity
from .features import rotation_matrices
from .gaussians import Gaussians


def transform_gaussians(own: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Splats where a transform (4, 4) puts them, any affine one; their harmonics stay as they are."""
    linear, shift = torch.from_numpy(matrix).to(own.means.device)[:3].split([3, 1], 1)
    means = (own.means.double() @ linear.T + shift[:, 0]).float()
    turned, lengths = rotation_matrices(own.quats.double()), own.log_scales.double().exp()
    if is_similarity(matrix):
        unit = torch.linalg.det(linear) ** (1 / 3)
        turned, lengths = linear @ turned / unit, lengths * unit
    else:
        # an ellipsoid's axes A = L Q diag(s) stay no axes then: those of A Aᵀ are
        turned, lengths, _ = torch.linalg.svd(linear @ turned * lengths[:, None])
        turned = turned * torch.linalg.det(turned).sign()[:, None, None]
    quats = Rotation.from_matrix(turned.cpu().numpy()).as_quat()[:, [3, 0, 1, 2]]
    return replace(
        own,
        means=means,
        quats=torch.from_numpy(quats).to(means),
        log_scales=lengths.clamp_min(1e-30).log().float(),
    )
