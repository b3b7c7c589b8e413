"""3D Scanner App's data: frame_00000.jpg and frame_00000.json for each photo.

Its poses are ARKit's camera transforms (camera to world, x right, y up, looking along -z), and its camera
matrices those of the stored photos; both are stored by rows.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from ...documents import read_bytes
from ...errors import LodgsError
from ..image_headers import image_size
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    find_image,
    invert_pose,
    parse_array,
    parse_camera_matrix,
    read_document,
)

NAME = "3D Scanner App"
_PATTERN, _POSE = "frame_*.json", "cameraPoseARFrame"
_HEAD_FILES, _HEAD_BYTES = 3, 65536


def find(folder: Path) -> Path | None:
    """Return the folder if the first files of its frames have a pose."""
    for path in islice(sorted(folder.glob(_PATTERN)), _HEAD_FILES):
        try:
            if _POSE.encode() in read_bytes(path, _HEAD_BYTES):
                return folder
        except LodgsError:
            continue
    return None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views. Frames without a photo, which have depth only, are left out."""
    views, excluded, bare = [], [], 0
    for file in sorted(path.glob(_PATTERN)):
        image = find_image(path, file.stem)
        try:
            width, height = image_size(image)
        except LodgsError:
            bare += 1
            continue
        try:
            values = read_document(file)
            fx, fy, cx, cy = parse_camera_matrix(values.get("intrinsics"))
            pose = invert_pose(parse_array(values.get(_POSE), 4, 4), opengl=True)
            views.append(ExportedView(image, colmap_lens(width, height, (fx, fy), (cx, cy)), pose))
        except LodgsError as error:
            excluded.append((file.name, error.what))
    warnings = [f"Skipped {bare:,} frames of {path} without a readable photo."] if bare else []
    return ExportedScene(views, excluded=excluded, warnings=warnings)
