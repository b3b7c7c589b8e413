"""OpenSfM's reconstruction.json, also inside projects of OpenDroneMap.

Format: https://opensfm.org/docs/dataset.html (shots with a rotation vector and a translation, world to camera
in OpenCV axes) and https://opensfm.org/docs/geometry.html (lengths in multiples of the photo's longer side,
from its middle).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...documents import decode_text, parse_json, read_bytes
from ...errors import LodgsError
from ...splats.georeference import Georeference, local_tangent_plane
from ..lenses import Intrinsics
from .exported import (
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_file,
    finite_points,
    get_number,
    parse_array,
    read_document,
)

NAME = "OpenSfM"
MAX_BYTES = 1 << 28
"""Maximum size of the file, which holds all points as text."""
_REFERENCE = "latitude", "longitude", "altitude"
_FISHEYES = "fisheye", "fisheye_opencv"
_LENSES = "perspective", "simple_radial", "radial", "brown", *_FISHEYES


def find(folder: Path) -> Path | None:
    """Return reconstruction.json of the folder or, in a project of OpenDroneMap, of its folder opensfm."""
    return find_file(folder, "reconstruction.json") or find_file(folder / "opensfm", "reconstruction.json")


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views and points of the reconstruction with most photos.

    Raises:
        LodgsError: the file is damaged.
    """
    text = decode_text(read_bytes(path, MAX_BYTES))
    document = parse_json(f'{{"all": {text}}}', str(path), MAX_BYTES + 16, finite=False)  # a list at the top
    parts = [part for part in _list(document["all"]) if isinstance(part, dict)]
    parts = [part for part in parts if isinstance(part.get("shots"), dict) and part["shots"]]
    if not parts:
        raise LodgsError(f"Cannot read {path}: it has no reconstruction with photos.", "Reconstruct again.")
    part = max(parts, key=lambda part: len(part["shots"]))
    try:
        cameras, shots, points = part["cameras"], part["shots"].items(), part.get("points") or {}
        positions, colors = (
            parse_array([point[key] for point in points.values()], len(points), 3, finite=False)
            for key in ("coordinates", "color")
        )
    except (KeyError, TypeError, AttributeError, LodgsError) as error:
        raise LodgsError(
            f"Cannot read {path}: it is not a reconstruction of OpenSfM (missing or invalid: {error}).",
            "Export it again.",
        ) from error
    project = path.parent.parent if path.parent.name == "opensfm" else path.parent
    roots = project / "images", path.parent, project
    search = folder if project.is_relative_to(folder) else project  # the folder opensfm was chosen
    photos = PhotoFinder([name for name, _ in shots], roots, search)
    views, excluded = [], []
    for name, shot in shots:
        try:
            lens = _parse_lens(cameras.get(shot.get("camera")))
            pose = np.eye(4)
            pose[:3, :3] = _rotation(parse_array(shot.get("rotation"), 3))
            pose[:3, 3] = parse_array(shot.get("translation"), 3)
            views.append(ExportedView(photos.find(name), lens, pose))
        except (LodgsError, AttributeError, TypeError) as error:
            excluded.append((name, error.what if isinstance(error, LodgsError) else "its entry is damaged."))
    warnings = photos.warnings()
    if len(parts) > 1:
        others = sum(len(other["shots"]) for other in parts) - len(part["shots"])
        warnings.append(f"Skipped {others:,} photos of {len(parts) - 1} separate reconstructions in {path}.")
    colors = np.nan_to_num(colors.clip(0, 255)).astype(np.uint8)
    positions, colors = finite_points(path, positions, colors, warnings)
    return ExportedScene(views, positions, colors, excluded, warnings, _georeference(path, part))


def _georeference(path: Path, part: Mapping) -> Georeference | None:
    """Return the place of the topocentric coordinates, from the reconstruction or reference_lla.json."""
    values = part.get("reference_lla")
    file = find_file(path.parent, "reference_lla.json")
    try:
        if values is None and file is not None:
            values = read_document(file)
        if not isinstance(values, Mapping):
            return None
        return local_tangent_plane(*(get_number(values, name) for name in _REFERENCE))
    except LodgsError:
        return None


def _list(value: Any) -> list:
    return value if isinstance(value, list) else [value]


def _parse_lens(values: Any) -> Intrinsics:
    """Return the lens of a camera.

    Raises:
        LodgsError: the camera is missing, invalid or of a kind that COLMAP lacks.
    """
    if not isinstance(values, Mapping):
        raise LodgsError("it has no lens.")
    kind = values.get("projection_type", "perspective")
    if kind not in _LENSES:
        raise LodgsError(f"camera type {kind} is not supported.")
    width, height = get_number(values, "width"), get_number(values, "height")
    longer = max(width, height)
    fx = get_number(values, "focal_x" if values.get("focal_x") is not None else "focal")
    fy = get_number(values, "focal_y", fx)
    middle = (
        width / 2 + longer * get_number(values, "c_x", 0),
        height / 2 + longer * get_number(values, "c_y", 0),
    )
    radial = tuple(get_number(values, f"k{number}", 0) for number in range(1, 5))
    tangential = get_number(values, "p1", 0), get_number(values, "p2", 0)
    fisheye = kind in _FISHEYES
    radial = radial if fisheye else radial[:3]
    return colmap_lens(width, height, (fx * longer, fy * longer), middle, radial, tangential, fisheye)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) about a vector (3,) by its length in radians (Rodrigues' formula)."""
    if not np.isfinite(angle := np.linalg.norm(vector)):
        raise LodgsError("its rotation is not finite.")
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
