"""An image of splats: projection, pairs of splats and tiles, blending, and the backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..rendering import RasterSettings
from .adam import repeat_rates
from .bin import TILE, bin_splats
from .blend import REACHED, blend_backward, blend_backward_absolute, blend_forward, blend_median
from .compile import Buffers, f32, run_parallel
from .project import COLUMNS, GRAIN, SUMS, kernel_arguments, project_forward
from .project_backward import project_backward

TILES = 16
"""Tiles in a thread's unit of work."""


class HostFrame:
    """Projected splats and their pairs with tiles. The arrays are in use until the object is deleted.

    Args:
        splats: means, quats, log-scales, opacity logits, sh and weights, contiguous; the weights may be
            empty if all are 1.
        rows: (M,) int32, the splats to draw; None draws all with positive weight.
        radii: (N,) zeros; filled, as in ``Rendering``.

    Attributes:
        index: (M,) int32, indices of the considered splats.
        projected: (M, COLUMNS), see ``project``; rows of splats that are not drawn are undefined.
        pairs: pairs of these rows and tiles.
        visited: (tiles,) int64, number of blended pairs of each tile. Set by :meth:`blend`.
        transmittance: (H, W). Set by :meth:`blend`.
    """

    def __init__(
        self,
        splats: list[np.ndarray],
        rows: np.ndarray | None,
        settings: RasterSettings,
        radii: np.ndarray,
    ) -> None:
        view = settings.view
        self._splats = splats
        antialias = np.atleast_1d(np.asarray(settings.antialias))  # one entry, or N
        self._settings = (
            *kernel_arguments(view),
            view.width,
            view.height,
            settings.degree,
            f32(settings.min_scale),
            antialias,
        )
        weights = splats[-1]
        if rows is None:
            rows = (np.flatnonzero(weights > 0) if len(weights) else np.arange(len(radii))).astype(np.int32)
        self.index = rows
        self.buffers = buffers = Buffers()
        self.projected = buffers.take("projected", np.float32, len(rows), COLUMNS)
        depths = np.empty(len(rows), np.float32)
        run_parallel(
            project_forward, len(rows), GRAIN, *splats, *self._settings, rows, depths, self.projected, radii
        )
        drawn = np.flatnonzero(depths > 0).astype(np.int32)  # faster than of floats
        self.pairs = bin_splats(self.projected, drawn, depths[drawn], view.width, view.height, buffers)
        self._tiles = self.pairs.splat, self.pairs.tile_start, -(-view.width // TILE)
        self._pair_rows = self.pairs.first, self.pairs.count, self.pairs.row
        self.visited = np.empty(len(self.pairs.tile_start) - 1, np.int64)
        self.transmittance = buffers.take("transmittance", np.float32, view.height, view.width)
        self._reached = buffers.take("reached", np.uint8, REACHED, len(self.pairs.splat))

    def blend(
        self, rows: np.ndarray, background: np.ndarray, image: np.ndarray, limit: np.ndarray | None = None
    ) -> None:
        """Fill image (3, H, W) from ``rows``: :attr:`projected`, or a copy with other colours."""
        run_parallel(
            blend_forward, len(self.visited), TILES, rows, *self._tiles, background, limit, image,
            self.transmittance, self.visited, self._reached,
        )  # fmt: skip

    def blend_median(self, limit: np.ndarray | None, median: np.ndarray) -> None:
        """Fill median (H, W) with splats of the frame; see ``BackendOutput``."""
        run_parallel(
            blend_median,
            len(self.visited),
            TILES,
            self.projected,
            *self._tiles,
            self.visited,
            limit,
            median,
        )
        median[median >= 0] = self.index[median[median >= 0]]

    def differentiate(
        self,
        rows: np.ndarray,
        image: np.ndarray,
        by_image: np.ndarray,
        by_alpha: np.ndarray,
        pair_sums: np.ndarray,
    ) -> None:
        """Fill pair_sums (P, SUMS) from the gradients of a blended image and of alpha.

        With two more columns, they are filled with the sums of absolute gradients; see ``blend``.
        """
        kernel = blend_backward if pair_sums.shape[1] == SUMS else blend_backward_absolute
        run_parallel(
            kernel, len(self.visited), TILES, rows, *self._tiles, self.visited, self._reached, image,
            self.transmittance, by_image, by_alpha, pair_sums,
        )  # fmt: skip

    def reduce(self, kernel: Any, pair_values: np.ndarray, values: np.ndarray) -> None:
        """Reduce values of pairs (P, K) to values of the considered splats, (M, K)."""
        run_parallel(kernel, len(self.index), GRAIN, *self._pair_rows, pair_values, values)

    def project_backward(
        self, pair_sums: np.ndarray, gradients: Sequence[np.ndarray] | None, grad2d: np.ndarray,
        steps: Sequence[tuple] | None = None, sparse_sh: bool = False,
    ) -> None:  # fmt: skip
        """Fill the gradients of the considered splats, and grad2d (N, 2).

        Args:
            gradients: one array for each of the splats' arrays, of the same shape. If None, the parameters
                make their Adam steps at once, and no gradients are stored.
            steps: for each parameter, the result of ``adam.step_arguments``.
            sparse_sh: harmonics of splats outside the image make no step.
        """
        if gradients is None:
            gradients = [array[:0] for array in self._splats]
        if steps is not None:
            steps = (*(repeat_rates(step, GRAIN) for step in steps[:-1]), steps[-1])
        run_parallel(
            project_backward, len(self.index), GRAIN, *self._splats, *self._settings, self.index,
            self.projected, *self._pair_rows, pair_sums, tuple(gradients), grad2d, steps,
            sparse_sh,
        )  # fmt: skip
