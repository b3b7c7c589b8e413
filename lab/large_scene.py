"""Generate a COLMAP scene with any number of points and photos, for `bench_blender.py --scene`."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

TRACK = 3
"""Number of photos that see each point."""
SIZE = 960, 640
_PIECE = 100_000
"""Number of points in memory at a time."""
_POINT = np.dtype([
    ("id", "<u8"), ("place", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8"),
    ("track", [("image", "<u4"), ("row", "<u4")], TRACK),
])  # fmt: skip
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def write_large(folder: Path, points: int, views: int, photo: bytes) -> None:
    """Write folder/sparse/0/*.bin with cameras on a ring that look at its centre, and folder/images.

    Args:
        folder: the scene.
        points: number of points, a multiple of ``views``.
        views: number of photos.
        photo: content of the file to which all photos are links.
    """
    model, images = folder / "sparse" / "0", folder / "images"
    model.mkdir(parents=True)
    images.mkdir()
    (folder / "one.jpg").write_bytes(photo)
    (model / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ4d", 1, 1, 1, *SIZE, 800.0, 800.0, SIZE[0] / 2, SIZE[1] / 2)
    )
    per_view, rng = points // views, np.random.default_rng(0)
    with open(model / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", views))
        for view in range(views):
            half_angle = np.pi * view / views  # of the rotation, for the quaternion
            head = struct.pack("<I7dI", view + 1, np.cos(half_angle), 0, np.sin(half_angle), 0, 0, 0, 10, 1)
            name = f"view_{view:05d}.jpg"
            observations = np.empty(per_view * TRACK, _OBSERVATION)
            observations["pixel"] = rng.uniform(0, SIZE, (len(observations), 2))
            owners = (
                view - np.arange(TRACK)
            ) % views  # each point is seen by its view and the following ones
            observations["point"] = 1 + (owners[None] * per_view + np.arange(per_view)[:, None]).ravel()
            file.write(
                head + name.encode() + b"\0" + struct.pack("<Q", len(observations)) + observations.tobytes()
            )
            os.link(folder / "one.jpg", images / name)
    with open(model / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", points))
        for first in range(0, points, _PIECE):
            ids = np.arange(first, min(first + _PIECE, points))
            rows = np.zeros(len(ids), _POINT)
            rows["id"], rows["length"], rows["error"] = ids + 1, TRACK, 0.5
            rows["place"] = rng.normal(0, 1, (len(ids), 3))
            rows["color"] = rng.integers(0, 256, (len(ids), 3))
            for index in range(TRACK):
                rows["track"]["image"][:, index] = (ids // per_view + index) % views + 1
                rows["track"]["row"][:, index] = ids % per_view * TRACK + index
            file.write(rows.tobytes())
