"""Brush and lasso strokes over an image, and the splats that they hit: visible ones, or all.

A stroke is a coverage for each pixel. It hits splats by the coverage at their projected means, or averaged
over their footprints; the same test applies to every level. Visibility is computed from the splats of the
image, per cell of pixels.

numpy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CELL_SIDES = (4, 8, 16, 32, 64, 128, 256)
"""Cell sizes in pixels for occlusion; a splat uses the smallest one of at least three standard deviations."""
OCCLUDING_THICKNESS = float(np.log(2))
"""Optical thickness that occludes: half of the light is absorbed."""
_REACH = 6.0
"""Extent of a footprint in standard deviations."""
_OFF_IMAGE = np.float32(-1e9)


def brush_coverage(
    path: np.ndarray, radius: float, size: tuple[int, int], hardness: float = 1.0
) -> np.ndarray:
    """Return the coverage (H, W) float32, 0 to 1, of a brush stroke along a polyline.

    Args:
        path: points (P, 2) in pixels, x and y from the corner of the first pixel.
        radius: radius in pixels.
        size: (W, H).
        hardness: fraction of the radius with coverage 1; outside, coverage falls as 3 t^2 - 2 t^3.
    """
    width, height = size
    coverage = np.zeros((height, width), np.float32)
    path = np.asarray(path, np.float64).reshape(-1, 2)
    for begin, end in zip(path, path[1:] if len(path) > 1 else path, strict=False):
        low = np.floor(np.minimum(begin, end) - radius).astype(int).clip(0)
        high = np.ceil(np.maximum(begin, end) + radius).astype(int).clip(0, size)
        x = np.arange(low[0], high[0]) + 0.5 - begin[0]
        y = (np.arange(low[1], high[1]) + 0.5 - begin[1])[:, None]
        segment = end - begin
        share = ((x * segment[0] + y * segment[1]) / max(segment @ segment, 1e-12)).clip(0, 1)
        distance = np.hypot(x - share * segment[0], y - share * segment[1]) / radius
        t = ((1 - distance) / max(1 - hardness, 1e-6)).clip(0, 1)
        window = coverage[low[1] : high[1], low[0] : high[0]]
        np.maximum(window, np.where(distance <= hardness, 1, t * t * (3 - 2 * t)), out=window)
    return coverage


def lasso_coverage(path: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W) bool: pixels with centres inside a closed polygon (even-odd rule).

    Args:
        path, size: see :func:`brush_coverage`.
    """
    width, height = size
    begin = np.asarray(path, np.float64).reshape(-1, 2)
    end = np.roll(begin, -1, axis=0)
    first, last = (  # rows whose pixel centres each edge crosses
        np.ceil(bound(begin[:, 1], end[:, 1]) - 0.5).astype(int).clip(0, height)
        for bound in (np.minimum, np.maximum)
    )
    rows = last - first
    edge = np.repeat(np.arange(len(begin)), rows)
    row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(rows) - rows, rows)
    share = (row + 0.5 - begin[edge, 1]) / (end[edge, 1] - begin[edge, 1])
    cross = begin[edge, 0] + share * (end[edge, 0] - begin[edge, 0])
    crossed = np.zeros((height, width + 1), np.int32)
    np.add.at(crossed, (row, np.ceil(cross - 0.5).astype(int).clip(0, width)), 1)
    return np.cumsum(crossed, axis=1)[:, :width] % 2 == 1


def middle_scale(scales: np.ndarray) -> np.ndarray:
    """Return the middle (N,) of three standard deviations (N, 3): the shorter one of a flat splat's face."""
    a, b, c = scales.T
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


@dataclass(frozen=True)
class ProjectedSplats:
    """Projections of N splats onto an image.

    Attributes:
        x, y: (N,) pixels of the means; far outside the image for splats behind the camera or clipped.
        depth: (N,) along the view direction, in the splats' units.
        pixel: (N,) size of a pixel at that depth, in the splats' units.
    """

    x: np.ndarray
    y: np.ndarray
    depth: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class Projection:
    """A perspective or orthographic projection from the splats' space to an image.

    Attributes:
        size: (W, H) in pixels, counted from the corner where clip space is -1.
        rows: (5, 4) float64: to x, y (pixels), z and w of clip space, and depth in the splats' units.
        unit: size of a pixel where w is 1, in the splats' units.
    """

    size: tuple[int, int]
    rows: np.ndarray
    unit: float

    @classmethod
    def of(cls, to_camera: np.ndarray, to_clip: np.ndarray, size: tuple[int, int]) -> Projection:
        """Return the projection of a camera with OpenGL axes, which looks along -z.

        Args:
            to_camera: (4, 4) from the splats' space to the camera's, at any scale.
            to_clip: (4, 4) from the camera's space to clip space.
        """
        scale = float(np.cbrt(abs(np.linalg.det(to_camera[:3, :3])))) or 1.0
        clip = to_clip @ to_camera
        pixels = 0.5 * np.array(size)[:, None] * (clip[:2] + clip[3])
        rows = np.vstack([pixels, clip[2:], -to_camera[2] / scale])
        return cls(size, rows, 2 / (size[0] * to_clip[0, 0] * scale))

    def place(self, means: np.ndarray) -> ProjectedSplats:
        """Project means (N, 3)."""
        linear = self.rows[:, :3].astype(np.float32)
        offset = self.rows[:, 3].astype(np.float32)
        x, y, z, w, depth = (linear @ means.T) + offset[:, None]
        inside = (w > 0) & (np.abs(z) < w)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.where(inside, x / w, _OFF_IMAGE), np.where(inside, y / w, _OFF_IMAGE)
        return ProjectedSplats(x, y, depth, w * np.float32(self.unit))


class OcclusionDepth:
    """Depth of occlusion in an image of splats.

    In each cell of pixels, splats absorb light by their footprint, 2 pi sigma^2 times opacity over the cell's
    area, with the middle standard deviation sigma. Points behind half absorption are hidden. Only splats of
    similar size combine, in cells of their size.

    Args:
        parts: splats of the image, (N,) each: projection, standard deviations (N, 3), and opacities times the
            weights of the level of detail.
    """

    def __init__(self, parts: Sequence[tuple[ProjectedSplats, np.ndarray, np.ndarray]]) -> None:
        by_side: list[list[tuple[np.ndarray, ...]]] = [[] for _ in CELL_SIDES]
        for splats, scales, opacities in parts:
            near_image = (splats.x > -CELL_SIDES[-1]) & (splats.y > -CELL_SIDES[-1])
            visible = np.flatnonzero(near_image & (opacities > 0))
            pixel = splats.pixel[visible]
            sigma = middle_scale(scales[visible]) / pixel
            kind = np.searchsorted(np.array(CELL_SIDES[:-1], np.float32), 3 * sigma)
            for number, side in enumerate(CELL_SIDES):
                of_side = np.flatnonzero(kind == number)
                rows = visible[of_side]
                thickness = np.float32(2 * np.pi / side**2) * sigma[of_side] ** 2 * opacities[rows]
                x = np.floor(splats.x[rows] / side).astype(np.int32)
                y = np.floor(splats.y[rows] / side).astype(np.int32)
                by_side[number].append((x, y, splats.depth[rows], thickness, side * pixel[of_side]))
        self._by_side = [tuple(map(np.concatenate, zip(*parts, strict=True))) for parts in by_side if parts]

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the depth (M,) behind which splats are hidden, at pixels x and y (M,)."""
        deepest = np.full(len(x), np.inf, np.float32)
        if not len(x):
            return deepest
        for side, (column, row, depth, thickness, width) in zip(CELL_SIDES, self._by_side, strict=False):
            cell_x = np.floor(x / side).astype(np.int32)
            cell_y = np.floor(y / side).astype(np.int32)
            left, low = cell_x.min() - 1, cell_y.min() - 1  # with a margin of one cell
            columns, rows = cell_x.max() - left + 2, cell_y.max() - low + 2
            near = (column >= left) & (column < left + columns) & (row >= low) & (row < low + rows)
            near = np.flatnonzero(near)
            cell = (row[near] - low) * columns + column[near] - left
            count = int(rows * columns)
            occluded, widths = _occlusion_depths(count, cell, depth[near], thickness[near], width[near])
            grid = _surface_depths(occluded.reshape(rows, columns), widths.reshape(rows, columns))
            np.minimum(deepest, grid[cell_y - low, cell_x - left], out=deepest)
        return deepest


def hit_strength(
    coverage: np.ndarray,
    splats: ProjectedSplats,
    reach: np.ndarray | None = None,
    occlusion: OcclusionDepth | None = None,
    sigma: np.ndarray | None = None,
) -> np.ndarray:
    """Return how strongly a stroke hits each splat, (N,); 0 or False for splats that it misses.

    Args:
        coverage: (H, W) of the stroke, see :func:`brush_coverage` and :func:`lasso_coverage`.
        splats: projections of the splats.
        reach: (N,) extent of splats in their units, to hit only visible ones.
        occlusion: of the same image; a splat is visible if its extent reaches in front of that depth.
        sigma: (N,) standard deviations in the splats' units: average the coverage over each splat's round
            footprint. None: use the coverage at the mean.
    """
    strength = np.zeros(len(splats.x), coverage.dtype if sigma is None else np.float32)
    rows = np.flatnonzero(coverage.any(axis=1))
    columns = np.flatnonzero(coverage.any(axis=0))
    if not len(rows):
        return strength
    pixels = None if sigma is None else sigma / splats.pixel
    margin = 0.0 if pixels is None else _REACH * pixels
    near = (splats.x >= columns[0] - margin) & (splats.x < columns[-1] + 1 + margin)
    near &= (splats.y >= rows[0] - margin) & (splats.y < rows[-1] + 1 + margin) & (splats.x > _OFF_IMAGE)
    hit = np.flatnonzero(near)
    x, y = splats.x[hit], splats.y[hit]
    if pixels is None:
        values = coverage[y.astype(np.int32), x.astype(np.int32)]
    else:
        values = _mean_around(coverage, x, y, pixels[hit])
    positive = values > 0
    hit, x, y, values = hit[positive], x[positive], y[positive], values[positive]
    if occlusion is not None and reach is not None:
        height, width = coverage.shape
        depth = occlusion.depth(x.clip(0, width - 1), y.clip(0, height - 1))
        visible = splats.depth[hit] - reach[hit] <= depth
        hit, values = hit[visible], values[visible]
    strength[hit] = values
    return strength


def _mean_around(image: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return Gaussian-weighted means (M,) float32 of an image (H, W) that is 0 outside.

    Approximated by trilinear sampling of an image pyramid; a level with cells of width w corresponds to a
    standard deviation of w / 2.

    Args:
        x, y, sigma: (M,) in pixels.
    """
    means = np.zeros(len(x), np.float32)
    scale = np.log2(np.maximum(2 * sigma, 1))
    cells, number = image.astype(np.float32), 0
    while True:
        last = max(cells.shape) == 1
        weight = np.maximum(1 - np.abs(scale - number), 0)
        used = np.flatnonzero((weight > 0) | (last & (scale > number)))
        weight[used] = np.where(last & (scale[used] > number), 1, weight[used])
        samples = _sample(cells, x[used] / 2**number, y[used] / 2**number, number > 0)
        means[used] += weight[used] * samples
        if last:
            return means
        height, width = (side + side % 2 for side in cells.shape)
        padded = np.zeros((height, width), np.float32)
        padded[: cells.shape[0], : cells.shape[1]] = cells
        cells = padded.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        number += 1


def _sample(cells: np.ndarray, x: np.ndarray, y: np.ndarray, linear: bool) -> np.ndarray:
    """Sample cells (H, W), 0 outside, at positions (M,) in cells: nearest, or bilinear."""
    height, width = cells.shape
    framed = np.zeros((height + 2, width + 2), np.float32)
    framed[1:-1, 1:-1] = cells

    def at(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        columns = (column + 1).clip(0, width + 1)
        rows = (row + 1).clip(0, height + 1)
        return framed[rows.astype(np.int32), columns.astype(np.int32)]

    if not linear:
        return at(np.floor(x), np.floor(y))
    left, low = np.floor(x - 0.5), np.floor(y - 0.5)
    right, up = x - 0.5 - left, y - 0.5 - low
    lower = (1 - right) * at(left, low) + right * at(left + 1, low)
    return (1 - up) * lower + up * ((1 - right) * at(left, low + 1) + right * at(left + 1, low + 1))


def _occlusion_depths(
    count: int, cell: np.ndarray, depth: np.ndarray, thickness: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each of ``count`` cells the depth where its splats occlude, and the cell's width there."""
    result = np.full((2, count), np.inf, np.float32)
    if len(cell):
        depth_bits = (depth - depth.min()).view(np.int32).astype(np.int64)  # sorts like the depth
        order = np.argsort((cell.astype(np.int64) << 32) + depth_bits)
        cell, thickness = cell[order], thickness[order].astype(np.float64)
        begins = np.append(True, cell[1:] != cell[:-1])
        absorbed = np.cumsum(thickness)
        absorbed -= (absorbed - thickness)[np.flatnonzero(begins)][np.cumsum(begins) - 1]
        occluding = np.flatnonzero(absorbed >= OCCLUDING_THICKNESS)[::-1]  # the nearest is written last
        result[:, cell[occluding]] = depth[order[occluding]], width[order[occluding]]
    return result[0], result[1]


def _surface_depths(occluded: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the depth of the surface's far side in cells (rows, columns): cell width plus slope are added.

    The slope along an axis is the smaller of the two steps to the neighbours, so that a step on one side only
    does not count.
    """
    finite = np.where(np.isinf(occluded), np.nan, occluded)
    depth = occluded + np.where(np.isinf(width), 0, width)
    for axis in (0, 1):
        steps = np.abs(np.diff(finite, axis=axis, prepend=np.nan, append=np.nan))
        lower, upper = (np.take(steps, range(s, s + occluded.shape[axis]), axis) for s in (0, 1))
        depth += np.nan_to_num(np.fmin(lower, upper))
    return depth
