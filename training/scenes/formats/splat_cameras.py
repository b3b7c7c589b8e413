"""cameras.json, which 3DGS programs write beside their splats, with the photos of the training.

Format: camera_to_JSON of the original program (utils/camera_utils.py): a list of cameras with their centre
and the rotation from OpenCV's camera axes to the world, by rows. Photos are undistorted and centred.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...documents import decode_text, parse_json, read_bytes
from ...errors import LodgsError
from .exported import (
    MAX_BYTES,
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_file,
    get_number,
    invert_pose,
    parse_array,
)

NAME = "cameras.json of 3DGS"
_KEYS = b'"img_name"', b'"rotation"'
_HEAD_BYTES = 4096


def find(folder: Path) -> Path | None:
    """Return cameras.json of the folder if it has the keys of 3DGS and photos are next to it.

    The output of a 3DGS program has the file without photos.
    """
    path = find_file(folder, "cameras.json")
    try:
        if (
            path
            and (folder / "images").is_dir()
            and all(key in read_bytes(path, _HEAD_BYTES) for key in _KEYS)
        ):
            return path
    except LodgsError:
        pass
    return None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views. The file has no points.

    Raises:
        LodgsError: the file is damaged.
    """
    text = decode_text(read_bytes(path, MAX_BYTES))
    document = parse_json(f'{{"all": {text}}}', str(path), MAX_BYTES + 16, finite=False)  # a list at the top
    cameras = document["all"] if isinstance(document["all"], list) else []
    cameras = [camera for camera in cameras if isinstance(camera, dict)]
    if not cameras:
        raise LodgsError(f"Cannot read {path}: it has no cameras.", "Choose the scene that was trained.")
    names = [str(camera.get("img_name", "")) for camera in cameras]
    photos = PhotoFinder(names, [path.parent / "images", path.parent], folder)
    views, excluded = [], []
    for name, camera in zip(names, cameras, strict=True):
        try:
            width, height = get_number(camera, "width"), get_number(camera, "height")
            center = get_number(camera, "cx", width / 2), get_number(camera, "cy", height / 2)
            focal = get_number(camera, "fx"), get_number(camera, "fy")
            pose = np.eye(4)
            pose[:3, :3] = parse_array(camera.get("rotation"), 3, 3)
            pose[:3, 3] = parse_array(camera.get("position"), 3)
            lens = colmap_lens(width, height, focal, center)
            views.append(ExportedView(photos.find(name), lens, invert_pose(pose)))
        except LodgsError as error:
            excluded.append((name, error.what))
    return ExportedScene(views, excluded=excluded, warnings=photos.warnings())
