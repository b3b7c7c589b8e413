"""OpenMVG's sfm_data.json.

Facts: https://openmvg.readthedocs.io/en/latest/software/SfM/SfM_OutputFormat/ (views, intrinsics, extrinsics
as rotation from the world and centre, structure); radial_k3: k1, k2, k3; brown: k1, k2, k3, t1, t2; fisheye:
k1 to k4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import LodgsError
from ..colmap_model import Intrinsics
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

NAME = "OpenMVG"
_POINTS = "structure"


def find(folder: Path) -> Path | None:
    """sfm_data.json, in the folder or in what OpenMVG makes there."""
    names = "sfm_data.json", "reconstruction/sfm_data.json", "reconstruction_sequential/sfm_data.json"
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read(path: Path) -> ExportedScene:
    """Views and points; points have no colours there.

    Raises:
        LodgsError: the file is damaged.
    """
    document = read_document(path)
    try:
        lenses = {entry["key"]: entry["value"]["ptr_wrapper"]["data"] for entry in document["intrinsics"]}
        poses = {entry["key"]: entry["value"] for entry in document["extrinsics"]}
        listed = [entry["value"]["ptr_wrapper"]["data"] for entry in document["views"]]
        where = [entry["value"]["X"] for entry in document.get(_POINTS) or []]
        points = parse_array(where, -1, 3) if where else np.zeros((0, 3))
        root = str(document.get("root_path", ""))
    except (KeyError, TypeError, AttributeError) as error:
        raise LodgsError(
            f"{path} is no sfm_data of OpenMVG (it lacks {error}).", "Export it again."
        ) from error
    except LodgsError as error:
        raise LodgsError(f"{path} is damaged: {error.what}", "Export it again.") from error
    views, left_out = [], []
    for each in listed:
        name = str(each.get("filename", "")) if isinstance(each, dict) else ""
        try:
            pose = poses.get(each.get("id_pose"))
            if pose is None:
                raise LodgsError("OpenMVG has found no pose of it.")
            lens = _lens(lenses.get(each.get("id_intrinsic")))
            rotation, center = parse_array(pose.get("rotation"), 3, 3), parse_array(pose.get("center"), 3)
            image = _image(path.parent, root, str(each.get("local_path", "")), name)
            views.append(ExportedView(image, lens, invert_pose(np.column_stack([rotation.T, center]))))
        except (LodgsError, AttributeError, TypeError) as error:
            left_out.append((name, error.what if isinstance(error, LodgsError) else "it is damaged."))
    return ExportedScene(views, points, np.full((len(points), 3), 128, np.uint8), left_out)


def _lens(told: Any) -> Intrinsics:
    if not isinstance(told, Mapping):
        raise LodgsError("it has no lens.")
    if "focal_length" not in told:  # the pinhole part, of those that distort
        told = {**told.get("value0", {}), **told}
    center = parse_array(told.get("principal_point"), 2)
    focal = get_number(told, "focal_length")
    size = get_number(told, "width"), get_number(told, "height")
    radial, tangential, fisheye = (0.0,) * 3, (0.0, 0.0), False
    for name, values in told.items():
        match name:
            case "disto_k1":
                radial = (float(parse_array(values, 1)[0]), 0.0, 0.0)
            case "disto_k3":
                radial = tuple(parse_array(values, 3).tolist())
            case "disto_t2":
                *k, p1, p2 = parse_array(values, 5).tolist()
                radial, tangential = tuple(k), (p1, p2)
            case "fisheye":
                radial, fisheye = tuple(parse_array(values, 4).tolist()), True
    return colmap_lens(
        *size, (focal, focal), (float(center[0]), float(center[1])), radial, tangential, fisheye
    )


def _image(folder: Path, root: str, local: str, name: str) -> Path:
    """Beside the file, in ``images``, or where OpenMVG had it."""
    places = [find_image(each, f"{local}/{name}") for each in (folder / "images", folder, folder.parent)]
    if root:
        places.append(find_image(Path(root), f"{local}/{name}"))
    return next((place for place in places if place.is_file()), places[0])
