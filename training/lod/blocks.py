"""Blocks of consecutive splats with bounds, to cull many splats at once. numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..scenes.cameras import Camera

SIZE = 512
"""Rows per block."""
REACH = 3.4
"""Extent of a splat in standard deviations; farther out its alpha is below 1/255."""
SLANT = 1.3
"""Projection clamps a splat's direction to this factor times the image border."""
PIXELS = 2.0
"""Extent in pixels that the image filter adds to a projected splat."""

ROUNDING = 1e-4
"""Relative error of a distance in single precision."""
AXIS_BITS = 21
"""Bits per axis of a Morton code."""
_BATCH = 1 << 16
"""Morton codes per batch."""


@dataclass(frozen=True)
class Blocks:
    """N splats in B blocks of SIZE consecutive rows, the last one shorter.

    Attributes:
        count: N.
        low, high: (B, 3) float32, bounds of the means.
        reach: (B,) float32, how far the largest splat reaches from its mean.
    """

    count: int
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> Blocks:
        """Return the blocks of splats, (N, 3) each; bounds are tight only in :func:`spatial_order`."""
        begins = np.arange(0, len(means), SIZE)
        if not len(begins):
            empty = np.zeros((0, 3), np.float32)
            return cls(0, empty, empty, empty[:, 0])
        largest = np.maximum.reduceat(log_scales.max(axis=1), begins).astype(np.float64)
        return cls(
            len(means),
            np.minimum.reduceat(means, begins, axis=0),
            np.maximum.reduceat(means, begins, axis=0),
            (REACH * np.exp(np.minimum(largest, 60))).astype(np.float32),
        )

    def in_view(self, camera: Camera, near: float) -> np.ndarray:
        """Return (B,) bool: blocks that may have splats in a camera's image.

        Args:
            near: depth where rendering begins, in world units.
        """
        x, y, z = camera.world_to_camera[:3]
        focals = np.array([camera.fx, camera.fx, camera.fy, camera.fy])
        right, below = camera.width - camera.cx, camera.height - camera.cy
        borders = np.array([right, camera.cx, below, camera.cy]) / focals
        # rows: depth, and signed distance beyond each side of the image; columns as in _spheres
        planes = np.zeros((5, 6))
        planes[0, :4], planes[1:, :4] = z, np.array([x, -x, y, -y]) - borders[:, None] * z
        planes[:, 4] = 1, *-np.hypot(1, borders)
        planes[1:, 5] = -np.hypot(1, SLANT * borders)
        signed = planes @ self._spheres
        depth, beyond = signed[0], signed[1:]
        return (depth > near) & (beyond <= (PIXELS / focals)[:, None] * np.maximum(depth, 0)).all(0)

    @cached_property
    def _spheres(self) -> np.ndarray:
        """(6, B) float64 of bounding spheres: x, y, z of the centre, 1, the radius; and the reach."""
        middle, half = self._boxes
        radius = np.sqrt((half * half).sum(0))
        return np.stack([*middle, np.ones_like(radius), radius, self.reach])

    @cached_property
    def _boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres and half sizes of the bounds, (3, B) float64 each."""
        low, high = self.low.T.astype(np.float64), self.high.T.astype(np.float64)
        return (low + high) / 2, (high - low) / 2

    def distances(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return minimum and maximum distance, (B,) float64 each, of a block's means from a position (3,)."""
        middle, half = self._boxes
        offset = np.abs(middle - np.asarray(position, np.float64)[:, None])
        nearest, farthest = np.maximum(offset - half, 0), offset + half
        return np.sqrt((nearest * nearest).sum(0)), np.sqrt((farthest * farthest).sum(0))

    def in_band(
        self, position: np.ndarray, near: float | np.ndarray, far: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compare blocks with the distance band near <= d < far around a position (3,).

        Args:
            near, far: for all blocks, or (B,) of each.

        Returns:
            (B,) bool: blocks that may have means in the band; and blocks with all means in it, also in single
            precision.
        """
        if isinstance(far, float) and (near, far) in ((0.0, np.inf), (np.inf, np.inf)):
            mask = np.full(len(self.low), near == 0)
            return mask, mask
        minimum, maximum = self.distances(position)
        partial = (maximum * (1 + ROUNDING) >= near) & (minimum * (1 - ROUNDING) < far)
        return partial, (minimum * (1 - ROUNDING) >= near) & (maximum * (1 + ROUNDING) < far)

    def rows(self, mask: np.ndarray) -> np.ndarray:
        """Return the rows (M,) int32, ascending, of the blocks that are True in (B,)."""
        begins = np.flatnonzero(mask).astype(np.int32) * SIZE
        rows = (begins[:, None] + np.arange(SIZE, dtype=np.int32)).reshape(-1)
        return rows[: len(rows) - max(int(begins[-1]) + SIZE - self.count, 0)] if len(begins) else rows

    def of_rows(self, mask: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return ``values[self.rows(mask)]`` of values (N, ...), copied block by block, which is faster."""
        if mask.all():
            return values
        full = self.count // SIZE
        selected = values[: full * SIZE].reshape(full, SIZE, *values.shape[1:])[mask[:full]]
        selected = selected.reshape(-1, *values.shape[1:])
        return np.concatenate([selected, values[full * SIZE :]]) if mask[full:].any() else selected

    def highest(self, values: np.ndarray) -> np.ndarray:
        """Return the maximum (B,) of the values (N,) in each block, ignoring NaN."""
        return np.fmax.reduceat(values, np.arange(0, self.count, SIZE)) if self.count else values


def block_quantiles(values: np.ndarray, quantile: float) -> np.ndarray:
    """Return for each row the lower quantile, in [0, 1), of the values (N,) in its block, (N,)."""
    blocks = -(-len(values) // SIZE)
    ordered = np.full((blocks, SIZE), -np.inf, values.dtype)
    ordered.reshape(-1)[: len(values)] = values
    ordered.sort(axis=1)
    counts = np.full(blocks, SIZE)
    counts[-1:] = len(values) - SIZE * (blocks - 1)
    quantiles = ordered[np.arange(blocks), SIZE - counts + (quantile * counts).astype(int)]
    return np.repeat(quantiles, SIZE)[: len(values)]


def spatial_order(means: np.ndarray) -> np.ndarray:
    """Return an order (N,) int64 of rows along a Z-order curve, where neighbours in space are close."""
    return np.argsort(morton_codes(means), kind="stable")


def morton_codes(means: np.ndarray) -> np.ndarray:
    """Return Morton codes (N,) uint64 of means (N, 3), with 2^AXIS_BITS cells along the longest side."""
    if not len(means):
        return np.zeros(0, np.uint64)
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.01, 0.99), axis=0)
    low, high = low - (high - low) / 4, high + (high - low) / 4  # outliers are clamped to the border
    unit = ((1 << AXIS_BITS) - 1) / max(float((high - low).max()), 1e-30)
    code = np.zeros(len(means), np.uint64)
    for begin in range(0, len(means), _BATCH):
        batch = slice(begin, begin + _BATCH)
        cells = np.clip((means[batch] - low) * unit, 0, (1 << AXIS_BITS) - 1)
        for axis, cell in enumerate(cells.astype(np.uint64).T):
            for shift, mask in (
                (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
            ):  # fmt: skip
                cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
            code[batch] |= cell << np.uint64(axis)
    return code
