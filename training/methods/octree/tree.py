"""The octree of Octree-GS (Ren et al. 2024, Sec. 4.1): levels, voxels and the points that stand for them.

A voxel is named by whole numbers, floor((point - origin) / size), and its level by its size: that of level l
is 2^(1 - l) times that of level 1, the coarsest.
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
"""About so many points and views tell how far views see."""


@dataclass(frozen=True)
class Octree:
    """Levels over a scene.

    Attributes:
        levels: how many, K; level 1 is the coarsest.
        d_max: distance from which on level 1 alone is wanted, in scene units, at ``focal_px``.
        focal_px: focal length in pixels to which distances are scaled.
        voxel: edge of level 1's voxels, in scene units.
        origin: (3,) a corner of all voxels.
    """

    levels: int
    d_max: float
    focal_px: float
    voxel: float
    origin: np.ndarray

    def facts(self) -> dict[str, float]:
        """What the rule has to know of the scene."""
        return {"d_max": self.d_max, "d_max_focal": self.focal_px}

    def size(self, level):
        """Edge of the voxels of a level (a number or an array)."""
        return self.voxel * 2.0 ** (1 - level)

    def keys(self, points: np.ndarray, level) -> np.ndarray:
        """The voxels of a level that points (N, 3) lie in, an int64 each; ``level`` is a number or (N,)."""
        cells = np.floor((points - self.origin) / np.asarray(self.size(level))[..., None]).astype(np.int64)
        x, y, z = (cells & ((1 << 19) - 1)).T  # 19 bits an axis: half a million voxels across
        return ((np.asarray(level, np.int64) << 19 | x) << 19 | y) << 19 | z


def view_distances(points: np.ndarray, cameras: Sequence[Camera], focal_px: float) -> list[np.ndarray]:
    """Each camera's distances to the points that it sees, scaled to one focal length.

    A point twice as far seen with twice the focal length covers as many pixels, so it counts as near: the
    distance is multiplied by focal_px over the camera's (Octree-GS, Sec. 5.2).
    """
    found = []
    for camera in cameras:
        seen = camera.view_space(points)[camera.sees(points)]
        found.append(np.linalg.norm(seen, axis=1) * (focal_px / camera.focal))
    return found


def build(
    points: np.ndarray,
    cameras: Sequence[Camera],
    *,
    focal_px: float,
    footprint: float,
    quantiles: tuple[float, float] = (0.05, 0.95),
    levels: int = 0,
    coarser: int = 0,
) -> Octree:
    """The octree of a scene's points (P, 3) and views, of which POINTS and VIEWS tell how far they see.

    Args:
        focal_px: focal length in pixels to which distances are scaled.
        footprint: pixels that a level's voxel covers at d_max / 2^(l - 1), where the level is just wanted.
        quantiles: of the distances between views and what they see: d_min and d_max.
        levels: how many; 0 for floor(log2(d_max / d_min)) + 1 (Eq. 3) and ``coarser``, MOST_LEVELS at most.
        coarser: how many levels of those lie beyond d_max.

    Raises:
        LodgsError: if no view sees a point.
    """
    some = points[:: max(1, len(points) // POINTS)], pick_evenly(cameras, VIEWS)
    distances = np.concatenate(view_distances(*some, focal_px))
    if not len(distances):
        raise LodgsError(
            "No training view sees any of the scene's points.", "Check that both are of one model."
        )
    d_min, d_max = np.quantile(distances, quantiles)
    levels = levels or min(floor(log2(d_max / d_min)) + 1 + coarser, MAX_LEVELS)
    coarser = min(coarser, levels - 1)
    d_max = float(d_max) * 2**coarser
    return Octree(levels, d_max, focal_px, footprint * d_max / focal_px, points.min(axis=0) - 1e-6)


def anchors(points: np.ndarray, octree: Octree) -> np.ndarray:
    """The level (P,) of each point that stands for a voxel, 0 for those that stand for none.

    A point stands for the voxel of the coarsest level that no other stands for yet (Eq. 4, without repeating
    at finer levels the points of coarser ones); of several in a voxel it is the first.
    """
    level_of = np.zeros(len(points), np.int64)
    for level in range(1, octree.levels + 1):
        # points that stand already come first, so their voxels are theirs
        order = np.concatenate([np.flatnonzero(level_of > 0), np.flatnonzero(level_of == 0)])
        _, first = np.unique(octree.keys(points[order], level), return_index=True)
        chosen = order[first]
        level_of[chosen[level_of[chosen] == 0]] = level
    return level_of
