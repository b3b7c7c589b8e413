"""Blocks of consecutive splats with bounds, to cull or read many splats at once. numpy only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..scenes.cameras import Camera

SIZE = 512
"""Rows per block."""
BLOCKS = "blocks"
"""Table of a bundle: the blocks of all levels, as a BlockIndex."""
BOUNDS = tuple(f"{end}_{axis}" for end in ("low", "high") for axis in "xyz")
"""Columns with the bounds of positions in a block."""
Columns = Mapping[str, np.ndarray]
Bounds = Mapping[str, tuple[str, np.ufunc]]
"""Column of splats, and its reduction over the rows of a block, of each column of an index."""
REACH = 3.4
"""Extent of a splat in standard deviations; farther out its alpha is below 1/255."""
SLANT = 1.3
"""Projection clamps a splat's direction to this factor times the image border."""
PIXELS = 2.0
"""Extent in pixels that the image filter adds to a projected splat."""

ROUNDING = 1e-4
"""Relative error of a distance in single precision."""


@dataclass(frozen=True, eq=False)
class BlockIndex:
    """An index of splats in B blocks of SIZE consecutive rows; the last block of a level is shorter.

    Attributes:
        lengths: number of rows of each level, by level number.
        columns: (B,) by name, level by level: BOUNDS of positions, ``reach`` of the largest splat from its
            mean, and reductions of the splats' columns, by default their maximum.
    """

    lengths: Mapping[int, int]
    columns: dict[str, np.ndarray]

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> BlockIndex:
        """Return the index of one level, (N, 3) each; bounds are tight only in :func:`spatial_order`."""
        begins = np.arange(0, len(means), SIZE)
        if not len(begins):
            empty = np.zeros((0, 3), np.float32)
            return cls.from_bounds(0, empty, empty, empty[:, 0])
        largest = np.maximum.reduceat(log_scales.max(axis=1), begins).astype(np.float64)
        return cls.from_bounds(
            len(means),
            np.minimum.reduceat(means, begins, axis=0),
            np.maximum.reduceat(means, begins, axis=0),
            (REACH * np.exp(np.minimum(largest, 60))).astype(np.float32),
        )

    @classmethod
    def from_bounds(cls, count: int, low: np.ndarray, high: np.ndarray, reach: np.ndarray) -> BlockIndex:
        """Return the index of one level of N rows with bounds (B, 3) of means, and the reach (B,)."""
        return cls({1: count}, dict(zip(BOUNDS, [*low.T, *high.T], strict=True)) | {"reach": reach})

    @classmethod
    def from_columns(cls, number: int, columns: Columns, bounds: Bounds) -> BlockIndex:
        """Return the index of a level with reductions of its columns (N,); missing ones are zeros.

        Args:
            bounds: column and reduction of each column of the index; bits in float32 are reduced as integers.
        """
        count = max(map(len, columns.values()), default=0)
        begins, zeros = np.arange(0, count, SIZE), np.zeros(count, np.float32)
        reduced = {}
        for name, (source, reduction) in bounds.items():
            values = columns.get(source, zeros)
            kind = values.dtype
            values = values.astype(np.int32) if reduction is np.bitwise_or else values
            reduced[name] = (reduction.reduceat(values, begins) if len(begins) else values).astype(kind)
        return cls({number: count}, reduced)

    @classmethod
    def from_table(cls, table: Columns, lengths: Mapping[int, int] | None = None) -> BlockIndex | None:
        """Return the index of a table BLOCKS; None if it contradicts the levels.

        Args:
            lengths: number of rows of each level; None means unknown, so only full blocks.
        """
        levels = table["level"]
        if lengths is None:
            numbers, counts = np.unique(levels, return_counts=True)
            lengths = dict(zip(numbers.tolist(), (SIZE * counts).tolist(), strict=True))
        index = cls(lengths, {name: column for name, column in table.items() if name != "level"})
        return index if np.array_equal(index.levels, levels) else None

    @classmethod
    def joined(cls, parts: Sequence[BlockIndex]) -> BlockIndex:
        """Join the indices of consecutive rows; each part but a level's last one has only full blocks."""
        lengths: dict[int, int] = {}
        for part in parts:
            for number, length in part.lengths.items():
                lengths[number] = lengths.get(number, 0) + length
        names = parts[0].columns
        return cls(lengths, {name: np.concatenate([part.columns[name] for part in parts]) for name in names})

    def as_table(self) -> dict[str, np.ndarray]:
        """Return the table BLOCKS of a bundle."""
        return {"level": self.levels, **self.columns}

    def __len__(self) -> int:
        return sum(map(_block_count, self.lengths.values()))

    @property
    def count(self) -> int:
        """Number of rows of all levels."""
        return sum(self.lengths.values())

    @cached_property
    def levels(self) -> np.ndarray:
        """Level number of each block, (B,) int32."""
        counts = [_block_count(length) for length in self.lengths.values()]
        return np.repeat(np.array([*self.lengths], np.int32), counts)

    @cached_property
    def begins(self) -> np.ndarray:
        """First row of each block in its level, (B,) int64."""
        parts = [np.arange(0, length, SIZE) for length in self.lengths.values()]
        return np.concatenate([np.zeros(0, np.int64), *parts])

    @cached_property
    def sizes(self) -> np.ndarray:
        """Number of rows of each block, (B,) int64."""
        lengths = [np.full(_block_count(length), length) for length in self.lengths.values()]
        return np.minimum(SIZE, np.concatenate([np.zeros(0, np.int64), *lengths]) - self.begins)

    @property
    def low(self) -> np.ndarray:
        """Lower bounds of positions, (B, 3)."""
        return np.stack([self.columns[name] for name in BOUNDS[:3]], axis=1)

    @property
    def high(self) -> np.ndarray:
        """Upper bounds of positions, (B, 3)."""
        return np.stack([self.columns[name] for name in BOUNDS[3:]], axis=1)

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
        middle, half = self.boxes
        radius = np.sqrt((half * half).sum(0))
        return np.stack([*middle, np.ones_like(radius), radius, self.columns["reach"]])

    @cached_property
    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres and half sizes of the bounds, (3, B) float64 each."""
        low, high = self.low.T.astype(np.float64), self.high.T.astype(np.float64)
        return (low + high) / 2, (high - low) / 2

    def distances(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return minimum and maximum distance of blocks from a position (3,), (B,) float64 each."""
        middle, half = self.boxes
        offset = np.abs(middle - np.asarray(position, np.float64)[:, None])
        nearest, farthest = np.maximum(offset - half, 0), offset + half
        return np.sqrt((nearest * nearest).sum(0)), np.sqrt((farthest * farthest).sum(0))

    def in_band(
        self, position: np.ndarray, near: float | np.ndarray, far: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compare blocks with the distance band near <= d < far around a position (3,).

        Args:
            near, far: distances for all blocks, or (B,) of each.

        Returns:
            (B,) bool: blocks that may have means in the band; and blocks with all means in it, also in single
            precision.
        """
        if isinstance(far, float) and (near, far) in ((0.0, np.inf), (np.inf, np.inf)):
            mask = np.full(len(self), near == 0)
            return mask, mask
        minimum, maximum = self.distances(position)
        partial = (maximum * (1 + ROUNDING) >= near) & (minimum * (1 - ROUNDING) < far)
        return partial, (minimum * (1 - ROUNDING) >= near) & (maximum * (1 + ROUNDING) < far)

    def level_rows(self, blocks: np.ndarray) -> dict[int, np.ndarray]:
        """Return the rows (M,) int64 of some blocks in their order, by level number.

        Args:
            blocks: (B,) bool, or indices.
        """
        levels, begins, sizes = self.levels[blocks], self.begins[blocks], self.sizes[blocks]
        rows = {}
        for number in self.lengths:
            inside = levels == number
            exists = np.arange(SIZE) < sizes[inside, None]
            rows[number] = (begins[inside, None] + np.arange(SIZE))[exists]
        return rows

    def rows(self, mask: np.ndarray) -> np.ndarray:
        """Return the rows (M,) int32 of one level, ascending, of the blocks that are True in (B,)."""
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

    def add_maxima(self, columns: Columns) -> None:
        """Add the maxima of columns (N,) that the index does not have yet, ignoring NaN."""
        begins = np.arange(0, self.count, SIZE)
        for name, column in columns.items():
            if name not in self.columns:
                self.columns[name] = np.fmax.reduceat(column, begins) if len(begins) else column


def block_table(bounds: Bounds, levels: Iterable[tuple[int, Columns]]) -> dict[str, np.ndarray]:
    """Return the table BLOCKS of levels.

    Args:
        bounds: see ``rule.Rule.block_bounds``.
        levels: number and columns (N,) of each level, or of consecutive rows of it, as many as full blocks.
    """
    return BlockIndex.joined(
        [BlockIndex.from_columns(number, columns, bounds) for number, columns in levels]
    ).as_table()


def _block_count(rows: int) -> int:
    return -(-rows // SIZE)


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
