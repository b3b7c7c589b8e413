"""Which splats touch which 16x16 tile, front to back, as the cpu backend's ``bin`` has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .device import LANES, Buffer, Device

TILE = 16
BLOCK = 1024
"""Values that a workgroup sums up or sorts."""
FEW = 16 * BLOCK
"""Values that one workgroup sums up."""
DIGIT_BITS = 4
DEPTH_BITS = 32


@dataclass
class Band:
    """Pairs of splats with tiles that follow each other, row by row.

    Attributes:
        tiles: which.
        count: how many pairs, P.
        spans: (M, 2) each splat's first pair and the number of its pairs.
        sorted_pairs: (P,) pairs tile by tile, front to back in each.
        owners: (P,) the splats of these.
    """

    tiles: range
    count: int
    spans: Buffer
    sorted_pairs: Buffer
    owners: Buffer


def groups_of(count: int, each: int = LANES) -> int:
    """Workgroups that take ``each`` of ``count``."""
    return -(-count // each)


def sum_up(device: Device, values: Buffer) -> None:
    """Makes of values (N,) uint32 the sums of what lies before each, in place."""
    (count,) = values.shape
    if count <= FEW:
        device.run("scan", "few", 1, (count,), values=values)
        return
    blocks = groups_of(count, BLOCK)
    totals = device.empty(np.uint32, blocks)
    device.run("scan", "total", blocks, (count,), values=values, totals=totals)
    sum_up(device, totals)
    device.run("scan", "spread", blocks, (count,), values=values, starts=totals)


def sort(device: Device, keys: Buffer, values: Buffer, bits: int) -> tuple[Buffer, Buffer]:
    """Keys of so many bits in ascending order, and their values, stably; what was given is overwritten."""
    (count,) = keys.shape
    blocks = groups_of(count, BLOCK)
    other = device.empty(np.uint32, count), device.empty(np.uint32, count)
    for shift in range(0, bits, DIGIT_BITS):
        places = device.empty(np.uint32, (1 << DIGIT_BITS) * blocks)
        numbers = count, shift, blocks
        device.run("sort", "count", blocks, numbers, keys=keys, places=places)
        sum_up(device, places)
        device.run(
            "sort", "scatter", blocks, numbers, keys=keys, values=values, places=places,
            sorted_keys=other[0], sorted_values=other[1],
        )  # fmt: skip
        (keys, values), other = other, (keys, values)
    return keys, values


def bin_splats(
    device: Device, rows: Buffer, depths: Buffer, width: int, height: int, most: int
) -> tuple[list[Band], Buffer]:
    """Bins projected splats.

    Args:
        rows: (M, 12), projected.
        depths: (M,) uint32, the bits of their depths, which order as these do; the largest for those that are
            not drawn. Overwritten.
        most: pairs that a band may have, where it has more than one tile.

    Returns:
        The bands of all tiles, as few as halving finds, and (tiles, 2) where the pairs of each tile begin and
        end in its band.
    """
    count, across, down = rows.shape[0], -(-width // TILE), -(-height // TILE)
    order, ranges = device.empty(np.uint32, count), device.empty(np.uint32, across * down, 2)
    device.run("bin", "number", groups_of(count), (count, across, 0, 0), pairs=order)
    _, order = sort(device, depths, order, DEPTH_BITS)

    def bands(tiles: range) -> list[Band]:
        numbers = count, across, tiles.start, tiles.stop
        starts = device.empty(np.uint32, count + 1)
        device.run("bin", "count", groups_of(count), numbers, rows=rows, order=order, counts=starts)
        sum_up(device, starts)
        total, middle = int(device.read(starts, count)[0]), len(tiles) // 2
        if total > most and middle:
            return bands(tiles[:middle]) + bands(tiles[middle:])
        spans = device.empty(np.uint32, count, 2)
        owners, tile_of, pairs, sorted_owners = (device.empty(np.uint32, total) for _ in range(4))
        device.run(
            "bin", "make_pairs", groups_of(count), numbers, rows=rows, order=order, starts=starts,
            spans=spans, owners=owners, tiles=tile_of, pairs=pairs,
        )  # fmt: skip
        sorted_tiles, sorted_pairs = sort(device, tile_of, pairs, tiles.stop.bit_length())
        device.run(
            "bin", "find_ranges", groups_of(total), (total, *numbers[1:]), sorted_tiles=sorted_tiles,
            sorted_pairs=sorted_pairs, owner_of=owners, sorted_owners=sorted_owners, ranges=ranges,
        )  # fmt: skip
        return [Band(tiles, total, spans, sorted_pairs, sorted_owners)]

    return bands(range(across * down)), ranges
