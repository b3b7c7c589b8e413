"""What photographs support: splats neither right before a camera nor so large that they wrap it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from ..scenes.cameras import Camera

NEIGHBOURS = (1, 2, 4)
"""Which of a camera's nearest other cameras a place lies halfway to."""
INTERVAL = 50
"""Steps between two looks at what is supported."""
NEAREST_QUANTILE = 0.01
"""Quantile of the depths of the points in a view that counts as the nearest, as some points are astray."""
MARGIN = 0.1
"""What a view is widened by on every side, as a share of its image."""
MAX_POINTS = 20_000
"""Most points that are looked at."""
MIN_PHOTOS = 2
"""So many photographs have to see what is near to a place but not before it."""


def midpoint_views(cameras: Sequence[Camera]) -> list[Camera]:
    """Views from halfway between each camera and its 1st, 2nd and 4th nearest, looking as the camera does.

    Places that need more cameras than there are do not exist.
    """
    centers = np.array([camera.center for camera in cameras])
    found = []
    order = np.asarray(KDTree(centers).query(centers, k=1 + max(NEIGHBOURS))[1])  # itself is the first
    for camera, others in zip(cameras, order[:, list(NEIGHBOURS)], strict=True):
        for other in others[others < len(cameras)]:  # those that do not exist are numbered beyond
            pose = camera.world_to_camera.copy()
            pose[:3, 3] = -pose[:3, :3] @ (camera.center + centers[other]) / 2
            found.append(replace(camera, world_to_camera=pose, image=None))
    return found


class Support:
    """The room that whoever took the photographs stood in and walked through.

    Nothing is near before a camera, or before a place halfway between two, but what the scene's points show.
    Nor is anything as near beside or behind one but what two photographs see: what only one of them sees may
    be at any depth along its rays, and whoever turns around there has it before his eyes.

    Args:
        cameras: the training views.
        points: (P, 3) the scene's; at most POINTS, evenly taken from their order, are looked at.
    """

    def __init__(self, cameras: Sequence[Camera], points: np.ndarray) -> None:
        points = points[:: -(-len(points) // MAX_POINTS)].astype(np.float64)
        self._cameras = cameras
        self._views = [*cameras, *midpoint_views(cameras)]
        depths = (view.view_space(points)[view.sees(points), 2] for view in self._views)
        self._nearest = np.array(
            [np.quantile(seen, NEAREST_QUANTILE) if len(seen) else 0.0 for seen in depths]
        )
        self._eyes = KDTree(np.array([view.center for view in self._views]))
        sides = [max(view.width / view.fx, view.height / view.fy) for view in self._views]
        self._slant = float(np.sqrt(1 + 2 * ((1 + MARGIN) * max(sides)) ** 2))
        """A point in a view lies at most this many times as far as it is deep, wherever its center is."""

    def nearest_positions(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest of the places to each of the points (N, 3): how far it is, in scene units, and which.

        Returns:
            (N,) float64 and (N,) int.
        """
        distances, places = self._eyes.query(means, workers=-1)
        return np.asarray(distances), np.asarray(places)

    def find_intruding(
        self, means: np.ndarray, distances: np.ndarray, places: np.ndarray, share: float
    ) -> np.ndarray:
        """Which points (N, 3) stand in the way: nearer than a share of what is nearest in a place's view.

        Args:
            distances, places: as :meth:`nearest_positions` gives them.

        Returns:
            (N,) bool.
        """
        found = np.zeros(len(means), bool)
        near = np.flatnonzero(distances < share * self._slant * self._nearest.max())
        points = means[near].astype(np.float64)
        for view, nearest in zip(self._views, self._nearest, strict=True):
            before = view.view_space(points)[:, 2] < share * nearest
            before[before] = view.sees(points[before], margin=MARGIN)
            found[near] |= before
        beside = distances[near] < share * self._nearest[places[near]]
        seen = np.zeros(int(beside.sum()), np.int64)
        for camera in self._cameras:
            seen += camera.sees(points[beside])
        found[near[beside]] |= seen < MIN_PHOTOS
        return found
