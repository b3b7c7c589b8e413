"""Polycam's raw data: a camera in a JSON file beside each photograph.

Facts: https://github.com/PolyCam/polyform (keyframes, corrected ones, blur score).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import LodgsError
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
LEAST_SHARP = 25.0
"""Photographs with a lower blur score are left out, as nerfstudio does."""
_FOLDERS = ("corrected_cameras", "corrected_images"), ("cameras", "images")


def find(folder: Path) -> Path | None:
    """The folder of the cameras, corrected ones where there are some."""
    for keyframes in (folder / "keyframes", folder):
        for cameras, images in _FOLDERS:
            if (keyframes / images).is_dir() and any((keyframes / cameras).glob("*.json")):
                return keyframes / cameras
    return None


def read(path: Path) -> ExportedScene:
    """Views; Polycam's points are in depth maps, of millimetres.

    Raises:
        LodgsError: nothing; a camera that cannot be read is left out.
    """
    images = path.parent / dict(_FOLDERS)[path.name]
    views, left_out = [], []
    for file in sorted(path.glob("*.json")):
        try:
            told = read_document(file)
            if get_number(told, "blur_score", LEAST_SHARP) < LEAST_SHARP:
                raise LodgsError("it is blurred, says Polycam.")
            width, height = get_number(told, "width"), get_number(told, "height")
            lens = colmap_lens(
                width, height, (get_number(told, "fx"), get_number(told, "fy")),
                (get_number(told, "cx", width / 2), get_number(told, "cy", height / 2)),
            )  # fmt: skip
            rows = [[get_number(told, f"t_{row}{column}") for column in range(4)] for row in range(3)]
            pose = invert_pose(np.array(rows), opengl=True)
            depth = path.parent / "depth" / f"{file.stem}.png"
            views.append(ExportedView(find_image(images, file.stem), lens, pose, depth=depth))
        except LodgsError as error:
            left_out.append((file.name, error.what))
    return ExportedScene(views, left_out=left_out)
