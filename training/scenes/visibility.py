"""Visibility of points in a view, tested against the view's depth map. numpy only."""

from __future__ import annotations

import numpy as np

from .cameras import Camera

DEPTH_TOLERANCE = 0.01  # relative: a point this much behind the visible surface is hidden


def visible_points(depths: np.ndarray, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of points (N, 3) in a view, and a mask (N,) of the visible ones.

    A point is visible if its pixel has the point's depth, and none of the adjacent pixels is closer than its
    opposite neighbour explains: at outlines, depth maps mix two surfaces. The test uses 1 / depth, which is
    linear over the image for a plane, so that slanted planes are visible however much their depth changes
    within a pixel.

    Args:
        depths: (H, W) along the camera's z axis, at any resolution. 0 or a very large value marks missing
            depth; next to 0, no point is visible.
    """
    height, width = depths.shape
    pixels, depth = camera.project(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        grid = pixels * (width / camera.width)
        inside = (depth > 0) & (grid >= 1).all(1) & (grid < [width - 1, height - 1]).all(1)
        grid = np.where(inside[:, None], grid, 1)
        x, y = np.floor(grid).astype(int).T
        window = 1 / np.stack([depths[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        center = window[4]
        limit = 1 + DEPTH_TOLERANCE
        unoccluded = (window <= limit * np.maximum(center, 2 * center - window[::-1])).all(axis=0)
        shift_x, shift_y = (grid % 1 - 0.5).T
        plane = center + shift_x * (window[5] - window[3]) / 2 + shift_y * (window[7] - window[1]) / 2
        at_depth = np.fmin(np.abs(center * depth - 1), np.abs(plane * depth - 1)) < DEPTH_TOLERANCE
    return pixels, inside & unoccluded & at_depth
