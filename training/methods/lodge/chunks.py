"""Chunks: fixed splat sets for parts of the space around the cameras (LODGE, Sec. 3, Eq. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from ...lod.rules.chunks import MAX_CHUNKS
from ...scenes.cameras import Camera
from .composite import IndexedLevel, LevelStack, Rows, gather_rows, rows_at_distances

RANDOM_TURNS = 4
"""Number of random orientations per camera for the visibility from a chunk (the paper gives no number)."""


def chunk_count(positions: np.ndarray, d_1: float) -> int:
    """Return the number of chunks of Eq. 5: 4 / d_1 times the maximum distance of cameras from their mean.

    Args:
        positions: (C, 3) of the training cameras.
        d_1: distance at which the finest level ends, in scene units.
    """
    reach = np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()
    return int(min(np.ceil(4 * reach / max(d_1, 1e-20)), MAX_CHUNKS, len(positions)))


def place_chunks(positions: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Place chunks by k-means on camera positions (C, 3).

    Returns:
        Centres (K, 3) and radii (K,) float32, in scene units. The radius is the distance to the closest
            other centre, or to the farthest of the chunk's own cameras if that is larger. K is at most
            ``count``.
    """
    rng = np.random.default_rng([seed, 10])
    centers, _ = kmeans2(positions, count, minit="++", rng=rng, iter=30, missing="warn")
    distances = np.linalg.norm(positions[:, None] - centers, axis=2)
    centers = centers[np.unique(distances.argmin(axis=1))]  # drop chunks without cameras
    distances = np.linalg.norm(positions[:, None] - centers, axis=2)
    nearest, own_distance = distances.argmin(axis=1), distances.min(axis=1)
    radii = np.zeros(len(centers))
    np.maximum.at(radii, nearest, own_distance)
    if len(centers) > 1:
        between = np.linalg.norm(centers[:, None] - centers, axis=2)
        np.fill_diagonal(between, np.inf)
        radii = np.maximum(radii, between.min(axis=1))
    return centers.astype(np.float32), radii.astype(np.float32)


def chunk_rows(
    levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], center: np.ndarray, radius: float
) -> Rows:
    """Return the rows of each level in a chunk's set: Eq. 2 at its centre, with distances increased by its
    radius.

    The increase ensures that no camera in the chunk gets a level below the level's own distance.
    """
    finest = max(levels)
    offset = {number: d_l[number] + (radius if number != finest else 0.0) for number in levels}
    return rows_at_distances(levels, offset, center)


def cameras_near(cameras: Sequence[Camera], centers: np.ndarray, chunk: int) -> list[Camera]:
    """Return the cameras that have this chunk among their two nearest."""
    distances = np.linalg.norm(np.array([camera.center for camera in cameras])[:, None] - centers, axis=2)
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :2]
    return [camera for camera, near in zip(cameras, nearest, strict=True) if chunk in near]


def turn_cameras(cameras: Sequence[Camera], rng: np.random.Generator) -> list[Camera]:
    """Return RANDOM_TURNS randomly oriented copies of each camera, at the same position."""
    turned = []
    for camera in cameras:
        for rotation in Rotation.random(RANDOM_TURNS, rng).as_matrix():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, -rotation @ camera.center
            turned.append(replace(camera, world_to_camera=pose, image=None))
    return turned


def prune_invisible(
    levels: Mapping[int, IndexedLevel],
    rows: Rows,
    cameras: Sequence[Camera],
    min_share: float,
    near: float,
    backend: str,
    antialias: bool = False,
) -> Rows:
    """Return the rows of a chunk's set that contribute enough to the images of cameras.

    Args:
        rows: rows of the set by level.
        min_share: minimum share of a pixel of a splat, in any image.
        near: depth of the near plane.
    """
    chunk_levels = {
        number: IndexedLevel.of(gather_rows({number: level}, {number: rows[number]}))
        for number, level in levels.items()
    }
    stack = LevelStack(chunk_levels, antialias)
    views = (
        (camera, {number: level.in_view(camera, near) for number, level in chunk_levels.items()})
        for camera in cameras
    )
    keep = (stack.importance(views, near, backend) >= min_share).numpy()
    return {number: level_rows[keep[stack.slices[number]]] for number, level_rows in rows.items()}
