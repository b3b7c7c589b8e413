"""Initial splats, from the scene's points or from a base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree

from ..errors import LodgsError
from ..lod.crop import Crop
from ..scenes.cameras import Camera
from ..scenes.colmap import Scene
from ..splats.gaussians import SH_C0, Splats
from .density_control import constrained_log_scales
from .model import NAMES
from .neighbors import query_neighbors
from .observed_depths import points_between

MIN_POINTS = 4
"""Minimum number of distinct points to start from."""
MAX_START = 0.5
"""Maximum number of initial splats if some lie between the scene's points, as a share of the limit. Density
control adds the others."""


def drop_duplicates(points: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop repeated points. Their neighbour distance is 0, which gives no scale.

    Args:
        points: (N, 3), in any unit.
        colors: (N, 3) of any type.

    Returns:
        The M distinct points, sorted by coordinates, and the colour of the first of each, (M, 3) both.

    Raises:
        LodgsError: fewer than 4 points remain.
    """
    points, index = np.unique(points, axis=0, return_index=True)
    if len(points) < MIN_POINTS:
        raise LodgsError(
            f"Cannot start training: the scene has {len(points)} distinct 3D points "
            f"and needs at least {MIN_POINTS}.",
            "Run COLMAP's triangulation again, or choose another model.",
        )
    return points, colors[index]


def sample_points(
    points: np.ndarray, colors: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw at most ``count`` of the points (N, 3) and their colours (N, 3) at random, keeping their order."""
    if len(points) > count:
        index = np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))
        points, colors = points[index], colors[index]
    return points, colors


def initial_points(
    scene: Scene,
    cameras: Sequence[Camera],
    between: float,
    limit: int,
    seed: int,
    region: Crop | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points to start from: the scene's, without repetitions, and others between them.

    Args:
        scene: scene with its points.
        cameras: training views.
        between: maximum number of points between the scene's points, as a multiple of their number.
        limit: maximum number of points; if the scene has more, they are a random sample.
        seed: seed of random choices.
        region: region in scene coordinates of the points between others; None for everywhere.

    Returns:
        Points (N, 3) in scene coordinates and display-coded colours (N, 3) uint8.

    Raises:
        LodgsError: the scene has fewer than 4 distinct points.
    """
    points, colors = drop_duplicates(scene.points, scene.point_colors)
    room = round(MAX_START * limit) - len(points)
    count = min(round(between * len(points)), room)
    added, added_colors = points_between(scene, cameras, count, seed, region)
    points, colors = np.concatenate([points, added]), np.concatenate([colors, added_colors])
    return sample_points(points, colors, limit, seed)


def neighbor_distances(means: np.ndarray, neighbors: int = 3) -> np.ndarray:
    """Return the distances to the nearest other points, (N, neighbours), in the unit of ``means``.

    With fewer points than neighbours, the missing distances are infinite.
    """
    return query_neighbors(KDTree(means), means, neighbors + 1)[0][:, 1:]


def neighbor_scale(points: np.ndarray) -> np.ndarray:
    """Return the root mean square distance (N,) of the three nearest neighbours, above 0."""
    distances = neighbor_distances(points)
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
    """Create splats from structure-from-motion points, as in 3DGS: round, nearly transparent, coloured.

    Args:
        points: (N, 3) world coordinates, at least two distinct ones.
        colors: (N, 3) uint8, display-coded.
        sh_degree: degree of the harmonics; coefficients above degree 0 are zero.
        device: device of the tensors.
        min_scale: FLoD's s_min, which the rasterizer adds to the scales.

    Returns:
        Tensors by name. Scales are the root mean square distance of the three nearest neighbours.
    """
    scale = neighbor_scale(points)
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
    """Copy splats to float32 tensors by name, truncating or zero-padding harmonics to ``sh_degree``.

    The names are NAMES; shapes are those of :class:`Splats`.
    """
    terms = (sh_degree + 1) ** 2
    sh = np.zeros((len(splats), terms, 3), np.float32)
    sh[:, : splats.sh.shape[1]] = splats.sh[:, :terms]
    arrays = {name: getattr(splats, name) for name in NAMES} | {"sh": sh}
    return {name: torch.tensor(array, dtype=torch.float32, device=device) for name, array in arrays.items()}


def to_splats(tensors: Mapping[str, torch.Tensor]) -> Splats:
    """Return the splats of tensors by name, as :func:`from_splats` makes them."""
    arrays: dict[str, Any] = {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    return Splats(**arrays)
