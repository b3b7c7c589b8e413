"""Polycam's raw data: one camera in a JSON file per photo.

Format: https://github.com/PolyCam/polyform (keyframes, corrected ones, blur score).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError
from ...files import is_file
from ..image_headers import image_size
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    find_image,
    get_number,
    invert_pose,
    read_document,
)

NAME = "Polycam raw data"
MIN_SHARPNESS = 25.0
"""Minimum blur score of photos, as in nerfstudio, unless all are below."""
_FOLDERS = ("corrected_cameras", "corrected_images"), ("cameras", "images")


def find(folder: Path) -> Path | None:
    """Return the folder of the cameras, preferably corrected ones."""
    for keyframes in (folder / "keyframes", folder):
        for cameras, images in _FOLDERS:
            names = [path.name for path in (keyframes / cameras).glob("[!.]*.json")]
            if (keyframes / images).is_dir() and any(not name.startswith("transforms") for name in names):
                return keyframes / cameras
    return None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views and their depth maps in millimetres. Polycam exports no points; unreadable cameras are
    excluded.
    """
    images = path.parent / dict(_FOLDERS)[path.name]
    views, blurred, excluded = [], [], []
    for file in sorted(path.glob("[!.]*.json")):
        try:
            values = read_document(file)
            sharp = get_number(values, "blur_score", MIN_SHARPNESS) >= MIN_SHARPNESS
            image = find_image(images, file.stem)
            width, height = _photo_size(values, path.parent / "cameras" / file.name, image)
            lens = colmap_lens(
                width, height, (get_number(values, "fx"), get_number(values, "fy")),
                (get_number(values, "cx", width / 2), get_number(values, "cy", height / 2)),
            )  # fmt: skip
            rows = [[get_number(values, f"t_{row}{column}") for column in range(4)] for row in range(3)]
            pose = invert_pose(np.array(rows), opengl=True)
            depth = path.parent / "depth" / f"{file.stem}.png"
            (views if sharp else blurred).append(ExportedView(image, lens, pose, depth=depth))
        except LodgsError as error:
            excluded.append((file.name, error.what))
    warnings = []
    if views:
        excluded += [(f"{view.image.stem}.json", "Polycam rates it as blurred.") for view in blurred]
    elif blurred:
        views = blurred
        warnings.append(f"Polycam rates all photos as blurred, so all are used: {path}.")
    if missing := {file.name for file in (path.parent / "cameras").glob("[!.]*.json")} - {
        file.name for file in path.glob("*.json")
    }:
        warnings.append(f"Skipped {len(missing):,} photos without a corrected camera in {path}.")
    return ExportedScene(views, excluded=excluded, warnings=warnings)


def _photo_size(values: Mapping[str, Any], original: Path, image: Path) -> tuple[float, float]:
    """Return the size that a camera is stated for: its own, that of the uncorrected camera, or the photo's.

    Newer versions write no size into corrected cameras.
    """
    for source in (values, read_document(original) if is_file(original) else {}):
        size = get_number(source, "width", 0), get_number(source, "height", 0)
        if min(size) > 0:
            return size
    return image_size(image)
