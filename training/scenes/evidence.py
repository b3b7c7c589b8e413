"""Evidence for each region of a scene: the photos that observe its points, and their directions. No torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .cameras import Camera

CELL = 0.05
"""Side of a region, as a fraction of the distance at which its photos see it."""


MIN_PHOTOS = 3
"""Number of photos below which a region has weak evidence."""
MIN_PARALLAX = 5.0
"""Parallax in degrees below which the depth of a region is uncertain."""


class Evidence(NamedTuple):
    """Evidence for the regions of a scene, R rows.

    Attributes:
        points: number of points.
        photos: number of photos that observe any of them.
        parallax: angle in degrees between the outermost directions of these photos.
    """

    points: np.ndarray
    photos: np.ndarray
    parallax: np.ndarray

    @property
    def weak_share(self) -> float:
        """Share of the points in regions that fewer than MIN_PHOTOS photos observe."""
        return self._share(self.photos < MIN_PHOTOS)

    @property
    def flat_share(self) -> float:
        """Share of the points in other regions that lack MIN_PARALLAX."""
        return self._share((self.photos >= MIN_PHOTOS) & (self.parallax < MIN_PARALLAX))

    def quantile(self, values: np.ndarray, share: float) -> float:
        """Return the value (R,) below which a share of the points lies."""
        order = np.argsort(values, kind="stable")
        total = np.cumsum(self.points[order])
        return float(values[order][np.searchsorted(total, share * total[-1])])

    def _share(self, mask: np.ndarray) -> float:
        return float(self.points[mask].sum() / max(self.points.sum(), 1))


def measure_evidence(
    cameras: Sequence[Camera], points: np.ndarray, observed: Mapping[str, np.ndarray]
) -> Evidence:
    """Measure the evidence for the regions that contain observed points.

    Regions are cubes with a side of CELL times the mean distance of their photos, rounded to a power of 2.
    The parallax is twice the largest angle between a direction and the mean direction.

    Args:
        cameras: views to count.
        points: (P, 3) scene points.
        observed: indices of the points that each view observes, by name (``observations.observations``).

    Returns:
        The regions; none if no point is observed.
    """
    rows = [np.unique(observed.get(camera.name, np.zeros(0, np.int64))) for camera in cameras]
    view = np.repeat(np.arange(len(rows)), list(map(len, rows)))
    point = np.concatenate([np.zeros(0, np.int64), *rows])
    if not len(point):
        return Evidence(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    centers = np.array([camera.center for camera in cameras])
    offsets = points[point].astype(np.float64) - centers[view]
    distances = np.linalg.norm(offsets, axis=1)
    region = _regions(points, point, distances)
    size = len(points) + 1
    _, first = np.unique(region[point] * len(rows) + view, return_index=True)
    owner = region[point][first]
    directions = offsets[first] / np.maximum(distances[first], 1e-12)[:, None]
    middle = np.stack([np.bincount(owner, axis, size) for axis in directions.T], axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    angles = np.arccos(np.clip((directions * middle[owner]).sum(1), -1, 1))
    parallax = np.zeros(size)
    np.maximum.at(parallax, owner, 2 * np.degrees(angles))
    members = np.bincount(region[np.unique(point)], minlength=size)
    photos = np.bincount(owner, minlength=size)
    used = photos > 0
    return Evidence(members[used], photos[used], parallax[used])


def _regions(points: np.ndarray, point: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Return the number of each point's region (P,), below P; points without observations have number 0.

    Args:
        point, distances: (O,) point of each observation, and its distance from the camera.
    """
    total, count = np.bincount(point, distances, len(points)), np.bincount(point, minlength=len(points))
    mean = total / np.maximum(count, 1)
    levels = np.round(np.log2(np.maximum(CELL * mean, 1e-12)))
    cells = np.floor(points / 2.0 ** levels[:, None])
    return np.unique(np.column_stack([levels, cells]), axis=0, return_inverse=True)[1].ravel()
