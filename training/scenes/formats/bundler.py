"""Bundler's bundle.out with its list of photos, a format that many programs write.

Format: the manual of Bundler v0.4 (https://www.cs.cornell.edu/~snavely/bundler/): P = R X + t, looking along
-z, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the photo, y up.
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
MAX_BYTES = 1 << 28
"""Maximum size of an input file."""
_LINE_END = re.compile(r"(\s+0)?(\s+[-+.\deE]+)?$")
"""Optional end of a line in the list: a 0 and the initial focal length."""
_LISTS = "list.txt", "bundle.out.list.txt", "image_list.txt"


def find(folder: Path) -> Path | None:
    """Return the path of bundle.out, in the folder or in ``bundle``, if there is a list near it."""
    for path in (folder / "bundle.out", folder / "bundle" / "bundle.out"):
        if path.is_file() and _find_list(path) is not None:
            return path
    return None


def read(path: Path) -> ExportedScene:
    """Read the views and the points.

    Raises:
        LodgsError: a file is damaged.
    """
    names = _read_names(path)
    try:
        with open_file(path) as file:
            data = file.read(MAX_BYTES + 1)
        head, *lines = filter(None, map(bytes.strip, data.split(b"\n")))
        if not head.startswith(b"# Bundle file v0.3") or len(data) > MAX_BYTES:
            raise ValueError(f"its version is not 0.3, or it exceeds {MAX_BYTES:,} bytes")
        count, points = map(int, lines[0].split())
        cameras = _parse_numbers(lines[1 : 1 + 5 * count], (count, 15))
        # Each point has three lines: position, colour, and the views that see it.
        positions, colors = (_parse_numbers(lines[1 + 5 * count + n :: 3], (points, 3)) for n in range(2))
    except (ValueError, IndexError, OverflowError) as error:
        raise LodgsError(
            f"Cannot read {path}: the file is damaged or truncated ({error}).", "Export it again."
        ) from error
    if len(names) < count:
        raise LodgsError(
            f"Cannot read {path}: it has {count} cameras, but its list has {len(names)} photos.",
            "Export both files again.",
        )
    views, excluded = [], []
    for name, (focal, k1, k2, *pose) in zip(names, cameras, strict=False):
        image = find_image(_image_root(path), name)
        try:
            if not focal > 0:
                raise LodgsError("Bundler has no camera for it.")
            width, height = image_size(image)
            lens = make_intrinsics("RADIAL", width, height, np.array([focal, width / 2, height / 2, k1, k2]))
            matrix = np.eye(4)
            matrix[:3, :3] = np.reshape(pose[:9], (3, 3))
            matrix[:3, 3] = pose[9:]
            views.append(ExportedView(image, lens, invert_pose(np.linalg.inv(OPENGL @ matrix))))
        except (LodgsError, ValueError, np.linalg.LinAlgError) as error:
            excluded.append((name, error.what if isinstance(error, LodgsError) else f"{error}."))
    return ExportedScene(views, positions, colors.clip(0, 255).astype(np.uint8), excluded)


def _parse_numbers(lines: Sequence[bytes], shape: tuple[int, int]) -> np.ndarray:
    """Return the finite numbers of the lines as an array."""
    numbers = np.array(b" ".join(lines).split(), np.float64).reshape(shape)
    if not np.isfinite(numbers).all():
        raise ValueError("a value is not a finite number")
    return numbers


def _find_list(path: Path) -> Path | None:
    candidates = (folder / name for folder in (path.parent, path.parent.parent) for name in _LISTS)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _image_root(path: Path) -> Path:
    """Return the folder of the list; its names are relative to this folder."""
    list_file = _find_list(path)
    return path.parent if list_file is None else list_file.parent


def _read_names(path: Path) -> list[str]:
    list_file = _find_list(path)
    if list_file is None:
        raise LodgsError(f"Cannot read {path}: there is no list of photos.", f"Add {_LISTS[0]} next to it.")
    with open_file(list_file) as file:
        text = file.read(MAX_BYTES).decode("utf-8", "replace")
    return [_LINE_END.sub("", line.strip()) for line in text.splitlines() if line.strip()]
