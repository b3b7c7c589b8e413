"""transforms.json of nerfstudio, instant-ngp and Blender's NeRF exporters.

Format: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp's docs/nerf_dataset_tips.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tan
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError
from ..images import image_size
from ..point_cloud import read_points
from .exported import (
    ExportedScene,
    ExportedView,
    PhotoFinder,
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
_MATRICES = "K", "intrinsics", "intrinsic_matrix", "camera_matrix"
"""Names of camera matrices that some exporters write instead of focal lengths."""
_ALIASES = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
_MAX_NORMALISED = 10.0
"""Maximum focal length in multiples of the photo's size; focal lengths in pixels are larger."""
_FLAW = "flaw of the camera matrix"


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
    common = _with_focal_lengths({name: value for name, value in document.items() if name != "frames"})
    views, excluded = [], []
    names = [frame.get("file_path") for frame in frames if isinstance(frame, dict)]
    photos = PhotoFinder(path.parent, [name for name in names if isinstance(name, str)])
    for number, frame in enumerate(frames, 1):
        own = _with_focal_lengths(frame) if isinstance(frame, dict) else {}
        # A frame's field of view replaces the common focal length.
        replaced = ("fl_x", "fl_y") if "camera_angle_x" in own else ()
        values = {name: value for name, value in common.items() if name not in replaced} | own
        values = {name: value for name, value in values.items() if value is not None}
        try:
            views.append(_parse_view(path.parent, values, photos))
        except LodgsError as error:
            excluded.append((str(values.get("file_path", f"frame {number}")), error.what))
    point_cloud = document.get("ply_file_path")
    if isinstance(point_cloud, str):
        try:
            points = read_points(find_image(path.parent, point_cloud))
            return ExportedScene(views, *points, excluded, photos.warnings())
        except LodgsError as error:
            return ExportedScene(views, excluded=excluded, warnings=[error.what, *photos.warnings()])
    return ExportedScene(views, excluded=excluded, warnings=photos.warnings())


def _parse_view(folder: Path, values: Mapping[str, Any], photos: PhotoFinder) -> ExportedView:
    if not isinstance(values.get("file_path"), str):
        raise LodgsError("it has no file_path.")
    image = photos.find(values["file_path"])
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
    if 0 < center[0] < 1 and 0 < center[1] < 1:  # normalised by the size
        sides = width, height
        if fx < _MAX_NORMALISED:
            sides = _normalising_sides(fx, fy, width, height)
            fx, fy = fx * sides[0], fy * sides[1]
        center = center[0] * sides[0], center[1] * sides[1]
    if isinstance(flaw := values.get(_FLAW), str):
        raise LodgsError(flaw)
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


def _with_focal_lengths(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with focal lengths and centre by name, which some exporters give as a camera matrix."""
    try:
        return {**_read_matrix(values), **values}
    except LodgsError as error:
        return {**values, _FLAW: error.what}


def _read_matrix(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the lens of a camera matrix, of [fx, fy, cx, cy], or of values such as fx; {} without one."""
    content: Any = next((values[name] for name in _MATRICES if values.get(name) is not None), values)
    if isinstance(content, dict):
        return {name: content[other] for name, other in _ALIASES.items() if content.get(other) is not None}
    numbers = parse_array(content, -1)
    if np.shape(content) == (4,):
        return dict(zip(_ALIASES, numbers.tolist(), strict=True))
    if len(numbers) not in (9, 16):
        raise LodgsError("its camera matrix is not 3x3 or 4x4 numbers.")
    matrix = numbers.reshape(int(len(numbers) ** 0.5), -1)[:3, :3]
    if matrix[2, 0] and not matrix[0, 2]:  # stored by columns, as ARKit does
        matrix = matrix.T
    if not (np.array_equal(matrix[2], [0, 0, 1]) and matrix[1, 0] == 0 and abs(matrix[0, 1]) < 0.01):
        raise LodgsError("its camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1].")
    lens = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return dict(zip(_ALIASES, map(float, lens), strict=True))


def _normalising_sides(fx: float, fy: float, width: float, height: float) -> tuple[float, float]:
    """Return the sides that normalised focal lengths are relative to: those of the axes, or the longer one.

    Of these, the sides with more square pixels are returned.
    """
    longer = max(width, height)
    by_axis = abs(fx * width - fy * height) <= abs(fx - fy) * longer
    return (width, height) if by_axis else (longer, longer)


def _focal_length(angle: float, size: float) -> float:
    """Return the focal length in pixels of a field of view in radians."""
    if not 0 < angle < 3.14:
        raise LodgsError(f"its field of view of {angle:g} radians is impossible.")
    return 0.5 * size / tan(0.5 * angle)
