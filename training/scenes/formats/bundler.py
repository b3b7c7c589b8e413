"""Bundler's bundle.out with its list of photos, a format that many programs write.

Format: the manual of Bundler v0.4 (https://www.cs.cornell.edu/~snavely/bundler/): P = R X + t, looking along
-z, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the photo, y up.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np

from ...documents import damage_error, decode_text, open_file, open_lines, read_lines
from ...errors import LodgsError
from ..image_headers import image_size
from ..lenses import make_intrinsics
from .exported import OPENGL, ExportedScene, ExportedView, PhotoFinder, find_file, finite_points, invert_pose

NAME = "Bundler"
_VERSION = b"# Bundle file v0.3"
_MAX_LINE = 1 << 24
_MAX_LIST = 1 << 26
"""Maximum bytes of a line, and of the list of photos."""
_NUMBER = re.compile(r"[-+.\deE]+")
_LISTS = "list.txt", "bundle.out.list.txt", "image_list.txt", "imagelist.lst", "list.rd.txt"
"""Names of the list; RealityCapture writes imagelist.lst, RadialUndistort list.rd.txt."""


def find(folder: Path) -> Path | None:
    """Return the path of bundle.out, in the folder or in ``bundle``, if there is a list near it.

    Without such a file, the only other Bundler file of these folders with a list is returned.
    """
    folders = folder, folder / "bundle"
    for path in (find_file(parent, "bundle.out") for parent in folders):
        if path is not None and _find_list(path) is not None:
            return path
    others = [path for parent in folders for path in sorted(parent.glob("*.out")) if _is_bundle(path)]
    return others[0] if len(others) == 1 and _find_list(others[0]) is not None else None


def _is_bundle(path: Path) -> bool:
    try:
        with open_lines(path) as file:
            return file.read(len(_VERSION)) == _VERSION
    except LodgsError:
        return False


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views and the points.

    Raises:
        LodgsError: a file is damaged.
    """
    names = _read_names(path)
    try:
        with open_lines(path) as file:
            lines = filter(None, map(bytes.strip, read_lines(file, _MAX_LINE)))
            if not next(lines, b"").startswith(_VERSION):
                raise ValueError("its version is not 0.3")
            count, rows = map(int, next(lines, b"").split())
            cameras = _parse_numbers(islice(lines, 5 * count), (count, 15))
            # Each point has three lines: position, colour, and the views that see it.
            records = (first + b" " + second for first, second, _ in zip(lines, lines, lines, strict=True))
            table = _parse_numbers(islice(records, rows + 1), (rows, 6))
        points, colors = table[:, :3], np.nan_to_num(table[:, 3:].clip(0, 255)).astype(np.uint8)
    except (ValueError, IndexError, OverflowError) as error:
        raise damage_error(path, error, "Export it again.") from error
    if len(names) < count:
        raise LodgsError(
            f"Cannot read {path}: it has {count} cameras, but its list has {len(names)} photos.",
            "Export both files again.",
        )
    views, excluded = [], []
    root = _image_root(path)
    photos = PhotoFinder(names, [root], folder if root.is_relative_to(folder) else root)
    for name, (focal, k1, k2, *pose) in zip(names, cameras, strict=False):
        try:
            if not focal > 0:
                raise LodgsError("Bundler has no camera for it.")
            image = photos.find(name)
            width, height = image_size(image)
            lens = make_intrinsics("RADIAL", width, height, np.array([focal, width / 2, height / 2, k1, k2]))
            matrix = np.eye(4)
            matrix[:3, :3] = np.reshape(pose[:9], (3, 3))
            matrix[:3, 3] = pose[9:]
            views.append(ExportedView(image, lens, invert_pose(np.linalg.inv(OPENGL @ matrix))))
        except (LodgsError, ValueError, np.linalg.LinAlgError) as error:
            excluded.append((name, error.what if isinstance(error, LodgsError) else f"{error}."))
    warnings = photos.warnings()
    points, colors = finite_points(path, points, colors, warnings)
    return ExportedScene(views, points, colors, excluded, warnings)


def _parse_numbers(lines: Iterable[bytes], shape: tuple[int, int]) -> np.ndarray:
    """Return the numbers of the lines as an array."""
    values = array("d")
    for line in lines:
        values.extend(map(float, line.split()))
    return np.array(values).reshape(shape)


def _find_list(path: Path) -> Path | None:
    names = *_LISTS, f"{path.name}.list.txt"
    return find_file(path.parent, *names) or find_file(path.parent.parent, *names)


def _image_root(path: Path) -> Path:
    """Return the folder of the list; its names are relative to this folder."""
    list_file = _find_list(path)
    return path.parent if list_file is None else list_file.parent


def _read_names(path: Path) -> list[str]:
    list_file = _find_list(path)
    if list_file is None:
        raise LodgsError(f"Cannot read {path}: there is no list of photos.", f"Add {_LISTS[0]} next to it.")
    with open_file(list_file) as file:
        text = decode_text(file.read(_MAX_LIST))
    return [_photo_name(line.strip()).strip('"') for line in text.splitlines() if line.strip()]


def _photo_name(line: str) -> str:
    """Return a line of the list without its optional end: a 0 and the initial focal length."""
    parts = line.rsplit(maxsplit=2)
    if len(parts) == 3 and parts[1] == "0" and _NUMBER.fullmatch(parts[2]):
        return parts[0]
    parts = line.rsplit(maxsplit=1)
    return parts[0] if len(parts) == 2 and _NUMBER.fullmatch(parts[1]) else line
