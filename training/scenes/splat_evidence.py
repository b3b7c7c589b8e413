"""Evidence for each splat of a trained scene: the photos that see it, and their directions. numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .cameras import Camera
from .evidence import MIN_PARALLAX, MIN_PHOTOS

OPAQUE = 0.5
"""Minimum opacity of a splat that hides others."""
COLUMNS = 128
"""Number of columns of the depth grid of a view. Splats of several columns use a coarser grid."""
LEVELS = 7
"""Number of grids, each of half as many columns and rows as the one before."""
TOLERANCE = 0.1
"""Depth beyond the first surface at which a splat is still visible, as a fraction of that depth."""


class SplatEvidence(NamedTuple):
    """Evidence for N splats.

    Attributes:
        photos: (N,) number of photos that see the splat.
        parallax: (N,) angle in degrees between the outermost directions of these photos.
    """

    photos: np.ndarray
    parallax: np.ndarray

    @property
    def grades(self) -> np.ndarray:
        """Grades (N,) uint8, as indices of GRADES."""
        seen_from_sides = np.where(self.parallax < MIN_PARALLAX, 2, 3)
        return np.where(self.photos < MIN_PHOTOS, self.photos > 1, seen_from_sides).astype(np.uint8)


GRADES = (
    "Seen by one photo or none",
    f"Seen by {MIN_PHOTOS - 1} photos",
    f"Seen within {MIN_PARALLAX:.0f}° only",
    "Seen from several sides",
)
"""Grades of evidence, from none to enough."""


def measure_splat_evidence(
    cameras: Sequence[Camera], means: np.ndarray, sizes: np.ndarray, opacities: np.ndarray
) -> SplatEvidence:
    """Count the photos that see each of N splats, and measure their parallax.

    A view sees a splat in its frame unless an opaque splat in front of it covers its mean, which is tested on
    a coarse grid. The parallax is twice the largest angle between a direction and the mean direction.

    Args:
        cameras: views of the photos.
        means: (N, 3) in the space of the cameras.
        sizes: (N,) standard deviations.
        opacities: (N,) in [0, 1].
    """
    means = np.asarray(means, np.float64)
    photos, middle = np.zeros(len(means), np.int32), np.zeros((len(means), 3))
    visible = []
    for camera in cameras:
        rows = _visible_rows(camera, means, sizes, opacities)
        visible.append(rows)
        photos[rows] += 1
        middle[rows] += _directions(camera, means[rows])
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    smallest = np.ones(len(means))
    for camera, rows in zip(cameras, visible, strict=True):
        cosines = (_directions(camera, means[rows]) * middle[rows]).sum(1)
        smallest[rows] = np.minimum(smallest[rows], cosines)
    return SplatEvidence(photos, 2 * np.degrees(np.arccos(np.clip(smallest, -1, 1))))


def _directions(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the unit vectors (M, 3) from a camera to points (M, 3)."""
    offsets = points - camera.center
    return offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)


def _visible_rows(camera: Camera, means: np.ndarray, sizes: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return the splats (M,) that a view sees."""
    rows = np.flatnonzero(camera.sees(means))
    pixels, depths = camera.project(means[rows])
    cell = camera.width / COLUMNS
    height, width = (int(np.ceil(side / cell / 2 ** (LEVELS - 1))) << (LEVELS - 1)
                     for side in (camera.height, camera.width))  # fmt: skip
    x, y = (pixels / cell).astype(np.int64).T
    diameters = 2 * sizes[rows] * camera.fx / depths / cell
    level = np.clip(np.floor(np.log2(np.maximum(diameters, 1))), 0, LEVELS - 1).astype(np.int64)
    solid = opacities[rows] >= OPAQUE
    nearest = np.full((height >> LEVELS - 1, width >> LEVELS - 1), np.inf)
    for number in reversed(range(LEVELS)):
        if number < LEVELS - 1:
            nearest = nearest.repeat(2, 0).repeat(2, 1)
        chosen = solid & (level == number)
        np.minimum.at(nearest, (y[chosen] >> number, x[chosen] >> number), depths[chosen])
    limit = (1 + TOLERANCE) * nearest[y, x] + 2 * sizes[rows]
    return rows[depths <= limit]
