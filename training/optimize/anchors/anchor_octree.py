"""The octree of Octree-GS (Ren et al. 2024, Sec. 4.1): levels, voxels and their initial points.

Integers floor((point - origin) / size) identify a voxel within its level. Voxels of level l have 2^(1 -
l) times the size of those of level 1, the coarsest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log2

import numpy as np

from ...errors import LodgsError
from ...scenes.cameras import Camera, pick_evenly
from ...splats.levels import MAX_LEVELS

POINTS, VIEWS = 50_000, 500
"""Approximate maximum numbers of points and views for measuring distances."""


@dataclass(frozen=True)
class AnchorOctree:
    """Levels over a scene.

    Attributes:
        levels: number of levels, K; level 1 is the coarsest.
        d_max: distance beyond which only level 1 is drawn, in scene units, at ``focal_px``.
        focal_px: focal length in pixels to which distances are normalized.
        voxel: edge of level 1's voxels, in scene units.
        origin: (3,) common corner of the voxel grids.
    """

    levels: int
    d_max: float
    focal_px: float
    voxel: float
    origin: np.ndarray

    def facts(self) -> dict[str, float]:
        """Return the scene facts of the rule."""
        return {"d_max": self.d_max, "d_max_focal": self.focal_px}

    def size(self, level):
        """Return the voxel edge of a level (number or array)."""
        return self.voxel * 2.0 ** (1 - level)

    def keys(self, points: np.ndarray, level) -> np.ndarray:
        """Return int64 voxel keys of points (N, 3); ``level`` is a number or (N,)."""
        cells = np.floor((points - self.origin) / np.asarray(self.size(level))[..., None]).astype(np.int64)
        x, y, z = (cells & ((1 << 19) - 1)).T  # 19 bits per axis: half a million voxels across
        return ((np.asarray(level, np.int64) << 19 | x) << 19 | y) << 19 | z


def visible_distances(points: np.ndarray, cameras: Sequence[Camera], focal_px: float) -> list[np.ndarray]:
    """Return each camera's distances to its visible points, normalized to one focal length.

    A point at twice the distance covers the same pixels with twice the focal length. Distances are
    therefore multiplied by focal_px over the camera's focal length (Octree-GS, Sec. 5.2).
    """
    distances = []
    for camera in cameras:
        visible = camera.view_space(points)[camera.sees(points)]
        distances.append(np.linalg.norm(visible, axis=1) * (focal_px / camera.focal))
    return distances


def build(
    points: np.ndarray,
    cameras: Sequence[Camera],
    *,
    focal_px: float,
    footprint: float,
    quantiles: tuple[float, float] = (0.05, 0.95),
    levels: int = 0,
    coarser: int = 0,
) -> AnchorOctree:
    """Build the octree for a scene's points (P, 3) and views, from samples of about POINTS and VIEWS.

    Args:
        focal_px: focal length in pixels to which distances are normalized.
        footprint: size of a level's voxel in pixels at d_max / 2^(l - 1), where the level appears; that of a
            single level at d_min.
        quantiles: quantiles of the view distances used as d_min and d_max.
        levels: number of levels; 0 for floor(log2(d_max / d_min)) + 1 (Eq. 3) plus ``coarser``, up to
            MAX_LEVELS.
        coarser: number of these levels beyond d_max.

    Raises:
        LodgsError: no view sees any point.
    """
    sample = points[:: max(1, len(points) // POINTS)], pick_evenly(cameras, VIEWS)
    distances = np.concatenate(visible_distances(*sample, focal_px))
    if not len(distances):
        raise LodgsError(
            "Cannot build an octree: no training view sees any of the scene's points.",
            "Check that images and points belong to the same model.",
        )
    d_min, d_max = np.quantile(distances, quantiles)
    levels = levels or min(floor(log2(d_max / d_min)) + 1 + coarser, MAX_LEVELS)
    coarser = min(coarser, levels - 1)
    d_max = float(d_max) * 2**coarser
    reach = d_max if levels > 1 else float(d_min)  # a single level is drawn at all distances
    return AnchorOctree(levels, d_max, focal_px, footprint * reach / focal_px, points.min(axis=0) - 1e-6)


def anchors(points: np.ndarray, octree: AnchorOctree) -> np.ndarray:
    """Return the level (P,) of each point that represents a voxel, 0 for other points.

    A point represents the voxel of the coarsest level that no other point represents yet: the first one
    in the voxel (Eq. 4, without repeating points of coarser levels at finer ones).
    """
    level_of = np.zeros(len(points), np.int64)
    for level in range(1, octree.levels + 1):
        # points that already represent a voxel come first and keep their voxels
        order = np.concatenate([np.flatnonzero(level_of > 0), np.flatnonzero(level_of == 0)])
        _, first = np.unique(octree.keys(points[order], level), return_index=True)
        rows = order[first]
        level_of[rows[level_of[rows] == 0]] = level
    return level_of
