"""Free space around the training cameras and along their rays, and the bounds on splats that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from math import inf

import numpy as np
import torch
from scipy.spatial import KDTree

from ..scenes.cameras import Camera
from ..scenes.colmap import Scene
from .density_control import require_rows
from .model import Model
from .neighbors import query_neighbors
from .observed_depths import photo_parts

NEIGHBORS = (1, 2, 4)
"""Ranks of the neighbours of a camera to form midpoints with."""
PRUNE_INTERVAL, SETTLED_INTERVAL = 50, 200
"""Steps between two removals of unsupported splats, during density control and after it."""
NEAREST_QUANTILE = 0.01
"""Quantile of point depths used as a view's nearest depth, which ignores outliers."""
MARGIN = 0.1
"""Widening of a view on every side, as a share of its image."""
MAX_POINTS = 20_000
"""Maximum number of scene points to test."""
FREE_SHARE = 0.7
"""Share of the depth of observed points in front of which no splat may stand."""
POINT_DISTANCE = 0.03
"""Distance from a scene point up to which splats are supported, as a fraction of their depth."""
MAX_PHOTOS, MAX_TESTS = 8, 500_000
"""Maximum numbers of photos whose observed points are tested at a time, and of pairs of splat and photo."""
MAX_SUPPORTING_POINTS = 200_000
"""Maximum number of scene points that support splats."""
MIN_PHOTOS = 2
"""Photos that have to see a splat near a camera outside its frame."""


def midpoint_views(cameras: Sequence[Camera]) -> list[Camera]:
    """Create views at the midpoints between each camera and its 1st, 2nd and 4th nearest neighbours.

    Views keep the camera's rotation. Ranks beyond the number of cameras are skipped.
    """
    centers = np.array([camera.center for camera in cameras])
    views = []
    order = np.asarray(KDTree(centers).query(centers, k=1 + max(NEIGHBORS))[1])  # column 0: the camera
    for camera, neighbors in zip(cameras, order[:, list(NEIGHBORS)], strict=True):
        for neighbor in neighbors[neighbors < len(cameras)]:  # scipy numbers missing ones beyond the end
            pose = camera.world_to_camera.copy()
            pose[:3, 3] = -pose[:3, :3] @ (camera.center + centers[neighbor]) / 2
            views.append(replace(camera, world_to_camera=pose, image=None))
    return views


class Support:
    """Free space that the photographer stood in and walked through.

    No splat may stand close in front of a camera, or of the midpoint of two, closer than the scene's points
    allow. Within the same distance outside the frame, splats need to be seen by two photos: a splat seen by
    one photo may lie at any depth along its rays, and would block the view of a camera that turns there.

    Args:
        cameras: training views.
        points: (P, 3) scene points; at most ``MAX_POINTS``, evenly spaced in their order, are tested.
    """

    def __init__(self, cameras: Sequence[Camera], points: np.ndarray) -> None:
        points = points[:: -(-len(points) // MAX_POINTS)].astype(np.float64)
        self._cameras = cameras
        self._views = [*cameras, *midpoint_views(cameras)]
        depths = (view.view_space(points)[view.sees(points), 2] for view in self._views)
        self._nearest = np.array(
            [np.quantile(depth, NEAREST_QUANTILE) if len(depth) else 0.0 for depth in depths]
        )
        self._positions = KDTree(np.array([view.center for view in self._views]))
        sides = [max(view.width / view.fx, view.height / view.fy) for view in self._views]
        self._slant = float(np.sqrt(1 + 2 * ((1 + MARGIN) * max(sides)) ** 2))
        """Maximum ratio of distance to depth of a point in a view, wherever its principal point is."""

    def nearest_positions(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the nearest camera or midpoint of each point (N, 3).

        Returns:
            (N,) float64 distances in scene units, and (N,) int indices of the positions.
        """
        return query_neighbors(self._positions, means)

    def find_intruding(
        self, means: np.ndarray, distances: np.ndarray, positions: np.ndarray, share: float
    ) -> np.ndarray:
        """Find points (N, 3) that are closer to a view than a share of its nearest depth.

        Args:
            distances, positions: result of :meth:`nearest_positions`.

        Returns:
            (N,) bool.
        """
        intruding = np.zeros(len(means), bool)
        near = np.flatnonzero(distances < share * self._slant * self._nearest.max())
        points = means[near].astype(np.float64)
        for view, nearest in zip(self._views, self._nearest, strict=True):
            depths = points @ view.world_to_camera[2, :3] + view.world_to_camera[2, 3]
            in_front = np.flatnonzero((depths > 0) & (depths < share * nearest))
            if len(in_front):
                intruding[near[in_front[view.sees(points[in_front], margin=MARGIN)]]] = True
        around = distances[near] < share * self._nearest[positions[near]]
        if around.any():
            photos = sum(camera.sees(points[around]).astype(np.int64) for camera in self._cameras)
            intruding[near[around]] |= photos < MIN_PHOTOS
        return intruding


class ObservedSpace:
    """Free space between photos and the points that they observe.

    A splat there explains one photo and hides what others see: a blurred veil between cameras, or something
    that moved. The depth up to which a photo's rays are free is known in parts of its image. Splats near
    scene points may be thin objects, and do not count.

    Args:
        scene: scene with its points.
        cameras: training views.
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera]) -> None:
        self._photos = [(parts.camera, parts.free_depths) for parts in photo_parts(scene, cameras)]
        self._points = KDTree(scene.points[:: -(-len(scene.points) // MAX_SUPPORTING_POINTS)])

    def find_intruding(self, means: np.ndarray, turn: int) -> np.ndarray:
        """Find points (N, 3) in front of ``FREE_SHARE`` of the free depths of some photos.

        Args:
            turn: number of the test. Consecutive tests use different photos, at most ``MAX_PHOTOS`` each.

        Returns:
            (N,) bool.
        """
        intruding = np.zeros(len(means), bool)
        tested = max(min(MAX_PHOTOS, len(self._photos), MAX_TESTS // max(len(means), 1)), 1)
        for photo in range(turn * tested, (turn + 1) * tested) if self._photos else ():
            camera, free_depths = self._photos[photo % len(self._photos)]
            rows, columns = free_depths.shape
            (x, y), depths = (values.T for values in camera.project(means))
            inside = np.flatnonzero(
                (depths > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            )
            row = (y[inside] * (rows / camera.height)).astype(np.int64)
            column = (x[inside] * (columns / camera.width)).astype(np.int64)
            in_front = inside[depths[inside] < FREE_SHARE * free_depths[row, column]]
            distances, _ = query_neighbors(self._points, means[in_front])
            intruding[in_front] |= distances > POINT_DISTANCE * depths[in_front]
        return intruding


class SupportPruning:
    """Removal of splats in free space, and limits on the size of others.

    Args:
        scene: scene with its points.
        cameras: training views.
        free_depth: share of the nearest depth that is free space; 0 disables.
        largest: maximum standard deviation of a splat, as a share of its distance from the nearest camera
            or midpoint; 0 disables.
        use_observations: also remove splats from :class:`ObservedSpace`, unless ``free_depth`` is 0.

    Attributes:
        end: step from which nothing is removed or limited.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        free_depth: float,
        largest: float,
        use_observations: bool = True,
    ) -> None:
        self._scene = scene
        self._cameras = cameras
        self._free_depth = free_depth
        self._largest = largest
        self._use_observations = use_observations
        self.end = inf

    @cached_property
    def _support(self) -> Support:
        return Support(self._cameras, self._scene.points)

    @cached_property
    def _observed_space(self) -> ObservedSpace:
        return ObservedSpace(self._scene, self._cameras)

    @torch.no_grad()
    def prune(self, model: Model, step: int, turn: int) -> None:
        """Remove splats near training views or far in front of observed points, and limit the others' size.

        Args:
            turn: see :meth:`ObservedSpace.find_intruding`.

        Raises:
            LodgsError: no splats remain.
        """
        if step >= self.end or not (self._free_depth or self._largest):
            return
        means = model.read("means").cpu().numpy()
        distances, positions = self._support.nearest_positions(means)
        if self._largest:
            sizes = np.maximum(self._largest * distances, np.finfo(np.float32).tiny)
            model.lower_log_scales(torch.from_numpy(np.log(sizes)).float())
        if self._free_depth:
            intruding = self._support.find_intruding(means, distances, positions, self._free_depth)
            if self._use_observations:
                intruding |= self._observed_space.find_intruding(means, turn)
            model.keep(torch.from_numpy(~intruding))
            require_rows(model, step, "free_depth")
