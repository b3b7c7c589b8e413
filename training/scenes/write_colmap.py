"""COLMAP models of cameras and points that are known exactly: of scenes that a program renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..errors import LodgsError
from .cameras import Camera
from .visibility import visible_points

SHORTEST_TRACK, LONGEST_TRACK = 2, 4
"""Views that see a point: it is left out below the first, and no more than the last are recorded."""
_BLOCK = 1 << 24
"""Pairs of a view and a point that are thinned at a time; each takes some 30 bytes."""


def thin_tracks(visible: np.ndarray, longest: int) -> np.ndarray:
    """At most so many views, at random, of the views (V, N) that see each point: it keeps models small."""
    lottery = np.where(visible, np.random.default_rng(1).random(visible.shape), np.inf)
    return visible & (lottery.argsort(axis=0).argsort(axis=0) < longest)


def write_visible_points(
    scene: Path,
    cameras: Sequence[Camera],
    depths: Callable[[int], np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
) -> int:
    """As :func:`write_colmap`, of those points that SHORTEST_TRACK views see, by their depths.

    Args:
        depths: those of a view, by its number, as :func:`visible_points` takes them: one is in memory at a time.

    Returns:
        How many points that are.

    Raises:
        LodgsError: there are none.
    """
    visible = np.stack([visible_points(depths(n), view, points)[1] for n, view in enumerate(cameras)])
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    if not kept.any():
        raise LodgsError("No two views see the same.", "Give more views, or nearer ones.")
    blocks = np.array_split(visible[:, kept], -(-visible.size // _BLOCK), axis=1)
    visible = np.concatenate([thin_tracks(block, LONGEST_TRACK) for block in blocks], axis=1)
    write_colmap(scene, cameras, points[kept], visible, colors[kept])
    return int(kept.sum())


def write_colmap(
    scene: Path,
    cameras: Sequence[Camera],
    points: np.ndarray,
    visible: np.ndarray,
    colors: np.ndarray,
) -> pycolmap.Reconstruction:
    """Writes the model scene/sparse/0/*.bin; the images themselves are the caller's.

    Args:
        scene: its folder.
        cameras: V views; their names are those of the images.
        points: (N, 3) in the world.
        visible: (V, N), which observations the tracks hold.
        colors: (N, 3) in [0, 255].
    """
    model, lenses = pycolmap.Reconstruction(), {}
    for number, each in enumerate(cameras):
        lens = each.width, each.height, each.fx, each.fy, each.cx, each.cy
        if lens not in lenses:
            lenses[lens] = len(lenses) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE", width=each.width, height=each.height, params=lens[2:],
                    camera_id=lenses[lens],
                )
            )  # fmt: skip
        pixels, _ = each.project(points[visible[number]])
        image = pycolmap.Image(
            name=each.name, keypoints=pixels, camera_id=lenses[lens], image_id=number + 1
        )  # fmt: skip
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(each.world_to_camera[:3]))
    rows = np.cumsum(visible, axis=1) - 1  # number of each observation within its image
    for index, (point, color) in enumerate(zip(points, np.round(colors).astype(np.uint8), strict=True)):
        track = pycolmap.Track()
        for view in np.flatnonzero(visible[:, index]):
            track.add_element(int(view) + 1, int(rows[view, index]))
        model.add_point3D(point, track, color)
    model.update_point_3d_errors()

    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    for extra in ("rigs.bin", "frames.bin"):  # cameras without rigs: readers make these themselves
        (folder / extra).unlink(missing_ok=True)
    return model
