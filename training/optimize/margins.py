"""Extension of photos beyond their edges, so that views beside the camera path do not end in black.

The surroundings of the photos are unknown. They are filled with a blurred continuation of colour and depth
at the edge. Not in any paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter

from ..rasterize import Gaussians, rasterize
from ..scenes.cameras import Camera, pick_evenly
from ..splats.gaussians import SH_C0
from .training_data import TrainingData

MAX_VIEWS = 32
"""Maximum number of views to extend, evenly picked."""
CELLS = 32
"""Splats along an image's longer side in its margin, if the budget allows."""
MIN_CELLS = 10
"""Minimum number of cells. With fewer, splats would be large enough to reach into the photos."""
SPLAT_SIZE = 0.7
"""Standard deviation of a margin splat, as a multiple of the spacing."""
DEPTH_PIXELS = 64
"""Longer side of the depth maps of the views."""
OPACITY = 0.95
DEPTH_FACTOR = 1.1
"""Depth of margin splats as a multiple of the continued depth, so that they do not cover the photos."""
DEPTH_STEPS = (1.0, 1.3, 1.7, 2.5, 4.0, 8.0)
"""Further multiples of the depth to try if a splat would stand in front of visible surfaces."""
BLUR_SIGMAS = (1, 2, 4, 8, 16, 32)
"""Standard deviations of the blur in cells; the first with enough known weight is used."""
MIN_BLUR_WEIGHT = 0.02
"""Share of a blur's weight that has to be known."""


class MarginGenerator:
    """Generator of splats around the photos of training views.

    Args:
        data: training data; at most ``MAX_VIEWS`` of its training views are used.
        share: width of the margin on every side, as a share of a view's size; 0 disables.
        backend: rasterizer backend.
    """

    def __init__(self, data: TrainingData, share: float, backend: str) -> None:
        self._data = data
        self._cameras = pick_evenly(data.train, MAX_VIEWS)
        self._share = share
        self._near = data.near
        self._backend = backend

    @torch.no_grad()
    def extend(self, gaussians: Gaussians, max_splats: int) -> Gaussians:
        """Create splats where widened views are empty, none in front of surfaces that a view shows.

        Args:
            gaussians: N splats as they are drawn, in the world of the cameras.
            max_splats: maximum number of new splats; a lower limit gives larger splats.

        Returns:
            The new splats: round, of constant colour, almost opaque. None if the photos are transparent.
        """
        gaussians = gaussians.detach()
        if not self._share or self._data.transparent:
            return gaussians.select(slice(0))
        cells = CELLS
        depth_maps = [self._depth_map(gaussians, camera) for camera in self._cameras]
        while cells >= MIN_CELLS:
            total = gaussians
            for camera in self._cameras:
                if added := self._extend_view(total, camera, cells, depth_maps):
                    total = Gaussians.concatenated([total, added])
                if len(total) > len(gaussians) + max_splats:
                    break
            else:
                return total.select(slice(len(gaussians), None))
            cells = int(cells / sqrt(2))
        return gaussians.select(slice(0))

    def _depth_map(self, gaussians: Gaussians, camera: Camera) -> tuple[Camera, np.ndarray]:
        """Return a reduced view and its depth (H, W), inf near transparent pixels."""
        small = camera.scaled(DEPTH_PIXELS / max(camera.width, camera.height))
        _, alpha, depth = self._render(gaussians, small)
        transparent = maximum_filter(1 - alpha, 3) > 0.5
        return small, np.where(transparent, np.inf, maximum_filter(depth, 3))

    def _extend_view(
        self,
        gaussians: Gaussians,
        camera: Camera,
        cells: int,
        depth_maps: Sequence[tuple[Camera, np.ndarray]],
    ) -> Gaussians | None:
        """Create the splats of one view's margin, or return None if it is covered."""
        small = camera.scaled(cells / max(camera.width, camera.height))
        wide = small.widened(self._share)
        image, alpha, depth = self._render(gaussians, wide)
        covered = (alpha > 0.5) & (depth > 0)
        inverse = 1 / np.where(covered, depth, 1)
        values = np.concatenate([image / np.maximum(alpha, 0.5)[..., None], inverse[..., None]], 2)
        values, reached = blur_outward(values, covered)
        across = (wide.width - small.width) // 2
        down = (wide.height - small.height) // 2
        row, column = np.nonzero(~covered & reached)
        edge_row = row.clip(down, down + small.height - 1)
        edge_column = column.clip(across, across + small.width - 1)
        outside = (edge_row != row) | (edge_column != column)
        continued = outside & covered[edge_row, edge_column]  # skip photos whose edge is empty
        row, column = row[continued], column[continued]
        if not len(row):
            return None

        rays = np.stack([(column + 0.5 - wide.cx) / wide.fx, (row + 0.5 - wide.cy) / wide.fy], 1)
        rays = np.concatenate([rays, np.ones((len(rays), 1))], 1) @ wide.world_to_camera[:3, :3]
        start = DEPTH_FACTOR / values[row, column, 3]
        depths = np.full(len(rays), np.nan)
        for factor in DEPTH_STEPS:
            positions = wide.center + rays * (start * factor)[:, None]
            unplaced = np.flatnonzero(np.isnan(depths))
            free = unplaced[~_in_front(positions[unplaced], depth_maps)]
            depths[free] = factor * start[free]
        placed = ~np.isnan(depths)
        offsets = rays[placed] * depths[placed, None]
        sizes = SPLAT_SIZE * np.linalg.norm(offsets, axis=1) / wide.focal
        colors = values[row[placed], column[placed], :3]
        return _round_splats(wide.center + offsets, sizes, colors, like=gaussians)

    def _render(self, gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render colours (H, W, 3), alpha and median depth (H, W), antialiased as cells exceed splats."""
        with torch.no_grad():
            rendering = rasterize(
                gaussians,
                camera,
                near=self._near,
                antialias=True,
                outputs=("median_depth",),
                backend=self._backend,
            )
        assert rendering.median_depth is not None
        return (
            rendering.image.cpu().numpy(),
            rendering.alpha.cpu().numpy(),
            rendering.median_depth.cpu().numpy(),
        )


def blur_outward(values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extend values (H, W, C) from a known area (H, W), with a blur that increases with distance.

    Returns:
        The values, and the area (H, W) within reach of known values.
    """
    result = np.zeros_like(values)
    pending = np.ones_like(valid)
    masked = np.where(valid[..., None], values, 0)
    for blur in BLUR_SIGMAS:
        sigma = (blur, blur)
        weight = gaussian_filter(valid.astype(np.float64), sigma, mode="constant")
        reached = pending & (weight > MIN_BLUR_WEIGHT)
        total = gaussian_filter(masked, (*sigma, 0), mode="constant")
        result[reached] = total[reached] / weight[reached, None]
        pending &= ~reached
    return result, ~pending


def _in_front(positions: np.ndarray, depth_maps: Sequence[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """Find positions (P, 3) in front of the surfaces of any view, as (P,) bool."""
    in_front = np.zeros(len(positions), bool)
    for camera, nearest in depth_maps:
        inside = np.flatnonzero(camera.sees(positions))
        pixels, depth = camera.project(positions[inside])
        column, row = pixels.astype(int).T
        in_front[inside] |= depth < nearest[row, column]
    return in_front


def _round_splats(means: np.ndarray, sizes: np.ndarray, colors: np.ndarray, like: Gaussians) -> Gaussians:
    """Create round splats with means (N, 3), standard deviations (N,) and colours (N, 3).

    The degree of harmonics, data type and device are those of ``like``.
    """
    count = len(means)
    sh = np.zeros((count, like.sh.shape[1], 3))
    sh[:, 0] = (np.clip(colors, 0, 1) - 0.5) / SH_C0
    arrays = {
        "means": means,
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "log_scales": np.log(np.repeat(sizes[:, None], 3, 1)),
        "opacity_logits": np.full(count, np.log(OPACITY / (1 - OPACITY))),
        "sh": sh,
    }
    return Gaussians(**{name: torch.from_numpy(array).to(like.means) for name, array in arrays.items()})
