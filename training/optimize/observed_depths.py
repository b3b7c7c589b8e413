"""Depths of the parts of photos, from the scene points that the photos observe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..lod.crop import Crop
from ..scenes.cameras import Camera
from ..scenes.colmap import Scene
from ..scenes.images import load_mask
from ..scenes.observations import observed_pixels
from .neighbors import query_neighbors

COLUMNS = 64
"""Number of columns of parts of a photo."""
NEIGHBORS = 8
"""Number of observed points that describe a part: those nearest to its middle."""
MAX_DISTANCE = 0.085
"""Maximum distance of a point from the middle of a part, as a fraction of the photo's width."""
MAX_OBSERVATIONS = 8000
"""Maximum number of points of a photo, evenly spaced in the order of its file."""
SIMILAR_DEPTHS = 1.25
"""Maximum ratio between the depths of points on the same surface."""
SURFACE_POINTS = 4
"""Number of nearest points that show a surface between them."""


class PhotoParts(NamedTuple):
    """Observed points near the middles of a photo's P parts, row by row. Each has K = ``NEIGHBORS``.

    Attributes:
        camera: view of the photo.
        columns: number of columns of parts.
        middles: (P, 2) pixels of the view.
        points: (P, K) indices of scene points, nearest first.
        distances: (P, K) distances from the middle, in pixels.
        depths: (P, K) depths along the view direction, in scene units.
    """

    camera: Camera
    columns: int
    middles: np.ndarray
    points: np.ndarray
    distances: np.ndarray
    depths: np.ndarray

    @property
    def free_depths(self) -> np.ndarray:
        """Depths (rows, columns) up to which rays are free: the smallest of a part's points, 0 if these are
        too far away.
        """
        near = self.distances[:, -1] <= MAX_DISTANCE * self.camera.width
        return np.where(near, self.depths.min(1), 0).reshape(-1, self.columns)

    def interpolate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Interpolate inverse depth in parts without points whose nearest points have similar depths.

        Parts that the photo's mask ignores at their middle are left out.

        Returns:
            Points (M, 3) in scene coordinates at the middles of these parts; indices (M, S) of their S =
            ``SURFACE_POINTS`` nearest scene points; and the weights (M, S) of these in the interpolation.

        Raises:
            LodgsError: the mask cannot be read.
        """
        distances, depths = self.distances[:, :SURFACE_POINTS], self.depths[:, :SURFACE_POINTS]
        between = (
            (distances[:, 0] > self.camera.width / self.columns)
            & (distances[:, -1] <= MAX_DISTANCE * self.camera.width)
            & (depths.max(1) <= SIMILAR_DEPTHS * depths.min(1))
        )
        if self.camera.mask is not None:
            column, row = self.middles.astype(np.int64).T
            between &= load_mask(self.camera.mask, self.camera.width, self.camera.height)[row, column] >= 0.5
        weights = 1 / distances[between]
        weights /= weights.sum(1, keepdims=True)
        positions = self.camera.unproject(self.middles[between], 1 / (weights / depths[between]).sum(1))
        return positions, self.points[between, :SURFACE_POINTS], weights


def photo_parts(scene: Scene, cameras: Sequence[Camera]) -> Iterator[PhotoParts]:
    """Yield the parts of each photo that observes at least ``NEIGHBORS`` points.

    Yields nothing if the model does not record which photos observe its points.

    Args:
        scene: scene of pinhole cameras with its points.
        cameras: its views, of any size.
    """
    observed = observed_pixels(scene, [camera.name for camera in cameras], MAX_OBSERVATIONS)
    for camera in cameras:
        points = np.unique(observed[camera.name][0]) if camera.name in observed else np.zeros(0, np.int64)
        pixels, depths = camera.project(scene.points[points].astype(np.float64))
        in_front = depths > 0
        points, pixels, depths = points[in_front], pixels[in_front], depths[in_front]
        if len(points) < NEIGHBORS:
            continue
        rows = max(round(COLUMNS * camera.height / camera.width), 1)
        x = (np.arange(COLUMNS) + 0.5) * camera.width / COLUMNS
        y = (np.arange(rows) + 0.5) * camera.height / rows
        middles = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        distances, nearest = query_neighbors(KDTree(pixels), middles, NEIGHBORS)
        yield PhotoParts(camera, COLUMNS, middles, points[nearest], distances, depths[nearest])


def points_between(
    scene: Scene, cameras: Sequence[Camera], limit: int, seed: int, region: Crop | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate points between the scene's points, at random parts of photos; see
    :meth:`PhotoParts.interpolate`.

    Args:
        scene, cameras: see :func:`photo_parts`.
        limit: maximum number of points; all photos have the same share.
        seed: seed of the choice.
        region: region in scene coordinates that contains the points; None for everywhere.

    Returns:
        Points (M, 3) float32 and their interpolated colours (M, 3) uint8.
    """
    rng = np.random.default_rng([seed, 17])
    positions, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    share = limit // len(cameras)
    for parts in photo_parts(scene, cameras) if share > 0 else ():
        points, nearest, weights = parts.interpolate()
        inside = np.arange(len(points)) if region is None else np.flatnonzero(region.contains(points))
        chosen = rng.permutation(inside)[:share]
        mixed = np.einsum("ms,msc->mc", weights[chosen], scene.point_colors[nearest[chosen]].astype(float))
        positions.append(points[chosen].astype(np.float32))
        colors.append(np.rint(mixed).astype(np.uint8))
    return np.concatenate(positions), np.concatenate(colors)
