"""COLMAP models of cameras and points that are known exactly: of scenes that a program renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..errors import LodgsError
from .cameras import Camera

SHORTEST_TRACK, LONGEST_TRACK = 2, 4
"""Views that see a point: it is left out below the first, and no more than the last are recorded."""
_BLOCK = 1 << 24
"""Pairs of a view and a point that are thinned at a time; each takes some 30 bytes."""
DEPTH_TOLERANCE = 0.01  # relative: a point this much behind the surface that a view sees is hidden there


def visible_in(depths: np.ndarray, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a view sees points (N, 3): pixels (N, 2) and whether it does (N,).

    The pixel that a point falls on must lie at its depth, and none of the pixels about it before it, but for
    as much as the one across lies behind: at an outline they show a mixture. 1 / depth of a plane is linear
    over the picture, so that a slanted one is seen however far its depth goes within a pixel.

    Args:
        depths: (H, W) along the camera's z axis, of the surfaces in that view; its grid may be another one
            than the camera's. Of nothing they are 0, and nothing is seen beside it; or very large.
    """
    height, width = depths.shape
    pixels, depth = camera.project(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = pixels * (width / camera.width)
        inside = (depth > 0) & (places >= 1).all(1) & (places < [width - 1, height - 1]).all(1)
        places = np.where(inside[:, None], places, 1)
        x, y = np.floor(places).astype(int).T
        around = 1 / np.stack([depths[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        middle, more = around[4], 1 + DEPTH_TOLERANCE
        clear = (around <= more * np.maximum(middle, 2 * middle - around[::-1])).all(axis=0)
        across, down = (places % 1 - 0.5).T
        plane = middle + across * (around[5] - around[3]) / 2 + down * (around[7] - around[1]) / 2
        there = np.fmin(np.abs(middle * depth - 1), np.abs(plane * depth - 1)) < DEPTH_TOLERANCE
    return pixels, inside & clear & there


def thinned(visible: np.ndarray, longest: int) -> np.ndarray:
    """At most so many views, at random, of the views (V, N) that see each point: it keeps models small."""
    lottery = np.where(visible, np.random.default_rng(1).random(visible.shape), np.inf)
    return visible & (lottery.argsort(axis=0).argsort(axis=0) < longest)


def write_seen(
    scene: Path,
    cameras: Sequence[Camera],
    depths: Callable[[int], np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
) -> int:
    """As :func:`write_colmap`, of those points that SHORTEST_TRACK views see, by their depths.

    Args:
        depths: those of a view, by its number, as :func:`visible_in` takes them: one is in memory at a time.

    Returns:
        How many points that are.

    Raises:
        LodgsError: there are none.
    """
    visible = np.stack([visible_in(depths(n), view, points)[1] for n, view in enumerate(cameras)])
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    if not kept.any():
        raise LodgsError("No two views see the same.", "Give more views, or nearer ones.")
    blocks = np.array_split(visible[:, kept], -(-visible.size // _BLOCK), axis=1)
    visible = np.concatenate([thinned(block, LONGEST_TRACK) for block in blocks], axis=1)
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
