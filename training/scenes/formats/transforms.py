"""transforms.json of nerfstudio, instant-ngp and Blender's NeRF exporters.

Format: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp's docs/nerf_dataset_tips.md.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from math import tan
from pathlib import Path
from typing import Any

from ...errors import LodgsError
from ...files import is_file
from ..image_headers import image_size
from ..lenses import Intrinsics
from ..point_cloud import read_points
from .exported import (
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_file,
    find_image,
    get_number,
    invert_pose,
    parse_array,
    parse_camera_matrix,
    read_document,
)

NAME = "nerfstudio (transforms.json)"
_FILES = "transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json"
_FISHEYES = "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"
_SUPPORTED_MODELS = (
    "", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV",
    "PERSPECTIVE", *_FISHEYES,
)  # fmt: skip
_MATRICES = (
    "K", "intrinsics", "intrinsic", "intrinsic_matrix", "intrinsics_matrix", "camera_intrinsics",
    "camera_matrix",
)  # fmt: skip
"""Names of camera matrices that some exporters write instead of focal lengths."""
_ALIASES = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
_FOCALS, _ANGLES = ("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y")
"""Focal lengths in pixels and fields of view in radians along both axes; each may state both."""
_PAIR = ("focal_length", "focal"), "principal_point"
"""Names of focal lengths in pixels, one or two, and of the centre that belongs to them."""
_LENS = re.compile(r"focal|fov|field_of_view|intrinsic|principal|lens|^fl_|^f[xy]?$|^K$", re.I)
"""Names that describe a lens."""
_MAX_NORMALIZED = 10.0
"""Maximum focal length in multiples of the photo's size; focal lengths in pixels are larger."""
_POINTS = "sparse_pc.ply"
"""nerfstudio's name of the point cloud."""
_FLAW = "flaw of the camera matrix"
_NAMES = "file_path", "image_path", "file_name"
_SIZES = {"w": "width", "h": "height"}
_DISTORTION = "distortion_params", ("k1", "k2", "k3", "k4", "p1", "p2")
"""nerfstudio's list of coefficients, and their names."""
_OTHER_LENSES = "latlong", "equirectangular", "orthographic", "ftheta_p0"
"""instant-ngp's settings of lenses that COLMAP lacks."""
_UNNAMED = "distortion", "distortion_coefficients", "dist_coeffs"
"""Lists of coefficients whose order differs between programs."""


def find(folder: Path) -> Path | None:
    """Return the path of the file; for NeRF's synthetic scenes, the file of the training views.

    If no file has a usual name, the only file transform*.json is returned, or that of the training views.
    """
    others = sorted(folder.glob("transform*.json"))
    others = [path for path in others if "train" in path.stem.lower()] or others
    return find_file(folder, *_FILES) or (others[0] if len(others) == 1 else None)


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views, and the points of a PLY if the file names one.

    If a scene has several files (train, val, test), only the training views are read.

    Raises:
        LodgsError: the file is damaged.
    """
    document = read_document(path)
    frames = document.get("frames")
    frames = list(frames.values()) if isinstance(frames, dict) else frames
    if not isinstance(frames, list) or not frames:
        raise LodgsError(f"Cannot read {path}: it has no frames.", "Export it again.")
    common = _with_usual_names({name: value for name, value in document.items() if name != "frames"})
    views, excluded, unread = [], [], Counter()
    frames = [_with_usual_names(frame) if isinstance(frame, dict) else {} for frame in frames]
    names = [frame.get(_NAMES[0]) for frame in frames]
    photos = PhotoFinder([name for name in names if isinstance(name, str)], [path.parent], folder)
    for number, own in enumerate(frames, 1):
        try:
            views.append(_parse_view(path.parent, _frame_values(common, own), photos))
            unread.update(_unread_names(own))
        except LodgsError as error:
            excluded.append((str(own.get("file_path", f"frame {number}")), error.what))
    warnings = photos.warnings()
    masks = [view.image.with_name(f"dynamic_mask_{view.image.stem}.png") for view in views]
    if masks := [path for path in masks if is_file(path)]:
        warnings.append(
            f"Ignored {len(masks)} masks of instant-ngp, such as {masks[0]}. They are white in "
            "ignored areas. Invert them, and save them in a folder masks under the names of their photos."
        )
    others = [other.name for other in sorted(path.parent.glob("transforms_*.json")) if other != path]
    if path.name.lower() in _FILES[1:] and others:
        warnings.append(f"Read the views of {path} only, without those of {', '.join(others)}.")
    for name, count in unread.items():
        warnings.append(
            f"Ignored '{name}' in {path}, frames: {count}. Its meaning is unknown. If it is the lens, write "
            "it as fl_x, fl_y, cx and cy in pixels."
        )
    if point_cloud := _find_points(path, document.get("ply_file_path"), warnings):
        try:
            return ExportedScene(views, *read_points(point_cloud), excluded, warnings)
        except LodgsError as error:
            warnings.append(error.what)
    return ExportedScene(views, excluded=excluded, warnings=warnings)


def _frame_values(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a frame. Its own focal length or field of view replaces all common ones."""
    own = {name: value for name, value in own.items() if value is not None}
    replaced = (*_FOCALS, *_ANGLES) if own.keys() & set(_ANGLES) else ()
    values = {
        name: value for name, value in common.items() if name not in replaced and value is not None
    } | own
    for name, other in (_FOCALS, _FOCALS[::-1]):
        if name in own and other not in own:  # with the common proportions of pixels
            focal, other_focal = (get_number(common, key, 0) for key in (name, other))
            values[other] = get_number(own, name) * (other_focal / focal if focal and other_focal else 1)
    return values


def _unread_names(own: Mapping[str, Any]) -> list[str]:
    """Return names of a frame that describe a lens, if the frame has none under a known name."""
    if own.keys() & {*_FOCALS, *_ANGLES}:
        return []
    return [
        name for name, value in own.items() if _LENS.search(name) and not isinstance(value, str | bool | None)
    ]


def _find_points(path: Path, name: Any, warnings: list[str]) -> Path | None:
    """Return the PLY that the file names, or nerfstudio's usual one next to it, with a warning."""
    if isinstance(name, str):
        return find_image(path.parent, name)
    point_cloud = find_file(path.parent, _POINTS)
    if point_cloud is not None:
        warnings.append(f"{path} names no ply_file_path; the points are read from {point_cloud}.")
    return point_cloud


def _parse_view(folder: Path, values: Mapping[str, Any], photos: PhotoFinder) -> ExportedView:
    """Return the view of a frame.

    Args:
        folder: folder of masks and depth maps.
        values: values of the frame, and of the file where the frame has none.
        photos: finds the photo.

    Raises:
        LodgsError: a value is missing or invalid, or the lens is not supported; the reason is a clause.
    """
    if not isinstance(values.get("file_path"), str):
        raise LodgsError("it has no file_path.")
    image = photos.find(values["file_path"])
    lens = _parse_lens(values, image)
    if "transform_matrix" not in values:
        raise LodgsError("it has no transform_matrix.")
    pose = parse_array(values.get("transform_matrix"), -1, 4)
    names = (values.get(key) for key in ("mask_path", "depth_file_path"))
    mask, depth = (find_image(folder, name) if isinstance(name, str) else None for name in names)
    return ExportedView(image, lens, invert_pose(pose, opengl=True), mask, depth)


def _parse_lens(values: Mapping[str, Any], image: Path) -> Intrinsics:
    """Return the lens of a frame; see :func:`_parse_view`.

    Args:
        image: photo, whose size counts if the values have none.
    """
    width, height = get_number(values, "w", 0), get_number(values, "h", 0)
    if not (width > 0 and height > 0):
        width, height = image_size(image)
    focals, center = _parse_camera_matrix(values, width, height)
    if isinstance(flaw := values.get(_FLAW), str):
        raise LodgsError(flaw)
    if other := next((name for name in _OTHER_LENSES if values.get(name)), ""):
        raise LodgsError(f"lenses with {other} are not supported.")
    if other := next((name for name in _UNNAMED if not _is_zero(values.get(name))), ""):
        raise LodgsError(f"the order of its values '{other}' is unknown: name them k1, k2, p1, p2, ...")
    model = str(values.get("camera_model", "")).upper()
    if model not in _SUPPORTED_MODELS:
        raise LodgsError(f"camera model {model} is not supported.")
    is_fisheye = str(values.get("is_fisheye", "")).lower() in ("true", "1", "1.0")
    fisheye = model in _FISHEYES or is_fisheye
    radial = tuple(get_number(values, f"k{n}", 0) for n in range(1, 7))
    if not fisheye and model != "FULL_OPENCV" and radial[3] and not any(radial[4:]):
        raise LodgsError("its k4 has no equivalent among COLMAP's lenses.")
    tangential = (0.0, 0.0) if fisheye else (get_number(values, "p1", 0), get_number(values, "p2", 0))
    return colmap_lens(width, height, focals, center, radial, tangential, fisheye)


def _parse_camera_matrix(
    values: Mapping[str, Any], width: float, height: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return fx, fy and cx, cy in pixels, which a file may state relative to the image size.

    Raises:
        LodgsError: there is neither a focal length nor a field of view.
    """
    focals = [get_number(values, name, 0) for name in _FOCALS]  # 0 is unknown
    if not any(focals):
        angles = zip(_ANGLES, (width, height), strict=True)
        focals = [_focal_length(get_number(values, n), side) if n in values else 0.0 for n, side in angles]
    if not any(focals):
        raise LodgsError("it has neither a focal length (fl_x) nor a field of view (camera_angle_x).")
    fx, fy = focals[0] or focals[1], focals[1] or focals[0]
    center = get_number(values, "cx", width / 2), get_number(values, "cy", height / 2)
    if 0 < center[0] < 1 and 0 < center[1] < 1:  # normalised by the size
        sides = width, height
        if fx < _MAX_NORMALIZED:
            sides = _normalizing_sides(fx, fy, width, height)
            fx, fy = fx * sides[0], fy * sides[1]
        center = center[0] * sides[0], center[1] * sides[1]
    return (fx, fy), center


def _with_usual_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by instant-ngp's names, which some exporters give as lists or by other names."""
    usual = {name: values[other] for name, other in _SIZES.items() if other in values}
    if names := [values[name] for name in _NAMES if name in values]:
        usual[_NAMES[0]] = names[0]
    try:
        name, coefficients = _DISTORTION
        if values.get(name) is not None:
            usual |= zip(coefficients, parse_array(values[name], 6).tolist(), strict=True)
        return {**usual, **_read_matrix(values), **values}
    except LodgsError as error:
        return {**usual, **values, _FLAW: error.what}


def _read_matrix(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the lens of a camera matrix, of [fx, fy, cx, cy], or of values such as fx; {} without one."""
    content: Any = next((values[name] for name in _MATRICES if values.get(name) is not None), values)
    if content is values and isinstance(values.get("camera"), dict):
        content = values["camera"]
    if isinstance(content, dict):
        lens = {name: content.get(other, content.get(name)) for name, other in _ALIASES.items()}
        focal = next((content[name] for name in _PAIR[0] if content.get(name) is not None), None)
        if focal is not None and content.get(_PAIR[1]) is not None:
            focals = parse_array(focal if isinstance(focal, list) else [focal, focal], 2)
            lens = dict(
                zip(_ALIASES, [*focals.tolist(), *parse_array(content[_PAIR[1]], 2).tolist()], strict=True)
            )
        return {name: value for name, value in lens.items() if value is not None}
    is_flat = isinstance(content, list) and len(content) == 4 and not isinstance(content[0], list)
    lens = parse_array(content, 4).tolist() if is_flat else parse_camera_matrix(content)
    return dict(zip(_ALIASES, lens, strict=True))


def _is_zero(value: Any) -> bool:
    """Return True for null, 0, false, empty values and nested lists of them."""
    return all(map(_is_zero, value)) if isinstance(value, list) else not value


def _normalizing_sides(fx: float, fy: float, width: float, height: float) -> tuple[float, float]:
    """Return the sides that normalised focal lengths are relative to: those of the axes, or the longer one.

    Of these, the sides with more square pixels are returned.
    """
    longer = max(width, height)
    by_axis = abs(fx * width - fy * height) <= abs(fx - fy) * longer
    return (width, height) if by_axis else (longer, longer)


def _focal_length(angle: float, size: float) -> float:
    """Return the focal length in pixels of a field of view in radians."""
    if not 0 < angle < 3.14:
        raise LodgsError(f"its field of view of {angle:g} radians is impossible (degrees are not).")
    return 0.5 * size / tan(0.5 * angle)
