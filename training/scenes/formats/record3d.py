"""Record3D's export: metadata of all frames in one JSON file, photographs in ``rgb``.

Facts: https://record3d.app (poses as x, y, z, w and place, camera to world, OpenGL axes; K by columns).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ..colmap_model import rotation_matrix
from ..images import IMAGE_SUFFIXES
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    get_number,
    invert_pose,
    parse_array,
    read_document,
)

NAME = "Record3D"


def find(folder: Path) -> Path | None:
    """The file of the metadata, if photographs stand beside it."""
    there = (folder / name for name in ("metadata", "metadata.json"))
    return next((path for path in there if path.is_file() and (folder / "rgb").is_dir()), None)


def read(path: Path) -> ExportedScene:
    """Views: the n-th photograph by number has the n-th pose; if some are missing, the one of the number n.

    Raises:
        LodgsError: the file is damaged, or it is not told which photographs are missing.
    """
    told = read_document(path)
    try:
        poses = parse_array(told.get("poses"), -1, 7)
        focal_x, focal_y, *center = parse_array(told.get("K"), 3, 3).T[[0, 1, 0, 1], [0, 1, 2, 2]]
        lens = colmap_lens(
            get_number(told, "w"), get_number(told, "h"), (focal_x, focal_y), (center[0], center[1])
        )
    except LodgsError as error:
        raise LodgsError(f"{path} is damaged: {error.what}", "Export it again.") from error
    files = [file for file in (path.parent / "rgb").iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    files.sort(key=lambda file: (len(file.stem), file.stem))
    by_number = dict(enumerate(files))
    if len(files) != len(poses):
        if not all(file.stem.isdecimal() for file in files):
            raise LodgsError(
                f"{path} tells of {len(poses)} photographs, and {path.parent / 'rgb'} holds {len(files)}.",
                "Export it again, or give them their numbers as names, from 0.jpg on.",
            )
        by_number = {int(file.stem): file for file in files}
    views, left_out = [], []
    for place, pose in enumerate(poses):
        file = by_number.get(place)
        if file is None:
            left_out.append((f"frame {place}", "it has no photograph."))
            continue
        try:
            views.append(ExportedView(file, lens, invert_pose(_matrix(pose), opengl=True)))
        except LodgsError as error:
            left_out.append((file.name, error.what))
    return ExportedScene(views, left_out=left_out)


def _matrix(pose: np.ndarray) -> np.ndarray:
    """(3, 4) of qx, qy, qz, qw and a place.

    Raises:
        LodgsError: it is no rotation.
    """
    if not pose[:4].any():
        raise LodgsError("its pose is no rotation and translation.")
    return np.column_stack([rotation_matrix(pose[[3, 0, 1, 2]]), pose[4:]])
