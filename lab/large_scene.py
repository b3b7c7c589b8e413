"""A COLMAP scene of any number of points and photographs, by numpy alone: for `bench_blender.py --scene`."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np

TRACK = 3
"""Photographs that see each point."""
SIZE = 960, 640
_PIECE = 100_000
"""Points that are in memory at a time."""
_POINT = np.dtype([
    ("id", "<u8"), ("place", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8"),
    ("track", [("image", "<u4"), ("row", "<u4")], TRACK),
])  # fmt: skip
_SEEN = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def write_large(folder: Path, points: int, views: int, photograph: bytes) -> None:
    """Writes folder/sparse/0/*.bin, cameras on a ring that look at its middle, and folder/images.

    Args:
        points: as many as ``views`` divide.
        photograph: the file that each photograph is a link to.
    """
    model, images = folder / "sparse" / "0", folder / "images"
    model.mkdir(parents=True)
    images.mkdir()
    (folder / "one.jpg").write_bytes(photograph)
    (model / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ4d", 1, 1, 1, *SIZE, 800.0, 800.0, SIZE[0] / 2, SIZE[1] / 2)
    )
    each, rng = points // views, np.random.default_rng(0)
    with open(model / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", views))
        for view in range(views):
            turn = np.pi * view / views  # half of the angle, as quaternions have it; looking along -x' at 0
            head = struct.pack("<I7dI", view + 1, np.cos(turn), 0, np.sin(turn), 0, 0, 0, 10, 1)
            name = f"view_{view:05d}.jpg"
            seen = np.empty(each * TRACK, _SEEN)
            seen["pixel"] = rng.uniform(0, SIZE, (len(seen), 2))
            owners = (view - np.arange(TRACK)) % views  # each point is seen by its view and the next ones
            seen["point"] = 1 + (owners[None] * each + np.arange(each)[:, None]).ravel()
            file.write(head + name.encode() + b"\0" + struct.pack("<Q", len(seen)) + seen.tobytes())
            os.link(folder / "one.jpg", images / name)
    with open(model / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", points))
        for first in range(0, points, _PIECE):
            ids = np.arange(first, min(first + _PIECE, points))
            rows = np.zeros(len(ids), _POINT)
            rows["id"], rows["length"], rows["error"] = ids + 1, TRACK, 0.5
            rows["place"] = rng.normal(0, 1, (len(ids), 3))
            rows["color"] = rng.integers(0, 256, (len(ids), 3))
            for place in range(TRACK):
                rows["track"]["image"][:, place] = (ids // each + place) % views + 1
                rows["track"]["row"][:, place] = ids % each * TRACK + place
            file.write(rows.tobytes())
