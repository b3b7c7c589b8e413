"""Chunks: fixed sets of splats for parts of the space that cameras were in (LODGE, Sec. 3, Eq. 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from ...lod.rules.chunks import MAX_CHUNKS
from ...scenes.cameras import Camera
from .composite import IndexedLevel, Rows, Stack, rows_at_distances, together

FEWEST = 8
"""Fewer chunks than these, by Eq. 5, are as large as the scene: distances from the eye choose better."""
TURNS = 4
"""Random orientations beside each camera's own, for what a chunk's eyes may see (the paper: some)."""


def chunk_count(centers: np.ndarray, d_1: float) -> int:
    """How many chunks Eq. 5 asks for: 4 / d_1 times the cameras' largest distance from their mean.

    Args:
        centers: (C, 3) of the training cameras.
        d_1: the distance at which the finest level ends, in scene units.
    """
    reach = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    return int(min(np.ceil(4 * reach / max(d_1, 1e-20)), MAX_CHUNKS, len(centers)))


def place_chunks(centers: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Chunks by k-means on camera centers (C, 3).

    Returns:
        Their centres (K, 3) and radii (K,) float32, in scene units: the distance to the next closest centre,
        or to the farthest of its own cameras where that is more. K is at most ``count``.
    """
    rng = np.random.default_rng([seed, 10])
    found, _ = kmeans2(centers, count, minit="++", rng=rng, iter=30, missing="warn")
    away = np.linalg.norm(centers[:, None] - found, axis=2)
    found = found[np.unique(away.argmin(axis=1))]  # those that have cameras
    away = np.linalg.norm(centers[:, None] - found, axis=2)
    nearest, own = away.argmin(axis=1), away.min(axis=1)
    radii = np.zeros(len(found))
    np.maximum.at(radii, nearest, own)
    if len(found) > 1:
        between = np.linalg.norm(found[:, None] - found, axis=2)
        np.fill_diagonal(between, np.inf)
        radii = np.maximum(radii, between.min(axis=1))
    return found.astype(np.float32), radii.astype(np.float32)


def members(
    levels: Mapping[int, IndexedLevel], d_l: Mapping[int, float], centre: np.ndarray, radius: float
) -> Rows:
    """The rows of each level in a chunk's set: Eq. 2 at its centre, with distances larger by its radius.

    So no eye in the chunk is shown a level from nearer than the level's own distance.
    """
    finest = max(levels)
    offset = {number: d_l[number] + (radius if number != finest else 0.0) for number in levels}
    return rows_at_distances(levels, offset, centre)


def cameras_near(cameras: Sequence[Camera], centres: np.ndarray, chunk: int) -> list[Camera]:
    """The cameras of which a chunk is one of the two nearest."""
    away = np.linalg.norm(np.array([camera.center for camera in cameras])[:, None] - centres, axis=2)
    two = np.argsort(away, axis=1, kind="stable")[:, :2]
    return [camera for camera, near in zip(cameras, two, strict=True) if chunk in near]


def turned(cameras: Sequence[Camera], rng: np.random.Generator) -> list[Camera]:
    """Cameras at the same places, TURNS each, that look anywhere."""
    found = []
    for camera in cameras:
        for rotation in Rotation.random(TURNS, rng).as_matrix():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, -rotation @ camera.center
            found.append(replace(camera, world_to_camera=pose, image=None))
    return found


def visible(
    levels: Mapping[int, IndexedLevel],
    rows: Rows,
    cameras: Sequence[Camera],
    least: float,
    near: float,
    backend: str,
    antialias: bool = False,
) -> Rows:
    """Those rows of a chunk's set that have at least this share of some pixel of the cameras' images."""
    chosen = {
        number: IndexedLevel.of(together({number: level}, {number: rows[number]}))
        for number, level in levels.items()
    }
    stack = Stack(chosen, antialias)
    pictures = (
        (camera, {number: level.in_view(camera, near) for number, level in chosen.items()})
        for camera in cameras
    )
    kept = (stack.importance(pictures, near, backend) >= least).numpy()
    return {number: some[kept[stack.part[number]]] for number, some in rows.items()}
