"""List the splats of each 16x16 tile, front to back, like the cpu backend's ``bin``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .device import LANES, Buffer, Device

TILE = 16
BLOCK = 1024
"""Values that one workgroup scans."""
SINGLE_GROUP = 16 * BLOCK
"""Maximum number of values that a single workgroup scans."""
DIGIT_BITS = 8
SORTED = 2048
"""Values that one workgroup sorts."""
DEPTH_BITS = 32


@dataclass
class Band:
    """Pairs of splats with a range of consecutive tiles, in row-major order.

    Attributes:
        tiles: range of tiles.
        count: number of pairs P.
        spans: (M, 2), first pair and number of pairs of each splat.
        entries: (P, 2), splat and index of each pair, tile by tile, front to back in each tile.
        starts: (M + 1,), first pair of each splat by depth, and the number of pairs without a limit.
    """

    tiles: range
    count: int
    spans: Buffer
    entries: Buffer
    starts: Buffer


def group_count(count: int, size: int = LANES) -> int:
    """Return the number of workgroups that process ``count`` values, ``size`` per group."""
    return -(-count // size)


def exclusive_scan(device: Device, values: Buffer) -> None:
    """Replace values (N,) uint32 by their exclusive prefix sums, in place."""
    (count,) = values.shape
    if count <= SINGLE_GROUP:
        device.run("scan", "scan_all", 1, (count,), values=values)
        return
    blocks = group_count(count, BLOCK)
    totals = device.scratch(np.uint32, blocks)
    device.run("scan", "total", blocks, (count,), values=values, totals=totals)
    exclusive_scan(device, totals)
    device.run("scan", "scan_blocks", blocks, (count,), values=values, starts=totals)


def sort(
    device: Device, keys: Buffer, values: Buffer, bits: int, totals: Buffer | None = None, slot: int = 0
) -> tuple[Buffer, Buffer]:
    """Sort keys of ``bits`` bits and their values in ascending order, stably; the inputs are overwritten.

    Only the first ``totals[slot]`` keys are sorted; None sorts all.
    """
    (count,) = keys.shape
    totals = totals or device.upload(np.array([count], np.uint32))
    blocks = group_count(count, SORTED)
    target = device.scratch(np.uint32, count), device.scratch(np.uint32, count)
    places, next_places = (device.scratch(np.uint32, 1 << DIGIT_BITS, blocks + 1) for _ in range(2))
    device.run(
        "sort", "count", blocks, (count, 0, blocks, slot, bits), keys=keys, places=places, totals=totals
    )
    for shift in range(0, bits, DIGIT_BITS):
        numbers = count, shift, blocks, slot, bits
        device.run("sort", "scan_blocks", 1 << DIGIT_BITS, numbers, places=places, next_places=next_places)
        device.run(
            "sort", "scatter", blocks, numbers, keys=keys, values=values, places=places,
            sorted_keys=target[0], sorted_values=target[1], totals=totals, next_places=next_places,
        )  # fmt: skip
        places, next_places = next_places, places
        (keys, values), target = target, (keys, values)
    return keys, values


def bin_splats(
    device: Device,
    rows: Buffer,
    depths: Buffer,
    order: Buffer,
    width: int,
    height: int,
    max_pairs: int,
    capacity: int | None = None,
) -> tuple[list[Band], Buffer]:
    """Bin projected splats.

    Args:
        rows: (M, 12), projected splats.
        depths: (M,) uint32, bits of the depths, which have the order of the depths; the maximum value for
            splats that are not drawn. Overwritten.
        order: (M,) uint32, indices of the splats. Overwritten.
        max_pairs: maximum number of pairs in a band of more than one tile.
        capacity: maximum number of pairs in a single band, whose number of pairs is not read from the device.
            ``starts`` of the band has it, so the caller can test if pairs were left out. None counts them.

    Returns:
        Bands that cover all tiles, found by bisection, and ranges (tiles, 2) of each tile's pairs in its
        band.
    """
    count = rows.shape[0]
    across = -(-width // TILE)
    down = -(-height // TILE)
    ranges = device.empty(np.uint32, across * down, 2)
    _, order = sort(device, depths, order, DEPTH_BITS)

    def bands(tiles: range) -> list[Band]:
        numbers = count, across, tiles.start, tiles.stop
        starts = device.scratch(np.uint32, count + 1)
        device.run("bin", "count", group_count(count), (*numbers, 0), rows=rows, order=order, counts=starts)
        exclusive_scan(device, starts)
        total = int(device.read(starts, count)[0]) if capacity is None else capacity
        middle = len(tiles) // 2
        if capacity is None and total > max_pairs and middle:
            return bands(tiles[:middle]) + bands(tiles[middle:])
        numbers = *numbers, total
        spans = device.scratch(np.uint32, count, 2)
        owners, tile_of, pairs = (device.scratch(np.uint32, total) for _ in range(3))
        entries = device.scratch(np.uint32, total, 2)
        device.run(
            "bin", "make_pairs", group_count(count), numbers, rows=rows, order=order, starts=starts,
            spans=spans, owners=owners, tiles=tile_of, pairs=pairs,
        )  # fmt: skip
        sorted_tiles, sorted_pairs = sort(device, tile_of, pairs, tiles.stop.bit_length(), starts, count)
        device.run(
            "bin", "find_ranges", group_count(total), numbers, sorted_tiles=sorted_tiles, starts=starts,
            sorted_pairs=sorted_pairs, owner_of=owners, entries=entries, ranges=ranges,
        )  # fmt: skip
        return [Band(tiles, total, spans, entries, starts)]

    return bands(range(across * down)), ranges
