"""Which points a view sees, by the depths of the surfaces before it. numpy only."""

from __future__ import annotations

import numpy as np

from .cameras import Camera

DEPTH_TOLERANCE = 0.01  # relative: a point this much behind the surface that a view sees is hidden there


def visible_points(depths: np.ndarray, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a view sees points (N, 3): pixels (N, 2) and whether it does (N,).

    The pixel that a point falls on must lie at its depth, and none of the pixels about it before it, but for
    as much as the one across lies behind: at an outline they show a mixture. 1 / depth of a plane is linear
    over the picture, so that a slanted one is seen however far its depth goes within a pixel.

    Args:
        depths: (H, W) along the camera's z axis, of the surfaces in that view; its grid may be another one
            than the camera's. Of nothing they are 0, and nothing is seen beside it; or very large.
    """
    height, width = depths.shape
    pixels, depth = camera.project(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = pixels * (width / camera.width)
        inside = (depth > 0) & (places >= 1).all(1) & (places < [width - 1, height - 1]).all(1)
        places = np.where(inside[:, None], places, 1)
        x, y = np.floor(places).astype(int).T
        around = 1 / np.stack([depths[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        middle, more = around[4], 1 + DEPTH_TOLERANCE
        clear = (around <= more * np.maximum(middle, 2 * middle - around[::-1])).all(axis=0)
        across, down = (places % 1 - 0.5).T
        plane = middle + across * (around[5] - around[3]) / 2 + down * (around[7] - around[1]) / 2
        there = np.fmin(np.abs(middle * depth - 1), np.abs(plane * depth - 1)) < DEPTH_TOLERANCE
    return pixels, inside & clear & there
