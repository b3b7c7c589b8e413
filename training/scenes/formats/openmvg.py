"""OpenMVG's sfm_data.json.

Format: https://openmvg.readthedocs.io/en/latest/software/SfM/SfM_OutputFormat/ (views, intrinsics, structure;
extrinsics as world-to-camera rotation and camera centre). Distortion: radial_k3 has k1, k2, k3; brown has k1,
k2, k3, t1, t2; fisheye has k1 to k4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError
from ..lenses import Intrinsics
from .exported import (
    ExportedScene,
    ExportedView,
    PhotoFinder,
    colmap_lens,
    find_file,
    finite_points,
    get_number,
    invert_pose,
    parse_array,
    read_document,
)

NAME = "OpenMVG"
_POINTS = "structure"


def find(folder: Path) -> Path | None:
    """Return sfm_data.json, or the only file sfm_data*.json, of the folder or of OpenMVG's output folders."""
    folders = folder, folder / "reconstruction", folder / "reconstruction_sequential"
    for path in folders:
        others = sorted(path.glob("sfm_data*.json"))
        if file := find_file(path, "sfm_data.json") or (others[0] if len(others) == 1 else None):
            return file
    return None


def read(path: Path, folder: Path) -> ExportedScene:
    """Read the views and the points, which have no colours.

    Raises:
        LodgsError: the file is damaged.
    """
    document = read_document(path)
    try:
        lenses = {entry["key"]: entry["value"]["ptr_wrapper"]["data"] for entry in document["intrinsics"]}
        poses = {entry["key"]: entry["value"] for entry in document["extrinsics"]}
        entries = [entry["value"]["ptr_wrapper"]["data"] for entry in document["views"]]
        positions = [entry["value"]["X"] for entry in document.get(_POINTS) or []]
        points = parse_array(positions, -1, 3, finite=False) if positions else np.zeros((0, 3))
        root = str(document.get("root_path", ""))
    except (KeyError, TypeError, AttributeError) as error:
        raise LodgsError(
            f"Cannot read {path}: it is not an sfm_data file of OpenMVG (missing or invalid: {error}).",
            "Export it again.",
        ) from error
    except LodgsError as error:
        raise LodgsError(f"Cannot read {path}: {error.what}", "Export it again.") from error
    if not poses:
        raise LodgsError(
            f"Cannot read {path}: it has no poses, as before the reconstruction.",
            "Convert the sfm_data.bin of the reconstruction (openMVG_main_ConvertSfM_DataFormat).",
        )
    views, excluded = [], []
    # Photos lie next to the file, in images or at OpenMVG's own path.
    roots = path.parent / "images", path.parent, path.parent.parent, *([Path(root)] if root else [])
    photos = PhotoFinder([_photo_name(entry) for entry in entries], roots, folder)
    for entry in entries:
        name = str(entry.get("filename", "")) if isinstance(entry, dict) else ""
        try:
            pose = poses.get(entry.get("id_pose"))
            if pose is None:
                raise LodgsError("OpenMVG has no pose for it.")
            lens = _parse_lens(lenses.get(entry.get("id_intrinsic")))
            rotation, center = parse_array(pose.get("rotation"), 3, 3), parse_array(pose.get("center"), 3)
            image = photos.find(_photo_name(entry))
            views.append(ExportedView(image, lens, invert_pose(np.column_stack([rotation.T, center]))))
        except (LodgsError, AttributeError, TypeError) as error:
            excluded.append((name, error.what if isinstance(error, LodgsError) else "its entry is damaged."))
    warnings = photos.warnings()
    points, colors = finite_points(path, points, np.full((len(points), 3), 128, np.uint8), warnings)
    return ExportedScene(views, points, colors, excluded, warnings)


def _parse_lens(values: Any) -> Intrinsics:
    if not isinstance(values, Mapping):
        raise LodgsError("it has no lens.")
    if "focal_length" not in values:  # distorted lenses nest the pinhole part
        values = {**values.get("value0", {}), **values}
    if "focal_length" not in values:
        raise LodgsError("its lens has no focal length, as that of a panorama.")
    center = parse_array(values.get("principal_point"), 2)
    focal = get_number(values, "focal_length")
    size = get_number(values, "width"), get_number(values, "height")
    radial, tangential, fisheye = (0.0,) * 3, (0.0, 0.0), False
    for name, coefficients in values.items():
        match name:
            case "disto_k1":
                radial = (float(parse_array(coefficients, 1)[0]), 0.0, 0.0)
            case "disto_k3":
                radial = tuple(parse_array(coefficients, 3).tolist())
            case "disto_t2":
                *k, p1, p2 = parse_array(coefficients, 5).tolist()
                radial, tangential = tuple(k), (p1, p2)
            case "fisheye":
                radial, fisheye = tuple(parse_array(coefficients, 4).tolist()), True
    principal_point = float(center[0]), float(center[1])
    return colmap_lens(*size, (focal, focal), principal_point, radial, tangential, fisheye)


def _photo_name(entry: Any) -> str:
    """Return the name of a view's photo with its folder; "" for a damaged entry."""
    return f"{entry.get('local_path', '')}/{entry.get('filename', '')}" if isinstance(entry, dict) else ""
