"""List the splats of each 16x16 tile, front to back.

A pair is one splat in one tile. Splats are sorted by depth once. A stable counting sort then distributes
pairs to tiles. Chunks of the depth order, not threads, determine the position of a pair, so the result does
not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..rendering import ALPHA_MIN
from .compile import STRICT, Buffers, f32, inlined, kernel, run_parallel, run_serial
from .fastmath import prefetch
from .project import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    PREFETCH,
)

TILE = 16
CHUNKS = 32
LOG2_ALPHA_MIN = f32(math.log2(ALPHA_MIN))
HALF, TWO, SPAN = f32(0.5), f32(2), f32(TILE - 1)


@dataclass
class Pairs:
    """Pairs of splats and tiles, tile by tile, front to back in each.

    Attributes:
        splat: (P,) int32, the splat of each pair.
        tile_start: (tiles + 1,) int64, index of each tile's first pair; tiles are in row-major order.
        first, count: (M,) int64 and int32: the pairs of splat i are row[first[i] : first[i] + count[i]].
        row: int32, positions in ``splat``; may have unused entries.
    """

    splat: np.ndarray
    tile_start: np.ndarray
    first: np.ndarray
    count: np.ndarray
    row: np.ndarray


@kernel(STRICT)
def sort_by_depth(keys, splats, spare_keys, target_splats):
    """Sort ``splats`` by their keys with a stable radix sort of three passes and 11 bits.

    Keys are the bits of positive float32 numbers as uint32, which have the order of the numbers. The sorted
    splats are stored in ``target_splats``. All four arrays have the same length and are overwritten.
    """
    source_keys, source, target_keys, target = keys, splats, spare_keys, target_splats
    start = np.empty(2049, np.int64)
    for shift in (0, 11, 22):
        for digit in range(2049):
            start[digit] = 0
        for i in range(keys.shape[0]):
            start[((source_keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            start[digit + 1] += start[digit]
        for i in range(keys.shape[0]):
            digit = (source_keys[i] >> np.uint32(shift)) & np.uint32(2047)
            target_keys[start[digit]] = source_keys[i]
            target[start[digit]] = source[i]
            start[digit] += 1
        source_keys, target_keys = target_keys, source_keys
        source, target = target, source


@inlined(STRICT)
def tile_range(middle, reach, tiles):
    """Return the first tile and one past the last with pixel centres within ``reach`` of ``middle``."""
    low = int(np.floor((middle - reach - HALF) / f32(TILE)))  # math.floor would call the C library
    high = int(np.floor((middle + reach - HALF) / f32(TILE))) + 1
    return max(0, min(low, tiles)), max(0, min(high, tiles))


@inlined(STRICT)
def touches(row, tile_x, tile_y):
    """Test if the ellipse alpha = ALPHA_MIN intersects the rectangle of a tile's pixel centres.

    The quadratic form is convex. If the mean is outside the rectangle, the minimum is on an edge that faces
    it.
    """
    left, top = f32(tile_x * TILE) + HALF - row[MEAN_X], f32(tile_y * TILE) + HALF - row[MEAN_Y]
    right, bottom = left + SPAN, top + SPAN
    outside_x, outside_y = left > 0 or right < 0, top > 0 or bottom < 0
    if not outside_x and not outside_y:
        return True
    a, b, c = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY]
    minimum = f32(np.inf)
    if outside_x:
        dx = left if left > 0 else right
        dy = min(max(-b * dx / (TWO * c), top), bottom)
        minimum = (a * dx + b * dy) * dx + c * dy * dy
    if outside_y:
        dy = top if top > 0 else bottom
        dx = min(max(-b * dy / (TWO * a), left), right)
        minimum = min(minimum, (a * dx + b * dy) * dx + c * dy * dy)
    return minimum <= row[LOG2_OPACITY] - LOG2_ALPHA_MIN


@kernel(STRICT)
def box_sizes(begin, end, projected, order, tiles_x, tiles_y, sizes):
    """Count the tiles in the bounding box of each splat, in depth order."""
    for k in range(begin, end):
        prefetch(projected, order[min(k + PREFETCH, order.shape[0] - 1)], 0)
        row = projected[order[k]]
        x0, x1 = tile_range(row[MEAN_X], row[HALF_WIDTH], tiles_x)
        y0, y1 = tile_range(row[MEAN_Y], row[HALF_HEIGHT], tiles_y)
        sizes[k] = (x1 - x0) * (y1 - y0)


@kernel(STRICT)
def find_tiles(begin, end, projected, order, box_start, tiles_x, tiles_y, first, count, hits, histogram):
    """List the tiles that each splat touches, and count them by chunk."""
    total = order.shape[0]
    for chunk in range(begin, end):
        tally = histogram[chunk]
        for k in range(total * chunk // CHUNKS, total * (chunk + 1) // CHUNKS):
            prefetch(projected, order[min(k + PREFETCH, total - 1)], 0)
            row = projected[order[k]]
            x0, x1 = tile_range(row[MEAN_X], row[HALF_WIDTH], tiles_x)
            y0, y1 = tile_range(row[MEAN_Y], row[HALF_HEIGHT], tiles_y)
            end = box_start[k]
            for tile_y in range(y0, y1):
                for tile_x in range(x0, x1):
                    if touches(row, tile_x, tile_y):
                        tile = tile_y * tiles_x + tile_x
                        hits[end] = tile
                        tally[tile] += 1
                        end += 1
            first[order[k]] = box_start[k]
            count[order[k]] = end - box_start[k]


@kernel(STRICT)
def pair_starts(histogram, tile_start):
    """Replace the counts of (chunk, tile) by the positions of their first pairs."""
    place = 0
    for tile in range(histogram.shape[1]):
        tile_start[tile] = place
        for chunk in range(CHUNKS):
            size = histogram[chunk, tile]
            histogram[chunk, tile] = place
            place += size
    tile_start[histogram.shape[1]] = place


@kernel(STRICT)
def place_pairs(begin, end, order, first, count, hits, histogram, splat):
    """Store every pair at its position, and replace the tiles in ``hits`` by these positions."""
    total = order.shape[0]
    for chunk in range(begin, end):
        place = histogram[chunk]
        for k in range(total * chunk // CHUNKS, total * (chunk + 1) // CHUNKS):
            i = order[k]
            for hit in range(first[i], first[i] + count[i]):
                tile = hits[hit]
                splat[place[tile]] = i
                hits[hit] = place[tile]
                place[tile] += 1


def bin_splats(
    projected: np.ndarray, drawn: np.ndarray, depths: np.ndarray, width: int, height: int, buffers: Buffers
) -> Pairs:
    """Bin the splats at indices ``drawn`` (D,) int32 of ``projected`` (M, COLUMNS), with their depths (D,).

    ``drawn`` and ``depths`` are overwritten. The result uses memory of ``buffers``.
    """
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    order = np.empty_like(drawn)
    keys = depths.view(np.uint32)
    run_serial(sort_by_depth, keys, drawn, np.empty_like(keys), order)

    box_start = np.zeros(len(order) + 1, np.int64)
    run_parallel(box_sizes, len(order), 4096, projected, order, tiles_x, tiles_y, box_start[1:])
    np.cumsum(box_start, out=box_start)
    first = buffers.take("first", np.int64, len(projected))
    count = buffers.take("count", np.int32, len(projected))
    count[:] = 0
    hits = buffers.take("hits", np.int32, int(box_start[-1]))
    histogram = np.zeros((CHUNKS, tiles_x * tiles_y), np.int32)
    run_parallel(
        find_tiles, CHUNKS, 1,
        projected, order, box_start, tiles_x, tiles_y, first, count, hits, histogram,
    )  # fmt: skip
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    run_serial(pair_starts, histogram, tile_start)
    splat = buffers.take("splat", np.int32, int(tile_start[-1]))
    run_parallel(place_pairs, CHUNKS, 1, order, first, count, hits, histogram, splat)
    return Pairs(splat, tile_start, first, count, hits)
