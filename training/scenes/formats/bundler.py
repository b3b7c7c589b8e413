"""Bundler's bundle.out with its list of photographs, which many programs write.

Facts: the manual of Bundler v0.4 (https://www.cs.cornell.edu/~snavely/bundler/): P = R X + t, looking along
-z, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the photograph, y up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...documents import open_file
from ...errors import LodgsError
from ..images import image_size
from ..model import intrinsics
from .views import OPENGL, Exported, View, find_image, world_to_camera

NAME = "Bundler"
MOST_BYTES = 1 << 28
"""Of a file that is read."""
_LISTS = "list.txt", "bundle.out.list.txt", "image_list.txt"


def find(folder: Path) -> Path | None:
    """bundle.out, in the folder or in ``bundle``, if a list stands near it."""
    for path in (folder / "bundle.out", folder / "bundle" / "bundle.out"):
        if path.is_file() and _list_of(path) is not None:
            return path
    return None


def read(path: Path) -> Exported:
    """Views and points.

    Raises:
        LodgsError: a file is damaged.
    """
    names = _names(path)
    try:
        with open_file(path) as file:
            data = file.read(MOST_BYTES + 1)
        head, _, rest = data.partition(b"\n")
        if not head.startswith(b"# Bundle file v0.3") or len(data) > MOST_BYTES:
            raise ValueError("it is not of version 0.3, or too large")
        values = np.array(rest.split(), np.float64)
        count, points = int(values[0]), int(values[1])
        cameras = values[2 : 2 + 15 * count].reshape(count, 15)
        places = _records(values[2 + 15 * count :], points)
    except (ValueError, IndexError, OverflowError) as error:
        raise LodgsError(f"{path} is damaged or cut short ({error}).", "Export it again.") from error
    if len(names) < count:
        raise LodgsError(f"The list of {path} names {len(names)} of {count}.", "Export both again.")
    views, left_out = [], []
    for name, (focal, k1, k2, *pose) in zip(names, cameras, strict=False):
        image = find_image(_root(path), name)
        try:
            if not focal > 0:
                raise LodgsError("Bundler has found no camera of it.")
            width, height = image_size(image)
            lens = intrinsics("RADIAL", width, height, np.array([focal, width / 2, height / 2, k1, k2]))
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = np.reshape(pose[:9], (3, 3)), pose[9:]
            views.append(View(image, lens, world_to_camera(np.linalg.inv(OPENGL @ matrix))))
        except (LodgsError, ValueError, np.linalg.LinAlgError) as error:
            left_out.append((name, error.what if isinstance(error, LodgsError) else f"{error}."))
    return Exported(views, places[:, :3], places[:, 3:].clip(0, 255).astype(np.uint8), left_out)


def _records(values: np.ndarray, count: int) -> np.ndarray:
    """(count, 6) places and colours; behind each are the length of a list of views, and four numbers each."""
    rows, at = np.empty((count, 6)), 0
    for row in rows:  # each tells where the next begins
        row[:] = values[at : at + 6]
        at += 7 + 4 * int(values[at + 6])
    if at > len(values):
        raise ValueError("it ends within a point")
    return rows


def _list_of(path: Path) -> Path | None:
    there = (place / name for place in (path.parent, path.parent.parent) for name in _LISTS)
    return next((each for each in there if each.is_file()), None)


def _root(path: Path) -> Path:
    """The folder that the list stands in, whose names are relative to it."""
    there = _list_of(path)
    return path.parent if there is None else there.parent


def _names(path: Path) -> list[str]:
    there = _list_of(path)
    if there is None:
        raise LodgsError(f"Beside {path} is no list of photographs.", f"Put {_LISTS[0]} there.")
    with open_file(there) as file:
        text = file.read(MOST_BYTES).decode("utf-8", "replace")
    return [line.split()[0] for line in text.splitlines() if line.strip()]
