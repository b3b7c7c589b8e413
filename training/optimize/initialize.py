"""What training begins with: splats at the scene's points, or a base's."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from ..errors import LodgsError
from ..splats.gaussians import SH_C0, Splats
from .density_control import constrained_log_scales
from .model import NAMES


def drop_duplicates(points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points without exact repetitions, which have no distance to take a scale from.

    Raises:
        LodgsError: fewer than 4 are left.
    """
    points, index = np.unique(points, axis=0, return_index=True)
    if len(points) < 4:
        raise LodgsError(
            f"The scene has {len(points)} distinct 3D points; training needs at least 4 to begin with.",
            "Run COLMAP's triangulation again, or choose another model.",
        )
    return points, colors[index]


def sample_points(
    points: np.ndarray, colors: np.ndarray, most: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """At most so many of the points, a random sample in their order."""
    if len(points) > most:
        some = np.sort(np.random.default_rng(seed).choice(len(points), most, replace=False))
        points, colors = points[some], colors[some]
    return points, colors


def neighbour_distances(means: np.ndarray, neighbours: int = 3) -> np.ndarray:
    """Distances to the nearest other points, (N, neighbours), in the unit of ``means``.

    With fewer points than neighbours, the missing ones are infinitely far.
    """
    distances, _ = KDTree(means).query(means, k=neighbours + 1, workers=-1)
    return distances[:, 1:]


def neighbour_scale(points: np.ndarray) -> np.ndarray:
    """Root mean square distance (N,) of the three nearest neighbours, above 0."""
    distances = neighbour_distances(points)
    finite = np.isfinite(distances)
    squared = np.where(finite, distances, 0) ** 2
    scale = np.sqrt(squared.sum(1) / np.maximum(finite.sum(1), 1))
    return np.maximum(scale, 1e-7 * max(float(np.ptp(points)), 1e-30))


def from_points(
    points: np.ndarray,
    colors: np.ndarray,
    sh_degree: int,
    device: torch.device | str = "cpu",
    min_scale: float = 0.0,
) -> dict[str, torch.Tensor]:
    """Splats from structure-from-motion points, as 3DGS begins: round, nearly transparent, coloured.

    Args:
        points: (N, 3) world coordinates, at least two distinct ones.
        colors: (N, 3) uint8, display-coded.
        sh_degree: the degree for which coefficients are made; those above 0 start at zero.
        device: where the tensors are made.
        min_scale: FLoD's s_min, which the rasterizer adds to the scales.

    Returns:
        Tensors by name; scales are the root mean square distance of the three nearest neighbours.
    """
    scale = neighbour_scale(points)
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors.astype(np.float32) / 255 - 0.5) / SH_C0
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1
    log_scales = torch.from_numpy(np.repeat(np.log(scale)[:, None], 3, 1).astype(np.float32))
    tensors = {
        "means": torch.tensor(points, dtype=torch.float32),
        "quats": torch.from_numpy(quats),
        "log_scales": constrained_log_scales(log_scales.exp(), min_scale),
        "opacity_logits": torch.full((count,), float(np.log(0.1 / 0.9))),
        "sh": torch.from_numpy(sh),
    }
    return {name: tensor.to(device) for name, tensor in tensors.items()}


def from_splats(
    splats: Splats, sh_degree: int, device: torch.device | str = "cpu"
) -> dict[str, torch.Tensor]:
    """A base's splats as tensors by name, a copy; harmonics above ``sh_degree`` go, missing ones are zero."""
    terms = (sh_degree + 1) ** 2
    sh = np.zeros((len(splats), terms, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh[:, :terms]
    arrays = {name: getattr(splats, name) for name in NAMES} | {"sh": sh}
    return {name: torch.tensor(array, dtype=torch.float32, device=device) for name, array in arrays.items()}
