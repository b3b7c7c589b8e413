"""transforms.json of nerfstudio, instant-ngp and Blender's NeRF exporters.

Format: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp's docs/nerf_dataset_tips.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tan
from pathlib import Path
from typing import Any

from ...errors import LodgsError
from ..images import image_size
from ..point_cloud import read_points
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

NAME = "nerfstudio (transforms.json)"
_FILES = "transforms.json", "transforms_train.json"
_SUPPORTED_MODELS = (
    "", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE",
)  # fmt: skip


def find(folder: Path) -> Path | None:
    """Return the path of the file; for NeRF's synthetic scenes, the file of the training views."""
    return next((folder / name for name in _FILES if (folder / name).is_file()), None)


def read(path: Path) -> ExportedScene:
    """Read the views, and the points of a PLY if the file names one.

    If a scene has several files (train, val, test), only the training views are read.

    Raises:
        LodgsError: the file is damaged.
    """
    document = read_document(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise LodgsError(f"Cannot read {path}: it has no frames.", "Export it again.")
    common = {name: value for name, value in document.items() if name != "frames"}
    views, excluded = [], []
    for number, frame in enumerate(frames, 1):
        values = common | (frame if isinstance(frame, dict) else {})
        values = {name: value for name, value in values.items() if value is not None}
        try:
            views.append(_parse_view(path.parent, values))
        except LodgsError as error:
            excluded.append((str(values.get("file_path", f"frame {number}")), error.what))
    point_cloud = document.get("ply_file_path")
    if isinstance(point_cloud, str):
        try:
            return ExportedScene(views, *read_points(find_image(path.parent, point_cloud)), excluded)
        except LodgsError as error:
            return ExportedScene(views, excluded=excluded, warnings=[error.what])
    return ExportedScene(views, excluded=excluded)


def _parse_view(folder: Path, values: Mapping[str, Any]) -> ExportedView:
    if not isinstance(values.get("file_path"), str):
        raise LodgsError("it has no file_path.")
    image = find_image(folder, values["file_path"])
    width, height = get_number(values, "w", 0), get_number(values, "h", 0)
    if not (width > 0 and height > 0):
        width, height = image_size(image)
    if "fl_x" in values:
        fx = get_number(values, "fl_x")
        fy = get_number(values, "fl_y", fx)
    else:
        fx = _focal_length(get_number(values, "camera_angle_x"), width)
        fy = _focal_length(get_number(values, "camera_angle_y"), height) if "camera_angle_y" in values else fx
    center = get_number(values, "cx", width / 2), get_number(values, "cy", height / 2)
    model = str(values.get("camera_model", "")).upper()
    if model not in _SUPPORTED_MODELS:
        raise LodgsError(f"camera model {model} is not supported.")
    fisheye = model == "OPENCV_FISHEYE" or values.get("is_fisheye") is True
    radial = tuple(get_number(values, f"k{n}", 0) for n in range(1, 7))
    if not fisheye and radial[3] and not any(radial[4:]):
        raise LodgsError("its k4 has no equivalent among COLMAP's lenses.")
    tangential = (0.0, 0.0) if fisheye else (get_number(values, "p1", 0), get_number(values, "p2", 0))
    lens = colmap_lens(width, height, (fx, fy), center, radial, tangential, fisheye)
    pose = parse_array(values.get("transform_matrix"), -1, 4)
    names = (values.get(key) for key in ("mask_path", "depth_file_path"))
    mask, depth = (find_image(folder, name) if isinstance(name, str) else None for name in names)
    return ExportedView(image, lens, invert_pose(pose, opengl=True), mask, depth)


def _focal_length(angle: float, size: float) -> float:
    """Return the focal length in pixels of a field of view in radians."""
    if not 0 < angle < 3.14:
        raise LodgsError(f"its field of view of {angle:g} radians is impossible.")
    return 0.5 * size / tan(0.5 * angle)
