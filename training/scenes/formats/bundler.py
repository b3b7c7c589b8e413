"""Bundler's bundle.out with its list of photographs, which many programs write.

Facts: the manual of Bundler v0.4 (https://www.cs.cornell.edu/~snavely/bundler/): P = R X + t, looking along
-z, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the photograph, y up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...documents import open_file
from ...errors import LodgsError
from ..colmap_model import make_intrinsics
from ..images import image_size
from .exported import OPENGL, ExportedScene, ExportedView, find_image, invert_pose

NAME = "Bundler"
MOST_BYTES = 1 << 28
"""Of a file that is read."""
_LINE = re.compile(r"(\s+0)?(\s+[-+.\deE]+)?$")
"""What may follow the name in a list: a 0 and the focal length that was known before."""
_LISTS = "list.txt", "bundle.out.list.txt", "image_list.txt"


def find(folder: Path) -> Path | None:
    """bundle.out, in the folder or in ``bundle``, if a list stands near it."""
    for path in (folder / "bundle.out", folder / "bundle" / "bundle.out"):
        if path.is_file() and _list_of(path) is not None:
            return path
    return None


def read(path: Path) -> ExportedScene:
    """Views and points.

    Raises:
        LodgsError: a file is damaged.
    """
    names = _names(path)
    try:
        with open_file(path) as file:
            data = file.read(MOST_BYTES + 1)
        head, *lines = filter(None, map(bytes.strip, data.split(b"\n")))
        if not head.startswith(b"# Bundle file v0.3") or len(data) > MOST_BYTES:
            raise ValueError("it is not of version 0.3, or too large")
        count, points = map(int, lines[0].split())
        cameras = _numbers(lines[1 : 1 + 5 * count], (count, 15))
        # of each point three lines: its place, its colour, and the views that see it
        places, colors = (_numbers(lines[1 + 5 * count + n :: 3], (points, 3)) for n in range(2))
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
            lens = make_intrinsics("RADIAL", width, height, np.array([focal, width / 2, height / 2, k1, k2]))
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = np.reshape(pose[:9], (3, 3)), pose[9:]
            views.append(ExportedView(image, lens, invert_pose(np.linalg.inv(OPENGL @ matrix))))
        except (LodgsError, ValueError, np.linalg.LinAlgError) as error:
            left_out.append((name, error.what if isinstance(error, LodgsError) else f"{error}."))
    return ExportedScene(views, places, colors.clip(0, 255).astype(np.uint8), left_out)


def _numbers(lines: Sequence[bytes], shape: tuple[int, int]) -> np.ndarray:
    """The finite numbers of some lines, as an array."""
    found = np.array(b" ".join(lines).split(), np.float64).reshape(shape)
    if not np.isfinite(found).all():
        raise ValueError("it has something that is no number")
    return found


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
    return [_LINE.sub("", line.strip()) for line in text.splitlines() if line.strip()]
