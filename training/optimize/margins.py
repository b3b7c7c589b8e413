"""Photographs continued beyond their edges, so that a view beside the path does not end in black.

What no photograph shows nobody can know; what lies beside it can be guessed, blurred, from what they show
last: its colour and its depth go on. In no paper.
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

MAX_VIEWS = 32
"""Most views that are continued, evenly chosen."""
CELLS = 32
"""Splats along a photograph's longer side where it is continued, if there may be so many."""
MIN_CELLS = 10
"""No fewer: then photographs are not continued, as so large splats would reach into them."""
SPLAT_SIZE = 0.7
"""Their standard deviation, in the distance between two."""
DEPTH_PIXELS = 64
"""Pixels along that side of what is known of each view."""
OPACITY = 0.95
DEPTH_FACTOR = 1.1
"""They lie so many times as deep as what they continue, so that photographs stay as they are."""
DEPTH_STEPS = (1.0, 1.3, 1.7, 2.5, 4.0, 8.0)
"""Where one would stand before what a photograph shows, it is tried so many times as deep."""
BLUR_SIGMAS = (1, 2, 4, 8, 16, 32)
"""Standard deviations, in cells, of what one continues: of the first that reaches enough that is known."""
MIN_BLUR_WEIGHT = 0.02
"""The share of a blur's weight that is enough."""


class Margins:
    """What some training views would show if they were wider.

    Args:
        cameras: the training views, VIEWS of them at most are looked at.
        share: how much is continued on every side, as a share of a view's size.
        near: depth before which nothing is drawn, in scene units.
        backend: the rasterizer's.
    """

    def __init__(self, cameras: Sequence[Camera], share: float, near: float, backend: str) -> None:
        self._cameras = pick_evenly(cameras, MAX_VIEWS)
        self._share, self._near, self._backend = share, near, backend

    def extend(self, gaussians: Gaussians, most: int) -> Gaussians:
        """Splats where the wider views show next to nothing; none before what a view itself shows.

        Args:
            gaussians: N splats as they are drawn, in the world of the cameras.
            most: of new ones; they are the larger the fewer.

        Returns:
            The new ones: round, of one colour, almost opaque.
        """
        gaussians, cells = gaussians.detach(), CELLS
        known = [self._known(gaussians, camera) for camera in self._cameras]
        while cells >= MIN_CELLS:
            total = gaussians
            for camera in self._cameras:
                if added := self._beyond(total, camera, cells, known):
                    total = Gaussians.concatenated([total, added])
                if len(total) > len(gaussians) + most:
                    break
            else:
                return total.select(slice(len(gaussians), None))
            cells = int(cells / sqrt(2))
        return gaussians.select(slice(0))

    def _known(self, gaussians: Gaussians, camera: Camera) -> tuple[Camera, np.ndarray]:
        """A view made small, and the depth (H, W) before which it says what there is."""
        small = camera.scaled(DEPTH_PIXELS / max(camera.width, camera.height))
        _, alpha, depth = self._draw(gaussians, small)
        thin = maximum_filter(1 - alpha, 3) > 0.5
        return small, np.where(thin, np.inf, maximum_filter(depth, 3))

    def _beyond(
        self,
        gaussians: Gaussians,
        camera: Camera,
        cells: int,
        known: Sequence[tuple[Camera, np.ndarray]],
    ) -> Gaussians | None:
        """What continues one view where nothing does yet, if anything."""
        small = camera.scaled(cells / max(camera.width, camera.height))
        wide = small.widened(self._share)
        image, alpha, depth = self._draw(gaussians, wide)
        covered = (alpha > 0.5) & (depth > 0)
        inverse = 1 / np.where(covered, depth, 1)
        shown = np.concatenate([image / np.maximum(alpha, 0.5)[..., None], inverse[..., None]], 2)
        shown, reached = blur_outward(shown, covered)
        across, down = (wide.width - small.width) // 2, (wide.height - small.height) // 2
        row, column = np.nonzero(~covered & reached)
        edge_row = row.clip(down, down + small.height - 1)
        edge_column = column.clip(across, across + small.width - 1)
        outside = (edge_row != row) | (edge_column != column)
        goes_on = outside & covered[edge_row, edge_column]  # a photograph that ends in nothing does not
        row, column = row[goes_on], column[goes_on]
        if not len(row):
            return None

        rays = np.stack([(column + 0.5 - wide.cx) / wide.fx, (row + 0.5 - wide.cy) / wide.fy], 1)
        rays = np.concatenate([rays, np.ones((len(rays), 1))], 1) @ wide.world_to_camera[:3, :3]
        start = DEPTH_FACTOR / shown[row, column, 3]
        depths = np.full(len(rays), np.nan)
        for times in DEPTH_STEPS:
            places = wide.center + rays * (start * times)[:, None]
            open_ = np.flatnonzero(np.isnan(depths))
            free = open_[~_before(places[open_], known)]
            depths[free] = times * start[free]
        kept = ~np.isnan(depths)
        away = rays[kept] * depths[kept, None]
        size = SPLAT_SIZE * np.linalg.norm(away, axis=1) / wide.focal
        colors = shown[row[kept], column[kept], :3]
        return _round(wide.center + away, size, colors, like=gaussians)

    def _draw(self, gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours (H, W, 3), alpha and median depth (H, W); filtered, as cells are larger than splats."""
        with torch.no_grad():
            drawn = rasterize(
                gaussians,
                camera,
                near=self._near,
                antialias=True,
                outputs=("median_depth",),
                backend=self._backend,
            )
        assert drawn.median_depth is not None
        return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy(), drawn.median_depth.cpu().numpy()


def blur_outward(values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (H, W, C) continued from where they are known (H, W), the blurrier the farther away.

    Returns:
        The values, and where known ones are near enough to say any (H, W).
    """
    found, open_ = np.zeros_like(values), np.ones_like(known)
    masked = np.where(known[..., None], values, 0)
    for blur in BLUR_SIGMAS:
        sigma = (blur, blur)
        weight = gaussian_filter(known.astype(np.float64), sigma, mode="constant")
        here = open_ & (weight > MIN_BLUR_WEIGHT)
        summed = gaussian_filter(masked, (*sigma, 0), mode="constant")
        found[here] = summed[here] / weight[here, None]
        open_ &= ~here
    return found, ~open_


def _before(places: np.ndarray, known: Sequence[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """Which places (P, 3) stand, in a view, before what it shows."""
    found = np.zeros(len(places), bool)
    for camera, nearest in known:
        inside = np.flatnonzero(camera.sees(places))
        pixels, depth = camera.project(places[inside])
        column, row = pixels.astype(int).T
        found[inside] |= depth < nearest[row, column]
    return found


def _round(means: np.ndarray, sizes: np.ndarray, colors: np.ndarray, like: Gaussians) -> Gaussians:
    """Splats at places (N, 3), of standard deviations (N,) and colours (N, 3), beside others."""
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
