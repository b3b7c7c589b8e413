"""RealityCapture's and RealityScan's cameras: a CSV file, or an XMP file beside each photo.

Format: M. Hornáček, "On the Coordinate Systems Employed in the Import, Estimation, and Export of Camera
Geometry by RealityScan" (2026), linked from Camera Geometry in RealityScan's documentation. Lenses are
relative to the photo's longer side s: focal length s f / 36 for f in 35 mm equivalent, principal point s p
from the middle. Brown's k1 to k4 and r are OpenCV's, t1 is OpenCV's p2, and t2 its p1. The rotation maps
world to camera by rows, and the position is the camera's centre. With yaw, pitch and roll of 0, a camera
looks down and its upper side is north (+y). Yaw is clockwise, positive pitch raises the upper side,
positive roll lowers the right side.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from math import cos, radians, sin
from pathlib import Path

import numpy as np

from ...documents import decode_text, open_lines, read_bytes
from ...errors import LodgsError
from ..image_headers import image_size
from ..lenses import Intrinsics
from ..point_cloud import read_points
from .exported import (
    MAX_BYTES,
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_image,
    get_number,
    invert_pose,
    parse_array,
    parse_xml,
    visible_files,
)

NAME = "RealityCapture and RealityScan"
MAX_SKEW = 1e-4
"""Maximum skew, and deviation of the pixels' proportions from 1, that is ignored."""
MIN_VISIBLE = 0.2
"""Minimum share of points that photos show if both are in the same coordinates."""
_IMAGES = ".", "images", "photos"
_COMMON = {"name"}
_ANGLES = _COMMON | {"x", "y", "alt", "yaw", "pitch", "roll", "f"}
_MATRIX = tuple(f"r{row}{column}" for row in range(3) for column in range(3))
_POSES = _COMMON | {"tx", "ty", "tz", *_MATRIX, "f_pix"}
_ALIASES = {"heading": "yaw", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
_BROWN = "brown3", "brown4", "brown3t2", "brown4t2"
_COEFFICIENTS = "k1", "k2", "k3", "k4", "t1", "t2"
_NAMESPACE = "capturingreality"
_HEAD_LINES, _HEAD_FILES = 5, 8
_FAR, _MAX_DEGREES, _SAMPLE = 100_000.0, 0.05, 1000
"""Coordinates of projections; largest extent of a capture in degrees; number of points that are tested."""
_REMEDY = "choose Brown3 (with tangential2) as the distortion model, then align and export again"


def find(folder: Path) -> Path | None:
    """Return the CSV file with all cameras, or the folder if XMP files beside its photos hold them."""
    try:
        files = visible_files(folder)
    except OSError:
        return None
    tables = (path for path in files if path.suffix.lower() == ".csv" and _is_table(path))
    sidecars = (path for path in files if path.suffix.lower() == ".xmp")
    has_sidecars = any(map(_has_pose, islice(sidecars, _HEAD_FILES)))
    return next(tables, None) or (folder if has_sidecars else None)


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views, and the points of the only PLY next to them that fits.

    Raises:
        LodgsError: a file is damaged, or has geographic coordinates.
    """
    scene = _read_sidecars(path) if path.is_dir() else _read_table(path, folder)
    _check_coordinates(path, scene)
    return _with_points(path if path.is_dir() else path.parent, scene)


def _is_table(path: Path) -> bool:
    try:
        with open_lines(path) as file:
            return any(_parse_header(decode_text(line)) for line in islice(file, _HEAD_LINES))
    except LodgsError:
        return False


def _parse_header(line: str) -> tuple[str, list[str]] | None:
    """Return the delimiter and names of a table's columns, or None for another line."""
    head = line.lower().partition("(")[0].lstrip("# ")  # a comment follows
    for delimiter in ",;\t":
        names = [name.strip(" \"'\r\n") for name in head.split(delimiter)]
        names = [_ALIASES.get(name, name) for name in names]
        if set(names) >= _ANGLES or set(names) >= _POSES:
            return delimiter, names
    return None


def _read_table(path: Path, folder: Path) -> ExportedScene:
    """Read the views of a table, one per row. Rows without a photo or with invalid values are excluded.

    Args:
        folder: folder of the export, in which photos are searched.
    """
    lines = iter(decode_text(read_bytes(path, MAX_BYTES)).splitlines())
    delimiter, columns = next(filter(None, map(_parse_header, lines)), (",", []))
    rows = [
        [cell.strip() for cell in row]
        for row in _parse_rows(path, lines, delimiter)
        if any(row) and not row[0].startswith("#")
    ]
    photos = PhotoFinder([row[0] for row in rows], [path.parent / name for name in _IMAGES], folder)
    views, excluded = [], []
    only_k1 = 0
    for row in rows:
        values = dict(zip(columns, row, strict=False))
        try:
            if len(row) != len(columns):
                raise LodgsError(f"its row has {len(row)} values instead of {len(columns)}.")
            image = photos.find(values["name"])
            coefficients = [get_number(values, name, 0) for name in _COEFFICIENTS]
            views.append(_parse_view(values, image, coefficients))
            only_k1 += bool(coefficients[0]) and not any(coefficients[1:])
        except (LodgsError, np.linalg.LinAlgError) as error:
            reason = error.what if isinstance(error, LodgsError) else "its pose is not a rotation."
            excluded.append((row[0], reason))
    warnings = []  # names have no folders
    if only_k1 and only_k1 == len(views):
        warnings.append(
            f"{path} has only k1 of the distortion and does not name its model: if it is the division model, "
            f"photos are distorted wrongly. Then {_REMEDY}."
        )
    return ExportedScene(views, excluded=excluded, warnings=warnings)


def _parse_view(values: Mapping[str, str], image: Path, coefficients: list[float]) -> ExportedView:
    """Return the view of a row: with a matrix and pixels, or with angles and a relative focal length.

    Args:
        coefficients: values of _COEFFICIENTS.
    """
    if "f_pix" in values:
        width, height = image_size(image)
        center = [get_number(values, f"{axis}_pix") for axis in ("px", "py")]
        lens = _brown(width, height, get_number(values, "f_pix"), center, coefficients)
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3] = parse_array([values[name] for name in _MATRIX], 3, 3)
        world_to_camera[:3, 3] = parse_array([values[name] for name in ("tx", "ty", "tz")], 3)
        return ExportedView(image, lens, invert_pose(np.linalg.inv(world_to_camera)))
    offset = get_number(values, "px", 0), get_number(values, "py", 0)
    lens = _lens(image, get_number(values, "f"), offset, coefficients)
    angles = [get_number(values, name) for name in ("yaw", "pitch", "roll")]
    position = [get_number(values, name) for name in ("x", "y", "alt")]
    return ExportedView(image, lens, _pose(attitude(*angles).T, position))


def _parse_rows(path: Path, lines: Iterator[str], delimiter: str) -> list[list[str]]:
    try:
        return list(csv.reader(lines, delimiter=delimiter))
    except csv.Error as error:
        raise LodgsError(f"Cannot read {path}: {error}.", "Export the cameras again.") from error


def attitude(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return the rotation (3, 3) from OpenCV's camera axes to the world for angles in degrees."""
    (a, b, c), (d, e, f) = ([ratio(radians(angle)) for angle in (yaw, pitch, roll)] for ratio in (cos, sin))
    turn = np.array([[a, d, 0], [-d, a, 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, b, -e], [0, e, b]])
    bank = np.array([[c, 0, f], [0, 1, 0], [-f, 0, c]])
    return turn @ tilt @ bank @ np.diag([1.0, -1.0, -1.0])


def _pose(rotation: np.ndarray, position: object) -> np.ndarray:
    """Return world_to_camera (4, 4) for the rotation of world to camera and the camera's centre."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, parse_array(position, 3)
    return invert_pose(pose)


def _lens(image: Path, focal: float, offset: tuple[float, float], coefficients: list[float]) -> Intrinsics:
    """Return the lens of a photo for a focal length in 35 mm equivalent and a relative principal point."""
    width, height = image_size(image)
    longer = max(width, height)
    center = [side / 2 + longer * part for side, part in zip((width, height), offset, strict=True)]
    return _brown(width, height, longer * focal / 36, center, coefficients)


def _brown(
    width: int, height: int, focal: float, center: list[float], coefficients: list[float]
) -> Intrinsics:
    k1, k2, k3, k4, t1, t2 = coefficients
    if k4:
        raise LodgsError(f"its k4 has no equivalent among COLMAP's lenses: {_REMEDY}.")
    return colmap_lens(width, height, (focal, focal), (center[0], center[1]), (k1, k2, k3), (t2, t1))


def _has_pose(path: Path) -> bool:
    with suppress(LodgsError):
        return {"Rotation", "Position"} <= _sidecar_values(path).keys()
    return False


def _sidecar_values(path: Path) -> dict[str, str]:
    """Return the attributes and elements of RealityCapture in an XMP file by their names."""
    values = {}
    for element in parse_xml(path, "RealityCapture").iter():
        for name, text in [*element.attrib.items(), (element.tag, element.text or "")]:
            namespace, _, local = name.rpartition("}")
            if _NAMESPACE in namespace:
                values[local] = text.strip()
    return values


def _read_sidecars(folder: Path) -> ExportedScene:
    views, groups, excluded, warnings = [], [], [], []
    for path in visible_files(folder):
        if path.suffix.lower() != ".xmp":
            continue
        try:
            values = _sidecar_values(path)
            if not values or path.stem.lower() == "_common":  # of another program, or of all photos
                continue
            if not {"Rotation", "Position"} <= values.keys():
                raise LodgsError("RealityCapture did not align it.")
            image = find_image(folder, path.stem)
            views.append(ExportedView(image, _sidecar_lens(image, values), _sidecar_pose(values)))
            is_relative = values.get("Coordinates", "absolute") != "absolute"
            groups.append(values.get("ComponentId", "") if is_relative else "")
        except LodgsError as error:
            excluded.append((path.name, error.what))
    if len(counts := Counter(groups)) > 1:
        largest, count = counts.most_common(1)[0]
        views = [view for view, group in zip(views, groups, strict=True) if group == largest]
        warnings.append(f"Skipped {len(groups) - count:,} photos of other components in {folder}.")
    return ExportedScene(views, excluded=excluded, warnings=warnings)


def _sidecar_pose(values: Mapping[str, str]) -> np.ndarray:
    rotation = parse_array(values["Rotation"].split(), 3, 3)
    return _pose(rotation, values["Position"].split())


def _sidecar_lens(image: Path, values: Mapping[str, str]) -> Intrinsics:
    if (
        abs(get_number(values, "Skew", 0)) > MAX_SKEW
        or abs(get_number(values, "AspectRatio", 1) - 1) > MAX_SKEW
    ):
        raise LodgsError(f"its skew or aspect ratio has no equivalent among COLMAP's lenses: {_REMEDY}.")
    model = values.get("DistortionModel", "none")
    coefficients = [0.0] * 6
    if model not in ("none", "perspective"):
        numbers = parse_array(values.get("DistortionCoeficients", "0 0 0 0 0 0").split(), -1).tolist()
        coefficients = [*numbers, *coefficients][:6]
    if model not in _BROWN and any(coefficients):
        raise LodgsError(f"its distortion model {model} has no equivalent among COLMAP's lenses: {_REMEDY}.")
    offset = get_number(values, "PrincipalPointU", 0), get_number(values, "PrincipalPointV", 0)
    return _lens(image, get_number(values, "FocalLength35mm"), offset, coefficients)


def _check_coordinates(path: Path, scene: ExportedScene) -> None:
    """Raise LodgsError for longitudes and latitudes; warn of angles that may refer to another north."""
    if not scene.views:
        return
    centers = np.array([np.linalg.inv(view.world_to_camera)[:2, 3] for view in scene.views])
    middle, spread = np.abs(np.median(centers, axis=0)), np.ptp(centers, axis=0)
    remedy = "Export it in the coordinates of the grid plane, or in local Euclidean ones"
    in_range = (middle <= (180, 90)).all() and middle.max() > 1
    if in_range and 0 < spread.max() < min(_MAX_DEGREES, 0.01 * middle.max()):
        raise LodgsError(f"Cannot read {path}: its positions are longitudes and latitudes.", f"{remedy}.")
    if path.is_file() and middle.max() > _FAR:
        scene.warnings.append(
            f"{path} has projected coordinates, whose north may differ by a few degrees from that of its "
            f"angles. {remedy} if the result is blurred."
        )


def _with_points(folder: Path, scene: ExportedScene) -> ExportedScene:
    """Return the scene with the points of the only PLY of the folder, unless no photo shows them."""
    clouds = [path for path in visible_files(folder) if path.suffix.lower() == ".ply"]
    if len(clouds) > 1:
        scene.warnings.append(f"{folder} has several PLY files. None is read; keep the one with its points.")
    if len(clouds) != 1 or not scene.views:
        return scene
    try:
        points, colors = read_points(clouds[0])
    except LodgsError as error:
        scene.warnings.append(error.what)
        return scene
    sample = points[:: max(len(points) // _SAMPLE, 1)]
    visible = np.any([view.camera("").sees(sample) for view in scene.views], axis=0)
    if visible.sum() < MIN_VISIBLE * len(sample):
        scene.warnings.append(
            f"Skipped the points of {clouds[0]}: no photo shows most of them. Export it in the cameras' "
            "coordinates."
        )
        return scene
    return replace(scene, points=points, colors=colors)
