"""Errors of the levels in a part of space, for viewers that select levels by error.

The measure is that of PlayCanvas' splat-transform, so that its viewers can compare files: squared differences
from the finest level, relative to its squared values, in images along the six directions of the axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from ..rasterize import render, tensor_device
from ..rasterize.gaussians import Gaussians
from ..scenes.cameras import Camera, look_at
from ..splats.gaussians import Splats

VIEW_SIZES = 64, 128
"""Minimum and maximum width of the images in pixels."""
_DISTANCE = 200.0
"""Distance of the cameras in radii of the part: nearly parallel rays."""
_MARGIN = 1.05
"""Half width of the images in radii of the part."""
_PIXELS = 4.0
"""Pixels across the smallest splats, if the maximum width allows."""
_SMALL = 0.1
"""Quantile of the sizes of splats that counts as the smallest."""


def measure_level_errors(
    levels: Mapping[int, Splats], bounds: np.ndarray, backend: str = "auto"
) -> dict[int, float]:
    """Return the error of each level of detail; that of the finest is 0.

    Args:
        levels: splats by level of detail, of which the smallest number is the finest.
        bounds: (2, 3), minimum and maximum of the splats.
        backend: rasterizer backend.
    """
    finest = min(levels)
    cameras = _cameras(bounds, levels[finest]) if len(levels) > 1 else []
    near = float(np.linalg.norm(bounds[1] - bounds[0])) / 2
    images: dict[int, list[np.ndarray]] = {}
    for lod, splats in levels.items():
        views = render(Gaussians.of(splats, tensor_device(backend)), cameras, near=near, backend=backend)
        images[lod] = [np.nan_to_num(view).clip(0, 1) for view in views]  # extreme coefficients give NaN
    energy = sum(float(np.square(image).sum()) for image in images[finest])
    return {
        lod: sum(
            float(np.square(image - reference).sum())
            for image, reference in zip(images[lod], images[finest], strict=True)
        )
        / max(energy, 1e-12)
        for lod in levels
    }


def _cameras(bounds: np.ndarray, splats: Splats) -> list[Camera]:
    """Return the cameras of the six views of a part of space."""
    center, radius = bounds.mean(axis=0), max(float(np.linalg.norm(bounds[1] - bounds[0])) / 2, 1e-6)
    smallest = np.exp(np.quantile(splats.log_scales.max(axis=1).clip(-20, 20), _SMALL))
    low, high = VIEW_SIZES
    size = int(np.clip(np.ceil(_PIXELS * radius / smallest / 16) * 16, low, high))
    focal = _DISTANCE * size / 2 / _MARGIN
    cameras = []
    for axis, sign in product(range(3), (1.0, -1.0)):
        direction = sign * np.eye(3)[axis]
        pose = look_at(center + _DISTANCE * radius * direction, center, np.eye(3)[(axis + 1) % 3])
        cameras.append(Camera("", size, size, focal, focal, size / 2, size / 2, pose))
    return cameras
