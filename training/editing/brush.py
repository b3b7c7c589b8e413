"""Which splats a stroke over a picture hits, a brush's or a lasso's: those that are seen there, or all.

A stroke is how strongly it covers each pixel. It hits splats whose means are projected there, or each as far
as it covers its footprint: the same test for every level. What is seen is told from the splats that a picture
shows, a cell of pixels at a time.

numpy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

CELL_SIDES = (4, 8, 16, 32, 64, 128, 256)
"""Pixels along the cells in which splats hide what is behind them: the smallest that hold three of their
standard deviations."""
OCCLUDING_THICKNESS = float(np.log(2))
"""Optical thickness behind which nothing counts as seen: half of the light."""
_REACH = 6.0
"""Standard deviations beyond which nothing counts in the mean of a footprint."""
_NOWHERE = np.float32(-1e9)


def brush_coverage(
    path: np.ndarray, radius: float, size: tuple[int, int], hardness: float = 1.0
) -> np.ndarray:
    """(H, W) float32, how strongly a brush covers pixels whose centres are within a radius of a path's points
    (P, 2), or of the way between them: from 1 down to 0 where it does not.

    Args:
        path: in pixels, x and y from the corner of the first one.
        size: (W, H).
        hardness: share of the radius up to which it is 1; beyond that it falls by 3 t^2 - 2 t^3.
    """
    width, height = size
    covered = np.zeros((height, width), np.float32)
    path = np.asarray(path, np.float64).reshape(-1, 2)
    for begin, end in zip(path, path[1:] if len(path) > 1 else path, strict=False):
        low = np.floor(np.minimum(begin, end) - radius).astype(int).clip(0)
        high = np.ceil(np.maximum(begin, end) + radius).astype(int).clip(0, size)
        x = np.arange(low[0], high[0]) + 0.5 - begin[0]
        y = (np.arange(low[1], high[1]) + 0.5 - begin[1])[:, None]
        along = end - begin
        share = ((x * along[0] + y * along[1]) / max(along @ along, 1e-12)).clip(0, 1)
        away = np.hypot(x - share * along[0], y - share * along[1]) / radius
        t = ((1 - away) / max(1 - hardness, 1e-6)).clip(0, 1)
        here = covered[low[1] : high[1], low[0] : high[0]]
        np.maximum(here, np.where(away <= hardness, 1, t * t * (3 - 2 * t)), out=here)
    return covered


def lasso_coverage(path: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, which pixels have their centres in the closed polygon of points (P, 2): an odd number of
    its edges is to their left.

    Args:
        path, size: see :func:`brush_coverage`.
    """
    width, height = size
    begin = np.asarray(path, np.float64).reshape(-1, 2)
    end = np.roll(begin, -1, axis=0)
    first, last = (  # rows of pixels whose centres an edge passes
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
    """(N,) the middle ones of three standard deviations (N, 3): of a flat splat's face, the shorter."""
    a, b, c = scales.T
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


@dataclass(frozen=True)
class ProjectedSplats:
    """Where a picture has N splats.

    Attributes:
        x, y: (N,) pixels of the means; far off where the picture has them not at all.
        depth: (N,) along the view, in the splats' units.
        pixel: (N,) how large a pixel is at that depth, in the splats' units.
    """

    x: np.ndarray
    y: np.ndarray
    depth: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class Projection:
    """How a picture shows places of the splats' own space, in perspective or without.

    Attributes:
        size: (W, H) in pixels, which are counted from the corner where clip space is -1.
        rows: (5, 4) float64: to x, y (pixels), z and w of clip space, and to the depth in the splats' units.
        unit: how large a pixel is where w is 1, in the splats' units.
    """

    size: tuple[int, int]
    rows: np.ndarray
    unit: float

    @classmethod
    def of(cls, to_camera: np.ndarray, to_clip: np.ndarray, size: tuple[int, int]) -> Projection:
        """That of a camera in OpenGL's axes: it looks along its -z.

        Args:
            to_camera: (4, 4) from the splats' space to the camera's, at any scale.
            to_clip: (4, 4) from there to clip space.
        """
        scale = float(np.cbrt(abs(np.linalg.det(to_camera[:3, :3])))) or 1.0
        clip = to_clip @ to_camera
        pixels = 0.5 * np.array(size)[:, None] * (clip[:2] + clip[3])
        rows = np.vstack([pixels, clip[2:], -to_camera[2] / scale])
        return cls(size, rows, 2 / (size[0] * to_clip[0, 0] * scale))

    def place(self, means: np.ndarray) -> ProjectedSplats:
        """Where means (N, 3) are."""
        to, more = self.rows[:, :3].astype(np.float32), self.rows[:, 3].astype(np.float32)
        x, y, z, w, depth = (to @ means.T) + more[:, None]
        there = (w > 0) & (np.abs(z) < w)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.where(there, x / w, _NOWHERE), np.where(there, y / w, _NOWHERE)
        return ProjectedSplats(x, y, depth, w * np.float32(self.unit))


class OcclusionDepth:
    """How deep one sees into the splats that a picture shows.

    In each cell of pixels splats take away light by their footprints, 2 pi sigma^2 times their opacity over
    the cell's area (sigma: the middle one of the three standard deviations), and what lies behind half of it
    is hidden. Splats of alike sizes hide together, in cells of their size.

    Args:
        parts: splats of the picture, (N,) each: where they are, their standard deviations (N, 3), and their
            opacities with the weights that levels of detail give them.
    """

    def __init__(self, parts: Sequence[tuple[ProjectedSplats, np.ndarray, np.ndarray]]) -> None:
        found: list[list[tuple[np.ndarray, ...]]] = [[] for _ in CELL_SIDES]
        for splats, scales, opacities in parts:
            shown = np.flatnonzero(
                (splats.x > -CELL_SIDES[-1]) & (splats.y > -CELL_SIDES[-1]) & (opacities > 0)
            )
            pixel = splats.pixel[shown]
            sigma = middle_scale(scales[shown]) / pixel
            kind = np.searchsorted(np.array(CELL_SIDES[:-1], np.float32), 3 * sigma)
            for number, side in enumerate(CELL_SIDES):
                some = np.flatnonzero(kind == number)
                rows = shown[some]
                thick = np.float32(2 * np.pi / side**2) * sigma[some] ** 2 * opacities[rows]
                x, y = (np.floor(each[rows] / side).astype(np.int32) for each in (splats.x, splats.y))
                found[number].append((x, y, splats.depth[rows], thick, side * pixel[some]))
        self._kinds = [tuple(map(np.concatenate, zip(*each, strict=True))) for each in found if each]

    def depth(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(M,) the depth behind which nothing is seen, at pixels (M,) and (M,)."""
        deepest = np.full(len(x), np.inf, np.float32)
        if not len(x):
            return deepest
        for side, (column, row, depth, thick, width) in zip(CELL_SIDES, self._kinds, strict=False):
            across, down = (np.floor(each / side).astype(np.int32) for each in (x, y))
            left, low = across.min() - 1, down.min() - 1  # with the cells around
            columns, rows = across.max() - left + 2, down.max() - low + 2
            near = (column >= left) & (column < left + columns) & (row >= low) & (row < low + rows)
            near = np.flatnonzero(near)
            cell = (row[near] - low) * columns + column[near] - left
            dark, widths = _darkened(int(rows * columns), cell, depth[near], thick[near], width[near])
            grid = _deepest(dark.reshape(rows, columns), widths.reshape(rows, columns))
            np.minimum(deepest, grid[down - low, across - left], out=deepest)
        return deepest


def hit_strength(
    covered: np.ndarray,
    splats: ProjectedSplats,
    reach: np.ndarray | None = None,
    front: OcclusionDepth | None = None,
    sigma: np.ndarray | None = None,
) -> np.ndarray:
    """(N,) how strongly a stroke hits splats; what it does not is 0, or False.

    Args:
        covered: (H, W) the stroke, see :func:`brush_coverage` and :func:`lasso_coverage`.
        sigma: (N,) standard deviations of splats in their units: each is hit as the stroke is in the mean of
            its round footprint, however small the one is beside the other. None: as it is at its mean.
        reach: (N,) how far splats reach, in their units, where only what is seen is to be hit.
        front: of the same picture; who reaches before its depth is seen.
    """
    found = np.zeros(len(splats.x), covered.dtype if sigma is None else np.float32)
    rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    if not len(rows):
        return found
    wide = None if sigma is None else sigma / splats.pixel
    beyond = 0.0 if wide is None else _REACH * wide
    near = (splats.x >= columns[0] - beyond) & (splats.x < columns[-1] + 1 + beyond)
    near &= (splats.y >= rows[0] - beyond) & (splats.y < rows[-1] + 1 + beyond) & (splats.x > _NOWHERE)
    some = np.flatnonzero(near)
    x, y = splats.x[some], splats.y[some]
    if wide is None:
        hit = covered[y.astype(np.int32), x.astype(np.int32)]
    else:
        hit = _mean_around(covered, x, y, wide[some])
    on = hit > 0
    some, x, y, hit = some[on], x[on], y[on], hit[on]
    if front is not None and reach is not None:
        height, width = covered.shape
        seen = splats.depth[some] - reach[some] <= front.depth(x.clip(0, width - 1), y.clip(0, height - 1))
        some, hit = some[seen], hit[seen]
    found[some] = hit
    return found


def _mean_around(image: np.ndarray, x: np.ndarray, y: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(M,) float32, means of an image (H, W), which is 0 around, weighted by round Gaussians.

    As textures are filtered: between cells and between sizes of cells of a pyramid. Between cells of a width,
    weights have half of it as standard deviation.

    Args:
        x, y, sigma: (M,) pixels.
    """
    found = np.zeros(len(x), np.float32)
    scale = np.log2(np.maximum(2 * sigma, 1))
    cells, number = image.astype(np.float32), 0
    while True:
        last = max(cells.shape) == 1
        weight = np.maximum(1 - np.abs(scale - number), 0)
        some = np.flatnonzero((weight > 0) | (last & (scale > number)))
        weight[some] = np.where(last & (scale[some] > number), 1, weight[some])
        found[some] += weight[some] * _between(cells, x[some] / 2**number, y[some] / 2**number, number > 0)
        if last:
            return found
        height, width = (side + side % 2 for side in cells.shape)
        even = np.zeros((height, width), np.float32)
        even[: cells.shape[0], : cells.shape[1]] = cells
        cells = even.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        number += 1


def _between(cells: np.ndarray, x: np.ndarray, y: np.ndarray, linear: bool) -> np.ndarray:
    """(M,) what cells (H, W), 0 around, are at places counted in them: of the nearest, or between four."""
    height, width = cells.shape
    framed = np.zeros((height + 2, width + 2), np.float32)
    framed[1:-1, 1:-1] = cells

    def at(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        columns, rows = ((each + 1).clip(0, end + 1) for each, end in ((column, width), (row, height)))
        return framed[rows.astype(np.int32), columns.astype(np.int32)]

    if not linear:
        return at(np.floor(x), np.floor(y))
    left, low = np.floor(x - 0.5), np.floor(y - 0.5)
    right, up = x - 0.5 - left, y - 0.5 - low
    lower = (1 - right) * at(left, low) + right * at(left + 1, low)
    return (1 - up) * lower + up * ((1 - right) * at(left, low + 1) + right * at(left + 1, low + 1))


def _darkened(
    count: int, cell: np.ndarray, depth: np.ndarray, thick: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The depth at which each of so many cells is dark by its splats (M,), and how wide the cell is there."""
    found = np.full((2, count), np.inf, np.float32)
    if len(cell):
        away = (depth - depth.min()).view(np.int32).astype(np.int64)  # in the order of the depths
        order = np.argsort((cell.astype(np.int64) << 32) + away)
        cell, thick = cell[order], thick[order].astype(np.float64)
        begins = np.append(True, cell[1:] != cell[:-1])
        passed = np.cumsum(thick)
        passed -= (passed - thick)[np.flatnonzero(begins)][np.cumsum(begins) - 1]
        dark = np.flatnonzero(passed >= OCCLUDING_THICKNESS)[::-1]  # so that the nearest stays
        found[:, cell[dark]] = depth[order[dark]], width[order[dark]]
    return found[0], found[1]


def _deepest(dark: np.ndarray, width: np.ndarray) -> np.ndarray:
    """How deep the surfaces in cells (rows, columns) reach: as deep as these are wide, and as they slant.

    A step to one side alone is no slant.
    """
    there = np.where(np.isinf(dark), np.nan, dark)
    found = dark + np.where(np.isinf(width), 0, width)
    for axis in (0, 1):
        steps = np.abs(np.diff(there, axis=axis, prepend=np.nan, append=np.nan))
        before, after = (np.take(steps, range(s, s + dark.shape[axis]), axis) for s in (0, 1))
        found += np.nan_to_num(np.fmin(before, after))
    return found
