"""Write COLMAP models of known cameras and points, such as those of rendered scenes. numpy only."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import name_errors
from ..splats.origin import NO_ORIGIN
from ..splats.similarity import Similarity
from .cameras import Camera
from .colmap_model import POINT, POINT2D
from .lenses import LENSES, Intrinsics, make_intrinsics
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
) -> None:
    """Write the model scene/sparse/0/*.bin. The caller writes the images.

    Args:
        scene: scene folder.
        cameras: V views named like their images.
        points: (N, 3) world positions.
        visible: (V, N) mask of the observations to record.
        colors: (N, 3) in [0, 255].

    Raises:
        OSError: if a file cannot be written.
    """
    write_model(
        scene / "sparse" / "0",
        [
            make_intrinsics(
                "PINHOLE", view.width, view.height, np.array([view.fx, view.fy, view.cx, view.cy])
            )
            for view in cameras
        ],
        [(view.name, view.world_to_camera) for view in cameras],
        points,
        np.round(colors).astype(np.uint8),
        [
            (np.flatnonzero(is_visible), view.project(points[is_visible])[0])
            for view, is_visible in zip(cameras, visible, strict=True)
        ],
    )


def write_model(
    model: Path,
    lenses: Sequence[Intrinsics],
    poses: Sequence[tuple[str, np.ndarray]],
    points: np.ndarray,
    colors: np.ndarray,
    observations: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> None:
    """Write a binary model completely or not at all.

    Args:
        model: new folder.
        lenses: lens of each view.
        poses: name and world_to_camera (4, 4) of each view.
        points: (P, 3) positions.
        colors: (P, 3) uint8.
        observations: indices (O,) of the points that each view sees, and their pixels (O, 2); empty for
            points without tracks.

    Raises:
        OSError: if a file cannot be written, or the folder exists and is not empty.
    """
    observations = observations or [(np.zeros(0, np.int64), np.zeros((0, 2)))] * len(poses)
    camera_ids: dict[bytes, int] = {}
    images = []
    for image_id, (lens, (name, pose), observed) in enumerate(
        zip(lenses, poses, observations, strict=True), 1
    ):
        model_id = next(number for number, known_lens in LENSES.items() if known_lens is lens.lens)
        camera = (
            struct.pack("<iQQ", model_id, lens.width, lens.height) + lens.parameters.astype("<f8").tobytes()
        )
        camera_id = camera_ids.setdefault(camera, len(camera_ids) + 1)
        values = *Similarity(pose[:3, :3], 1.0, pose[:3, 3]).quat, *pose[:3, 3]
        pixels = np.zeros(len(observed[0]), POINT2D)
        pixels["point"], pixels["xy"] = observed[0] + 1, observed[1]
        images += [
            struct.pack("<i7di", image_id, *values, camera_id),
            name.encode("utf-8", "surrogateescape") + b"\0",
            struct.pack("<Q", len(pixels)) + pixels.tobytes(),
        ]
    cameras = [struct.pack("<i", camera_id) + camera for camera, camera_id in camera_ids.items()]
    temporary = model.with_name(f".{model.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        for file, count, records in (
            ("cameras.bin", len(cameras), cameras),
            ("images.bin", len(poses), images),
            ("points3D.bin", len(points), [_point_records(points, colors, observations)]),
        ):
            with name_errors(model / file), open(temporary / file, "wb") as stream:
                stream.writelines([struct.pack("<Q", count), *records])
                stream.flush()
                os.fsync(stream.fileno())  # some disks report only now that they are full
        os.replace(temporary, model)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _point_records(
    points: np.ndarray, colors: np.ndarray, observations: Sequence[tuple[np.ndarray, np.ndarray]]
) -> bytes:
    """Return the records of points3D.bin; see :func:`write_model`. Points have the ids 1, 2, ..."""
    tracked = np.concatenate([np.zeros(0, np.int64), *(indices for indices, _ in observations)])
    entries = [
        np.column_stack([np.full(len(indices), n), np.arange(len(indices))])
        for n, (indices, _) in enumerate(observations, 1)
    ]
    track = np.concatenate([np.zeros((0, 2), np.int64), *entries]).astype("<i4")
    by_point = np.argsort(tracked, kind="stable")
    lengths = np.bincount(tracked, minlength=len(points))
    rows = np.zeros(len(points), POINT)
    rows["id"] = np.arange(1, len(points) + 1)
    rows["xyz"] = points
    rows["rgb"] = colors
    rows["track"] = lengths
    entries_before = np.concatenate([[0], np.cumsum(lengths)])[:-1]  # entries of all earlier points
    data = np.zeros(rows.nbytes + track.nbytes, np.uint8)
    starts = np.arange(len(points)) * POINT.itemsize + entries_before * 8
    data[starts[:, None] + np.arange(POINT.itemsize)] = rows.view(np.uint8).reshape(-1, POINT.itemsize)
    ends = (tracked[by_point] + 1) * POINT.itemsize + np.arange(len(track)) * 8
    data[ends[:, None] + np.arange(8)] = track[by_point].view(np.uint8).reshape(-1, 8)
    return data.tobytes()
