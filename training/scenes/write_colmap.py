"""Write COLMAP models of exactly known cameras and points, such as those of rendered scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..errors import LodgsError
from ..splats.origin import NO_ORIGIN
from .cameras import Camera
from .visibility import visible_points

SHORTEST_TRACK, LONGEST_TRACK = 2, 4
"""Minimum number of views of a point, and maximum number of recorded observations per point."""
_BLOCK = 1 << 24
"""Number of (view, point) pairs thinned at a time, at about 30 bytes per pair."""


def thin_tracks(visible: np.ndarray, longest: int) -> np.ndarray:
    """Keep at most ``longest`` random views per point of a visibility mask (V, N), for small models."""
    lottery = np.where(visible, np.random.default_rng(1).random(visible.shape), np.inf)
    return visible & (lottery.argsort(axis=0).argsort(axis=0) < longest)


def write_visible_points(
    scene: Path,
    cameras: Sequence[Camera],
    depths: Callable[[int], np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
    origin: np.ndarray = NO_ORIGIN,
) -> int:
    """Write a model as :func:`write_colmap` of the points visible in at least SHORTEST_TRACK views.

    Args:
        depths: returns the depth map of a view by index, see :func:`visible_points`; one is in memory at a
            time.
        origin: (3,) local origin of the cameras and points, which the model adds.

    Returns:
        The number of written points.

    Raises:
        LodgsError: no point is visible in enough views.
    """
    visible = np.stack([visible_points(depths(n), view, points)[1] for n, view in enumerate(cameras)])
    shared = visible.sum(axis=0) >= SHORTEST_TRACK
    if not shared.any():
        raise LodgsError(
            "Cannot create a COLMAP model: no two views show the same surface.",
            "Add views, or move them closer.",
        )
    blocks = np.array_split(visible[:, shared], -(-visible.size // _BLOCK), axis=1)
    visible = np.concatenate([thin_tracks(block, LONGEST_TRACK) for block in blocks], axis=1)
    cameras = [camera.moved(origin) for camera in cameras]
    write_colmap(scene, cameras, points[shared] + origin, visible, colors[shared])
    return int(shared.sum())


def write_colmap(
    scene: Path,
    cameras: Sequence[Camera],
    points: np.ndarray,
    visible: np.ndarray,
    colors: np.ndarray,
) -> pycolmap.Reconstruction:
    """Write the model scene/sparse/0/*.bin. The caller writes the images.

    Args:
        scene: scene folder.
        cameras: V views named like their images.
        points: (N, 3) world positions.
        visible: (V, N) mask of the observations to record.
        colors: (N, 3) in [0, 255].
    """
    model = pycolmap.Reconstruction()
    lens_ids: dict[tuple, int] = {}
    for number, camera in enumerate(cameras):
        lens = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        if lens not in lens_ids:
            lens_ids[lens] = len(lens_ids) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE", width=camera.width, height=camera.height, params=lens[2:],
                    camera_id=lens_ids[lens],
                )
            )  # fmt: skip
        pixels, _ = camera.project(points[visible[number]])
        image = pycolmap.Image(
            name=camera.name, keypoints=pixels, camera_id=lens_ids[lens], image_id=number + 1
        )  # fmt: skip
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.world_to_camera[:3]))
    keypoints = np.cumsum(visible, axis=1) - 1  # index of each observation in its image
    for index, (point, color) in enumerate(zip(points, np.round(colors).astype(np.uint8), strict=True)):
        track = pycolmap.Track()
        for view in np.flatnonzero(visible[:, index]):
            track.add_element(int(view) + 1, int(keypoints[view, index]))
        model.add_point3D(point, track, color)
    model.update_point_3d_errors()

    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    for extra in ("rigs.bin", "frames.bin"):  # readers recreate trivial rigs
        (folder / extra).unlink(missing_ok=True)
    return model
