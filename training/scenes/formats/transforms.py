"""transforms.json, as nerfstudio, instant-ngp and Blender's exports for NeRF write it.

Facts: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp's docs/nerf_dataset_tips.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tan
from pathlib import Path
from typing import Any

from ...errors import LodgsError
from ..images import image_size
from .exported import (
    ExportedScene,
    ExportedView,
    colmap_lens,
    find_image,
    get_number,
    invert_pose,
    parse_array,
    read_document,
)
from .point_cloud import read_points

NAME = "transforms.json"
_FILES = "transforms.json", "transforms_train.json"
_PERSPECTIVE = ("", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE")


def find(folder: Path) -> Path | None:
    """The file; of NeRF's synthetic scenes, the one of the training views."""
    return next((folder / name for name in _FILES if (folder / name).is_file()), None)


def read(path: Path) -> ExportedScene:
    """Views, and points if a PLY is named.

    Of a scene in several files (train, val, test) the training views alone are read.

    Raises:
        LodgsError: the file is damaged.
    """
    document = read_document(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise LodgsError(f"{path} has no frames.", "Export it again.")
    common = {name: value for name, value in document.items() if name != "frames"}
    views, left_out = [], []
    for place, frame in enumerate(frames, 1):
        told = common | (frame if isinstance(frame, dict) else {})
        told = {name: value for name, value in told.items() if value is not None}
        try:
            views.append(_view(path.parent, told))
        except LodgsError as error:
            left_out.append((str(told.get("file_path", f"frame {place}")), error.what))
    cloud = document.get("ply_file_path")
    if isinstance(cloud, str):
        try:
            return ExportedScene(views, *read_points(find_image(path.parent, cloud)), left_out)
        except LodgsError as error:
            return ExportedScene(views, left_out=left_out, warnings=[error.what])
    return ExportedScene(views, left_out=left_out)


def _view(folder: Path, told: Mapping[str, Any]) -> ExportedView:
    if not isinstance(told.get("file_path"), str):
        raise LodgsError("it names no file.")
    image = find_image(folder, told["file_path"])
    width, height = get_number(told, "w", 0), get_number(told, "h", 0)
    if not (width > 0 and height > 0):
        width, height = image_size(image)
    if "fl_x" in told:
        fx = get_number(told, "fl_x")
        fy = get_number(told, "fl_y", fx)
    else:
        fx = _focal(get_number(told, "camera_angle_x"), width)
        fy = _focal(get_number(told, "camera_angle_y"), height) if "camera_angle_y" in told else fx
    center = get_number(told, "cx", width / 2), get_number(told, "cy", height / 2)
    kind = str(told.get("camera_model", "")).upper()
    if kind not in _PERSPECTIVE:
        raise LodgsError(f"its camera model {kind} is none that is known here.")
    fisheye = kind == "OPENCV_FISHEYE" or told.get("is_fisheye") is True
    radial = tuple(get_number(told, f"k{n}", 0) for n in range(1, 7))
    if not fisheye and radial[3] and not any(radial[4:]):
        raise LodgsError("its k4 is of a lens that COLMAP does not have.")
    tangential = (0.0, 0.0) if fisheye else (get_number(told, "p1", 0), get_number(told, "p2", 0))
    lens = colmap_lens(width, height, (fx, fy), center, radial, tangential, fisheye)
    pose = parse_array(told.get("transform_matrix"), -1, 4)
    beside = (told.get(name) for name in ("mask_path", "depth_file_path"))
    mask, depth = (find_image(folder, name) if isinstance(name, str) else None for name in beside)
    return ExportedView(image, lens, invert_pose(pose, opengl=True), mask, depth)


def _focal(angle: float, size: float) -> float:
    """In pixels, of a field of view in radians."""
    if not 0 < angle < 3.14:
        raise LodgsError("its field of view is impossible.")
    return 0.5 * size / tan(0.5 * angle)
