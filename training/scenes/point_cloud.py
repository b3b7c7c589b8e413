"""Coloured points from any PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyParseError

from ..documents import open_file
from ..errors import LodgsError


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the finite points (P, 3) and their colours (P, 3) uint8, grey by default.

    Raises:
        LodgsError: the file is missing or damaged, or has no points.
    """
    try:
        with open_file(path) as file:
            vertices = PlyData.read(file)["vertex"].data
        points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except LodgsError:
        raise
    except (PlyParseError, KeyError, ValueError, TypeError, MemoryError, OSError) as error:
        raise LodgsError(f"Cannot read points from {path}: {error}.", "Export the points again.") from error
    colors = np.full((len(points), 3), 128, np.uint8)
    names = ("red", "green", "blue")
    if set(names) <= set(vertices.dtype.names or ()):
        values = np.stack([vertices[name] for name in names], axis=1)
        if not np.issubdtype(values.dtype, np.integer):
            values = 255 * values
        colors = np.nan_to_num(values).clip(0, 255).astype(np.uint8)
    finite = np.isfinite(points).all(axis=1)
    return points[finite], colors[finite]
