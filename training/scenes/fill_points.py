"""Points in parts of photos without features, such as sky and plain walls, at their neighbours' depths."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

CELLS = 48
"""Number of cells along the longer side of a photo. A cell without points receives one."""
NEIGHBORS = 8
"""Number of nearest points in the photo whose depths a new point may have."""
COMPARED_VIEWS = 8
"""Number of closest views that compare colours."""
MAX_ANGLE = np.radians(60)
"""Maximum angle between the view directions of compared views."""
TOLERANCE = 3.0
"""Difference of colours, of 255, of similar depths. The largest one is used: a point there hides nothing."""


class PixelCamera(Protocol):
    """A camera with a lens, as pycolmap has it. Arrays are (N, 2) and, of points, (N, 3)."""

    width: int
    height: int

    def img_from_cam(self, points: np.ndarray, /) -> np.ndarray:
        """Project points of the camera's space to pixels."""
        ...

    def cam_from_img(self, pixels: np.ndarray, /) -> np.ndarray:
        """Return points at depth 1 from pixels, without their depth."""
        ...


class CellView(NamedTuple):
    """A photo in cells.

    Attributes:
        camera: camera of the photo, of any size.
        pose: (3, 4) world-to-camera transform.
        colors: (H, W, 3) mean colour of each cell, of 255; NaN where the photo is ignored.
        observed: indices (M,) of the points that the photo observes.
    """

    camera: PixelCamera
    pose: np.ndarray
    colors: np.ndarray
    observed: np.ndarray


def cell_colors(pixels: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the mean colours (h, w, 3) of a photo's cells; NaN in those that are not wholly visible.

    Args:
        pixels: (H, W, 3) colours.
        visible: (H, W) bool.
    """
    height, width = visible.shape
    size = max(max(height, width) / CELLS, 1)
    sums = np.where(visible[..., None], pixels, np.nan).astype(np.float32)
    counts = np.ones((1, 1, 1), np.float32)
    for axis, length in enumerate((height, width)):
        starts = np.linspace(0, length, max(round(length / size), 1), endpoint=False).astype(int)
        sums = np.add.reduceat(sums, starts, axis=axis)
        shape = [-1 if n == axis else 1 for n in range(3)]
        counts = counts * np.diff(starts, append=length).reshape(shape)
    return sums / counts


def fill_cells(
    views: Sequence[CellView],
    points: np.ndarray,
    deadline: float,
    report: Callable[[int], object] = int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points in cells of views without points, and their colours (N, 3) uint8.

    A new point has the depth of one of its neighbours in the photo: the one at which close views have the
    most similar colour. Points of earlier views also fill cells of later ones.

    Args:
        points: (N, 3) triangulated points.
        deadline: time of ``time.monotonic`` after which no view is filled.
        report: called with the number of filled views.
    """
    from scipy.spatial import KDTree  # Blender lacks scipy

    new, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    for number, view in enumerate(views):
        if time.monotonic() > deadline:
            break
        report(number)
        empty = np.isfinite(view.colors[..., 0])
        occupied, depths = [], []
        for positions in (points[view.observed], new):
            cells, z, inside = _project(view, positions)
            x, y = np.floor(cells[inside]).astype(int).T
            visible = empty[y, x]  # not a new point behind a feature
            occupied.append(cells[inside][visible])
            depths.append(z[inside][visible])
            empty[y, x] = False
        occupied, depths = np.concatenate(occupied), np.concatenate(depths)
        y, x = np.nonzero(empty)
        if not len(x) or len(occupied) < NEIGHBORS:
            continue
        nearest = KDTree(occupied).query(np.stack([x, y], axis=1) + 0.5, k=NEIGHBORS)[1]
        candidates = _lift(view, np.stack([x, y], axis=1) + 0.5, np.sort(depths[nearest], axis=1))
        costs = _color_costs(candidates, view.colors[y, x], _close_views(view, views))
        similar = costs <= costs.min(axis=1, keepdims=True) + TOLERANCE
        last = NEIGHBORS - 1 - similar[:, ::-1].argmax(axis=1)
        new = np.concatenate([new, candidates[np.arange(len(x)), last]])
        colors = np.concatenate([colors, np.rint(view.colors[y, x]).astype(np.uint8)])
    return new, colors


def _project(view: CellView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (N, 2) in cells of a view, depths, and True inside of the photo, of points (N, 3)."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool)
    height, width = view.colors.shape[:2]
    local = points @ view.pose[:, :3].T + view.pose[:, 3]
    with np.errstate(all="ignore"):
        pixels = np.asarray(view.camera.img_from_cam(local), np.float64)
    cells = pixels * [width / view.camera.width, height / view.camera.height]
    inside = (local[:, 2] > 0) & ((cells >= 0) & (cells < [width, height])).all(axis=1)
    return cells, local[:, 2], inside


def _lift(view: CellView, cells: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the positions (N, K, 3) of cells (N, 2) at depths (N, K)."""
    height, width = view.colors.shape[:2]
    pixels = cells * [view.camera.width / width, view.camera.height / height]
    rays = np.column_stack([view.camera.cam_from_img(pixels), np.ones(len(cells))])
    return (rays[:, None] * depths[..., None] - view.pose[:, 3]) @ view.pose[:, :3]


def _close_views(view: CellView, views: Sequence[CellView]) -> list[CellView]:
    """Return the closest views that look in a similar direction."""
    poses = np.array([other.pose for other in views])
    centers = -np.einsum("vji,vj->vi", poses[:, :, :3], poses[:, :, 3])
    distances = np.linalg.norm(centers + view.pose[:, :3].T @ view.pose[:, 3], axis=1)
    distances[poses[:, 2, :3] @ view.pose[2, :3] < np.cos(MAX_ANGLE)] = np.inf
    distances[[other is view for other in views]] = np.inf
    order = np.argsort(distances, kind="stable")[:COMPARED_VIEWS]
    return [views[n] for n in order if np.isfinite(distances[n])]


def _color_costs(candidates: np.ndarray, colors: np.ndarray, views: Sequence[CellView]) -> np.ndarray:
    """Return the median difference (N, K) of colours (N, 3) and those of views at candidates (N, K, 3).

    The difference is infinite where no view sees a candidate.
    """
    count, choices = candidates.shape[:2]
    differences = np.full((max(len(views), 1), count * choices), np.nan)
    expected = np.repeat(colors, choices, axis=0)
    for row, view in zip(differences, views, strict=False):
        cells, _, inside = _project(view, candidates.reshape(-1, 3))
        x, y = np.floor(cells[inside]).astype(int).T
        row[inside] = np.abs(view.colors[y, x] - expected[inside]).mean(axis=1)
    is_compared = np.isfinite(differences).any(axis=0)
    costs = np.full(count * choices, np.inf)
    costs[is_compared] = np.nanmedian(differences[:, is_compared], axis=0)
    return costs.reshape(count, choices)
