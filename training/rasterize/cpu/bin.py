"""List the splats of each 16x16 tile, front to back.

A pair is one splat in one tile. Splats are sorted by depth once. A stable counting sort then distributes
pairs to tiles. Chunks of the depth order, not threads, determine the position of a pair, so the result does
not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .compile import FAST, STRICT, Buffers, f32, inlined, kernel, run_parallel, run_serial
from .fastmath import prefetch
from .project import (
    HALF_HEIGHT,
    HALF_WIDTH,
    MARGIN,
    MEAN_X,
    MEAN_Y,
    PREFETCH,
    RISE,
    SLOPE,
    X_OF_TOP,
    strip_bounds,
)

TILE = 16
MAX_CHUNKS, CHUNK = 32, 2048
"""Maximum number of chunks of the depth order, and their smallest size in splats."""
BOXES = 8192
"""Splats in a thread's unit of work of :func:`box_sizes`."""
HALF, SPAN = f32(0.5), f32(TILE - 1)


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


@kernel(STRICT)
def box_sizes(begin, end, projected, drawn, tiles_x, tiles_y, sizes):
    """Count the tiles in the bounding box of each splat."""
    for k in range(begin, end):
        row = projected[drawn[k]]
        x0, x1 = tile_range(row[MEAN_X], row[HALF_WIDTH], tiles_x)
        y0, y1 = tile_range(row[MEAN_Y], row[HALF_HEIGHT], tiles_y)
        sizes[k] = (x1 - x0) * (y1 - y0)


@kernel(FAST)
def find_tiles(begin, end, projected, drawn, box_start, tiles_x, tiles_y, first, count, hits):
    """List the tiles whose rectangle of pixel centres intersects the ellipse of each splat.

    An ellipse covers an interval of x in each row of tiles. ``strip_bounds`` is defined for columns of tiles,
    so x and y are exchanged.
    """
    limit = f32((tiles_x + 1) * TILE)  # bounds beyond the last tile stay there
    for k in range(begin, end):
        row = projected[drawn[k]]
        x0, x1 = tile_range(row[MEAN_X], row[HALF_WIDTH], tiles_x)
        y0, y1 = tile_range(row[MEAN_Y], row[HALF_HEIGHT], tiles_y)
        first[drawn[k]] = box_start[k]
        if box_start[k + 1] - box_start[k] == 1:  # most small splats
            hits[box_start[k]] = y0 * tiles_x + x0
            count[drawn[k]] = 1
            continue
        half_width, half_height = row[HALF_WIDTH], max(row[HALF_HEIGHT], MARGIN)
        slope = row[X_OF_TOP] / half_height
        rise = row[RISE] * half_width / half_height
        y_of_right = row[SLOPE] * half_width
        place = box_start[k]
        for tile_y in range(y0, y1):
            low, high = strip_bounds(
                row[MEAN_Y], row[MEAN_X], half_height, slope, rise, y_of_right,
                f32(tile_y * TILE) + HALF, SPAN, HALF, limit, f32(0),
            )  # fmt: skip
            # pixel columns of the interval: low - 1 to high - 1
            begin_x, end_x = int(np.ceil(low / f32(TILE))) - 1, int(np.floor((high + SPAN) / f32(TILE)))
            for tile_x in range(max(x0, begin_x), min(x1, end_x)):
                hits[place] = tile_y * tiles_x + tile_x
                place += 1
        count[drawn[k]] = place - box_start[k]


@inlined(STRICT)
def prefetch_hits(order, k, first, count, hits):
    """Prefetch the tiles of splats behind ``order[k]``."""
    last = order.shape[0] - 1
    ahead = order[min(k + 2 * PREFETCH, last)]
    prefetch(first, ahead, 0)
    prefetch(count, ahead, 0)
    prefetch(hits, first[order[min(k + PREFETCH, last)]], 0)


@kernel(STRICT)
def count_pairs(begin, end, order, first, count, hits, histogram):
    """Count the pairs of each chunk of the depth order by tile."""
    total, chunks = order.shape[0], histogram.shape[0]
    for chunk in range(begin, end):
        tally = histogram[chunk]
        for k in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            prefetch_hits(order, k, first, count, hits)
            i = order[k]
            for hit in range(first[i], first[i] + count[i]):
                tally[hits[hit]] += 1


@kernel(STRICT)
def pair_starts(histogram, tile_start):
    """Replace the counts of (chunk, tile) by the positions of their first pairs."""
    place = 0
    for tile in range(histogram.shape[1]):
        tile_start[tile] = place
        for chunk in range(histogram.shape[0]):
            size = histogram[chunk, tile]
            histogram[chunk, tile] = place
            place += size
    tile_start[histogram.shape[1]] = place


@kernel(STRICT)
def place_pairs(begin, end, order, first, count, hits, histogram, splat):
    """Store every pair at its position, and replace the tiles in ``hits`` by these positions."""
    total, chunks = order.shape[0], histogram.shape[0]
    for chunk in range(begin, end):
        place = histogram[chunk]
        for k in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            prefetch_hits(order, k, first, count, hits)
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
    box_start = np.zeros(len(drawn) + 1, np.int64)
    run_parallel(box_sizes, len(drawn), BOXES, projected, drawn, tiles_x, tiles_y, box_start[1:])
    np.cumsum(box_start, out=box_start)
    first = buffers.take("first", np.int64, len(projected))
    count = buffers.take("count", np.int32, len(projected))
    count[:] = 0
    hits = buffers.take("hits", np.int32, int(box_start[-1]))
    run_parallel(
        find_tiles, len(drawn), CHUNK, projected, drawn, box_start, tiles_x, tiles_y, first, count, hits
    )

    order = np.empty_like(drawn)
    keys = depths.view(np.uint32)
    run_serial(sort_by_depth, keys, drawn, np.empty_like(keys), order)
    chunks = min(max(len(drawn) // CHUNK, 1), MAX_CHUNKS)
    histogram = np.zeros((chunks, tiles_x * tiles_y), np.int32)
    run_parallel(count_pairs, chunks, 1, order, first, count, hits, histogram)
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    run_serial(pair_starts, histogram, tile_start)
    splat = buffers.take("splat", np.int32, int(tile_start[-1]))
    run_parallel(place_pairs, chunks, 1, order, first, count, hits, histogram, splat)
    return Pairs(splat, tile_start, first, count, hits)
