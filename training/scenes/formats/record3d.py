"""Record3D exports and unpacked .r3d files: metadata of all frames in one JSON file, photos in ``rgb(d)``.

Format: https://record3d.app (poses as quaternion xyzw and position, camera to world, OpenGL axes; K by
columns; perFrameIntrinsicCoeffs as fx, fy, cx, cy of each frame).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ..colmap_model import rotation_matrix
from ..images import IMAGE_SUFFIXES
from ..lenses import Intrinsics
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    find_file,
    get_number,
    invert_pose,
    parse_array,
    parse_camera_matrix,
    read_document,
    visible_files,
)

NAME = "Record3D"
_PHOTOS = "rgb", "rgbd"


def find(folder: Path) -> Path | None:
    """Return the metadata file if there is a folder of photos next to it."""
    path = find_file(folder, "metadata", "metadata.json")
    return path if path is not None and _photo_folder(path) else None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views. The photos in numeric order match the poses; if photos are missing, their names do.

    Raises:
        LodgsError: the file is damaged, or photos are missing and the names are not numbers.
    """
    document = read_document(path)
    try:
        poses = parse_array(document.get("poses"), -1, 7, finite=False)
        lenses = _parse_lenses(document, len(poses))
    except LodgsError as error:
        raise LodgsError(f"Cannot read {path}: {error.what}", "Export it again.") from error
    folder = _photo_folder(path) or path.parent
    files = [file for file in visible_files(folder) if file.suffix.lower() in IMAGE_SUFFIXES]
    files.sort(key=lambda file: (len(file.stem), file.stem))
    by_number = dict(enumerate(files))
    if len(files) != len(poses):
        if not all(file.stem.isdecimal() for file in files):
            raise LodgsError(
                f"Cannot read {path}: it has {len(poses)} poses, but {folder} has {len(files)} photos.",
                "Export it again, or name the photos by frame number, starting with 0.jpg.",
            )
        by_number = {int(file.stem): file for file in files}
    views, excluded = [], []
    for number, pose in enumerate(poses):
        file = by_number.get(number)
        if file is None:
            excluded.append((f"frame {number}", "it has no photo."))
            continue
        try:
            lens = _parse_lens(document, lenses[number])
            views.append(ExportedView(file, lens, invert_pose(_pose_matrix(pose), opengl=True)))
        except LodgsError as error:
            excluded.append((file.name, error.what))
    return ExportedScene(views, excluded=excluded)


def _photo_folder(path: Path) -> Path | None:
    """Return the folder of the photos next to the metadata file, or None."""
    return next((path.parent / name for name in _PHOTOS if (path.parent / name).is_dir()), None)


def _parse_lenses(document: dict, count: int) -> np.ndarray:
    """Return fx, fy, cx, cy of each frame (count, 4), possibly not finite; by default those of all frames.

    Raises:
        LodgsError: if values are missing.
    """
    frames = document.get("perFrameIntrinsicCoeffs") or []
    coefficients = [frame[:4] for frame in frames] if _is_table(frames) else []
    if len(coefficients) not in (0, count):
        raise LodgsError(f"it has {count} poses, but {len(coefficients)} perFrameIntrinsicCoeffs.")
    if coefficients:
        return parse_array(coefficients, count, 4, finite=False)
    return np.tile(parse_camera_matrix(document.get("K")), (count, 1))


def _parse_lens(document: dict, coefficients: np.ndarray) -> Intrinsics:
    """Return the lens of one frame.

    Raises:
        LodgsError: if a value is missing or invalid.
    """
    fx, fy, cx, cy = coefficients.tolist()
    return colmap_lens(get_number(document, "w"), get_number(document, "h"), (fx, fy), (cx, cy))


def _is_table(frames: object) -> bool:
    """Return True for a list of lists; raise LodgsError for other values."""
    if not (isinstance(frames, list) and all(isinstance(frame, list) for frame in frames)):
        raise LodgsError("its perFrameIntrinsicCoeffs are not a list of fx, fy, cx, cy.")
    return bool(frames)


def _pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 4) of qx, qy, qz, qw and a position.

    Raises:
        LodgsError: the quaternion is 0, or a value is not finite.
    """
    if not (pose[:4].any() and np.isfinite(pose).all()):
        raise LodgsError("its pose is not a rotation and translation.")
    return np.column_stack([rotation_matrix(pose[[3, 0, 1, 2]]), pose[4:]])
