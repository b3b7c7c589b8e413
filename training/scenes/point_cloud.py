"""Coloured points from any PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..files import is_file
from ..splats.colors import color_names, full_intensity
from ..splats.ply import read_elements

_START_POINTS = "init.ply"
"""Brush's name of a point cloud in the scene folder that replaces the points of the model."""
_POINT_CLOUDS = "points3D.ply", "points3d.ply", "sparse_pc.ply"
"""Names of point clouds in the scene folder of models without points: those of 3DGS and nerfstudio."""


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the finite points (P, 3) and their colours (P, 3) uint8, grey by default; alpha is ignored.

    Raises:
        LodgsError: the file is missing or damaged, or has no points.
    """
    try:
        vertices = read_elements(path, splats=False)[0]["vertex"]
        points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except LodgsError as error:
        raise LodgsError(error.what, "Export the points again.") from error
    except (KeyError, ValueError, TypeError) as error:
        raise LodgsError(f"Cannot read points from {path}: {error}.", "Export the points again.") from error
    colors = np.full((len(points), 3), 128, np.uint8)
    if names := color_names(vertices.dtype.names or ()):
        columns = [vertices[name] for name in names]
        values = np.stack(columns, axis=1, dtype=np.float64) * (255 / full_intensity(columns))
        colors = np.nan_to_num(values).clip(0, 255).round().astype(np.uint8)
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite]


def find_cloud(folder: Path, model: Path, has_points: bool) -> Path | None:
    """Return the point cloud in place of a COLMAP model's points, or None.

    It is init.ply of the scene. For a model without points, it may also be points3D.ply or the only PLY in
    the folder of the model, or a file of a usual name in that of the scene.
    """
    candidates = [folder / _START_POINTS]
    if not has_points:
        clouds = sorted(path for path in model.iterdir() if path.suffix.lower() == ".ply" and is_file(path))
        candidates += [path for path in clouds if path.stem.lower() == "points3d"]
        candidates += clouds[: len(clouds) == 1]
        candidates += [folder / name for name in _POINT_CLOUDS]
    return next((path for path in candidates if is_file(path)), None)
