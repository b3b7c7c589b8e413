"""Splats that stand together in blocks of rows, so that much can be decided for many at once. numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..scenes.cameras import Camera

SIZE = 512
"""Rows of a block."""
REACH = 3.4
"""Standard deviations that a splat reaches: farther out its alpha is below 1/255."""
SLANT = 1.3
"""A projected splat is spread as if it were seen at most so much farther out than the image's border."""
PIXELS = 2.0
"""What the image's filter adds to a projected splat's reach."""

ROUNDING = 1e-4
"""Share of a distance that single precision may get wrong."""
AXIS_BITS = 21
"""Halvings of space along each axis that the curve tells apart."""
_AT_ONCE = 1 << 16
"""Places that are found at a time."""


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
        """The blocks of splats, (N, 3) each; few are tight unless rows are in :func:`spatial_order`."""
        begins = np.arange(0, len(means), SIZE)
        if not len(begins):
            none = np.zeros((0, 3), np.float32)
            return cls(0, none, none, none[:, 0])
        largest = np.maximum.reduceat(log_scales.max(axis=1), begins).astype(np.float64)
        return cls(
            len(means),
            np.minimum.reduceat(means, begins, axis=0),
            np.maximum.reduceat(means, begins, axis=0),
            (REACH * np.exp(np.minimum(largest, 60))).astype(np.float32),
        )

    def in_view(self, camera: Camera, near: float) -> np.ndarray:
        """(B,) bool, False where no splat of a block is in a camera's image.

        Args:
            near: depth at which drawing begins, in world units.
        """
        x, y, z = camera.world_to_camera[:3]
        focals = np.array([camera.fx, camera.fx, camera.fy, camera.fy])
        right, below = camera.width - camera.cx, camera.height - camera.cy
        borders = np.array([right, camera.cx, below, camera.cy]) / focals
        # what the depth, and the distance beyond each side of the image, take of what _spheres has
        planes = np.zeros((5, 6))
        planes[0, :4], planes[1:, :4] = z, np.array([x, -x, y, -y]) - borders[:, None] * z
        planes[:, 4] = 1, *-np.hypot(1, borders)
        planes[1:, 5] = -np.hypot(1, SLANT * borders)
        found = planes @ self._spheres
        deepest, beyond = found[0], found[1:]
        return (deepest > near) & (beyond <= (PIXELS / focals)[:, None] * np.maximum(deepest, 0)).all(0)

    @cached_property
    def _spheres(self) -> np.ndarray:
        """(6, B) float64: of spheres about the bounds x, y, z of the middle, 1, the radius; and the reach."""
        middle, half = self._boxes
        radius = np.sqrt((half * half).sum(0))
        return np.stack([*middle, np.ones_like(radius), radius, self.reach])

    @cached_property
    def _boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles of the bounds and halves of their sides, (3, B) float64 each."""
        low, high = self.low.T.astype(np.float64), self.high.T.astype(np.float64)
        return (low + high) / 2, (high - low) / 2

    def distances(self, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest distance, (B,) float64 each, of a block's means from an eye (3,)."""
        middle, half = self._boxes
        away = np.abs(middle - np.asarray(eye, np.float64)[:, None])
        nearest, farthest = np.maximum(away - half, 0), away + half
        return np.sqrt((nearest * nearest).sum(0)), np.sqrt((farthest * farthest).sum(0))

    def between(
        self, eye: np.ndarray, near: float | np.ndarray, far: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Two times (B,) bool: False where no mean of a block is at a distance near <= d < far from an eye
        (3,); and True only where every one is, in single precision, too.

        Args:
            near, far: for all blocks, or (B,) of each.
        """
        if isinstance(far, float) and (near, far) in ((0.0, np.inf), (np.inf, np.inf)):
            found = np.full(len(self.low), near == 0)
            return found, found
        least, most = self.distances(eye)
        some = (most * (1 + ROUNDING) >= near) & (least * (1 - ROUNDING) < far)
        return some, (least * (1 - ROUNDING) >= near) & (most * (1 + ROUNDING) < far)

    def rows(self, which: np.ndarray) -> np.ndarray:
        """The rows (M,) int32 of the blocks that are True in (B,), ascending."""
        begins = np.flatnonzero(which).astype(np.int32) * SIZE
        rows = (begins[:, None] + np.arange(SIZE, dtype=np.int32)).reshape(-1)
        return rows[: len(rows) - max(int(begins[-1]) + SIZE - self.count, 0)] if len(begins) else rows

    def of_rows(self, which: np.ndarray, values: np.ndarray) -> np.ndarray:
        """``values[self.rows(which)]`` of values (N, ...): copied block by block, which is much faster."""
        if which.all():
            return values
        whole = self.count // SIZE
        found = values[: whole * SIZE].reshape(whole, SIZE, *values.shape[1:])[which[:whole]]
        found = found.reshape(-1, *values.shape[1:])
        return np.concatenate([found, values[whole * SIZE :]]) if which[whole:].any() else found

    def highest(self, values: np.ndarray) -> np.ndarray:
        """(B,) the greatest of the values (N,) in each block that are numbers."""
        return np.fmax.reduceat(values, np.arange(0, self.count, SIZE)) if self.count else values


def block_quantiles(values: np.ndarray, quantile: float) -> np.ndarray:
    """(N,) for each row the lower quantile, in [0, 1), of the values (N,) in its block."""
    blocks = -(-len(values) // SIZE)
    ordered = np.full((blocks, SIZE), -np.inf, values.dtype)
    ordered.reshape(-1)[: len(values)] = values
    ordered.sort(axis=1)
    counts = np.full(blocks, SIZE)
    counts[-1:] = len(values) - SIZE * (blocks - 1)
    found = ordered[np.arange(blocks), SIZE - counts + (quantile * counts).astype(int)]
    return np.repeat(found, SIZE)[: len(values)]


def spatial_order(means: np.ndarray) -> np.ndarray:
    """(N,) int64, an order of rows in which neighbours in space come near each other (a Z-order curve)."""
    return np.argsort(morton_codes(means), kind="stable")


def morton_codes(means: np.ndarray) -> np.ndarray:
    """(N,) uint64, where means (N, 3) are on a Z-order curve through a grid, of 2^AXIS_BITS cells along its
    longest side; each bit halves a box of cells, three one along each axis."""
    if not len(means):
        return np.zeros(0, np.uint64)
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.01, 0.99), axis=0)
    low, high = low - (high - low) / 4, high + (high - low) / 4  # the few beyond crowd at the border
    unit = ((1 << AXIS_BITS) - 1) / max(float((high - low).max()), 1e-30)
    code = np.zeros(len(means), np.uint64)
    for begin in range(0, len(means), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        cells = np.clip((means[some] - low) * unit, 0, (1 << AXIS_BITS) - 1)
        for axis, cell in enumerate(cells.astype(np.uint64).T):
            for shift, mask in (
                (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
            ):  # fmt: skip
                cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
            code[some] |= cell << np.uint64(axis)
    return code
