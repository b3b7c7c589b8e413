"""Blend the splats of every tile front to back, and compute the gradients in the backward pass.

The colour of a pixel is Σ w c with w = alpha T, where T is the transmittance of the splats in front (3DGS,
Eq. 3). A tile is a block of 16 rows of 16 lanes, which Numba compiles to SIMD; the loop over lanes has no
branches. All its data is at fixed offsets from one address. Otherwise the compiler would test for overlapping
arrays in every row, which took longer than the arithmetic.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..rendering import ALPHA_MAX, TRANSMITTANCE_MIN
from .bin import LOG2_ALPHA_MIN, TILE
from .compile import FAST, f32, inlined, kernel
from .fastmath import any_positive, exp2, prefetch
from .project import (
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    G_BLUE,
    G_DX,
    G_DXDX,
    G_DXDY,
    G_DY,
    G_DYDY,
    G_GREEN,
    G_RED,
    GREEN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    PREFETCH,
    RED,
    SUMS,
    G,
    strip_rows,
)

ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
CAP, T_MIN = f32(ALPHA_MAX), f32(TRANSMITTANCE_MIN)
SPAN = f32(TILE - 1)
"""Distance from a tile's first pixel centre to its last."""
CHECK_INTERVAL = 16
"""Number of splats after which a tile checks if any pixel is unfinished."""


@inlined(FAST)
def find_rows(projected, splat, begin, end, left, top, rows, reached):
    """Fill reached (P, 2) with the first and one past the last row of the tile that each pair reaches.

    It runs before blending, which would otherwise wait for the square roots.
    """
    for pair in range(begin, end):
        first, last = strip_rows(projected[splat[pair]], left, SPAN, top, rows)
        reached[pair, 0], reached[pair, 1] = first, last


@inlined(FAST)
def read_lanes(plane, y, x, columns, lanes):
    """Read a plane's row from column ``x`` on to the first ``columns`` of 16 lanes; others keep their values.

    The compiler does not know that indices such as x + j are positive, and would gather single values.
    """
    values = plane[y, x : x + columns]
    if columns == 16:
        for j in range(16):
            lanes[j] = values[j]
    else:
        for j in range(columns):
            lanes[j] = values[j]


@inlined(FAST)
def alpha_of(log2_alpha):
    """Compute alpha with its upper and lower limits."""
    alpha = min(exp2(log2_alpha), CAP)
    return alpha if log2_alpha >= LOG2_ALPHA_MIN else ZERO


@kernel(FAST)
def blend_forward(
    begin, end, projected, splat, tile_start, tiles_x, background, limit,
    image, transmittance, visited, reached,
):  # fmt: skip
    """Fill image (3, H, W) and transmittance (H, W).

    Also fill ``visited`` with the number of pairs blended in each tile, and ``reached`` (P, 2) uint8 with the
    rows that they reach. A lane's T becomes negative when its pixel is finished, and is
    negative from the start outside the image. All later splats then fail the test against T_MIN, and |T| is
    preserved. The first splat deeper than the pixel's ``limit`` (H, W) finishes it too. If ``limit`` is None,
    Numba compiles a kernel without it.
    """
    height, width = transmittance.shape
    # a row has 16 lanes each for T, red, green, blue and the limits
    state = np.zeros((16, 64 if limit is None else 80), np.float32)
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        for r in range(16):
            for j in range(16):
                state[r, j] = ONE if r < rows and j < columns else -ONE
            for j in range(16, 64):
                state[r, j] = ZERO
            if limit is not None and r < rows:
                read_lanes(limit, y0 + r, x0, columns, state[r, 64:])

        pair = tile_start[tile]
        lit = True
        while lit and pair < tile_start[tile + 1]:
            start, end = pair, min(pair + CHECK_INTERVAL, tile_start[tile + 1])
            find_rows(projected, splat, start, end, left, top, rows, reached)
            for pair in range(start, end):
                row = projected[splat[pair]]
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                depth = row[DEPTH]
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for r in range(int(reached[pair, 0]), int(reached[pair, 1])):
                    dy = f32(r) + offset_y
                    xy_dy, base = xy * dy, log2_opacity - yy * dy * dy
                    lanes = state[r]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        log2_alpha = base - (xx * dx + xy_dy) * dx
                        alpha = alpha_of(log2_alpha)
                        t = lanes[j]
                        t_next = t - alpha * t
                        takes = t_next > T_MIN
                        if limit is not None:
                            takes = takes and depth <= lanes[64 + j]
                        w = alpha * t if takes else ZERO
                        lanes[j] = t_next if takes else -abs(t)
                        lanes[16 + j] += w * red
                        lanes[32 + j] += w * green
                        lanes[48 + j] += w * blue
            pair = end
            lit = any_positive(state)
        visited[tile] = pair - tile_start[tile]

        for r in range(rows):
            out = transmittance[y0 + r, x0 : x0 + columns]
            for j in range(min(columns, 16)):
                state[r, j] = abs(state[r, j])
                out[j] = state[r, j]
            for c in range(3):
                out = image[c, y0 + r, x0 : x0 + columns]
                for j in range(min(columns, 16)):
                    out[j] = state[r, 16 + 16 * c + j] + state[r, j] * background[c]


@kernel(FAST)
def blend_median(begin, end, projected, splat, tile_start, tiles_x, visited, limit, median):
    """Fill median (H, W) with the splat that reduces a pixel's T to a half or below; other pixels stay.

    Splats beyond ``limit`` (H, W) are ignored; it may be None.
    """
    height, width = median.shape
    state = np.empty(256, np.float32)
    median_splat = np.empty(256, np.int32)
    limits = np.empty(256, np.float32)
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        state[:] = ONE
        median_splat[:] = -1
        if limit is not None:
            for r in range(rows):
                for j in range(columns):
                    limits[16 * r + j] = limit[y0 + r, x0 + j]
        for pair in range(tile_start[tile], tile_start[tile] + visited[tile]):
            row = projected[splat[pair]]
            first, last = strip_rows(row, left, SPAN, top, rows)
            offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
            for r in range(first, last):
                dy = f32(r) + offset_y
                xy_dy = row[CONIC_XY] * dy
                base = row[LOG2_OPACITY] - row[CONIC_YY] * dy * dy
                for j in range(16):
                    dx = f32(j) + offset_x
                    log2_alpha = base - (row[CONIC_XX] * dx + xy_dy) * dx
                    alpha = alpha_of(log2_alpha)
                    t = state[16 * r + j]
                    t_next = t - alpha * t
                    state[16 * r + j] = t_next
                    reaches = t > HALF and t_next <= HALF
                    if limit is not None:
                        reaches = reaches and row[DEPTH] <= limits[16 * r + j]
                    median_splat[16 * r + j] = splat[pair] if reaches else median_splat[16 * r + j]
        for r in range(rows):
            for j in range(columns):
                if median_splat[16 * r + j] >= 0:
                    median[y0 + r, x0 + j] = median_splat[16 * r + j]


@inlined(FAST)
def add_lanes(sums, offset_x, out):
    """Sum the lanes of a pair. dx depends only on the lane, so its moments are computed here."""
    g, g_dx, g_dxdx, g_dy, g_dxdy, g_dydy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    red, green, blue = ZERO, ZERO, ZERO
    for j in range(16):
        dx = f32(j) + offset_x
        g += sums[j]
        g_dx += sums[j] * dx
        g_dxdx += sums[j] * dx * dx
        g_dy += sums[16 + j]
        g_dxdy += sums[16 + j] * dx
        g_dydy += sums[32 + j]
        red += sums[48 + j]
        green += sums[64 + j]
        blue += sums[80 + j]
    out[G], out[G_DX], out[G_DY] = g, g_dx, g_dy
    out[G_DXDX], out[G_DXDY], out[G_DYDY] = g_dxdx, g_dxdy, g_dydy
    out[G_RED], out[G_GREEN], out[G_BLUE] = red, green, blue


@kernel(FAST)
def blend_weights(begin, end, projected, splat, tile_start, tiles_x, width, height, pair_weights):
    """Fill pair_weights (P, 3) with the largest weight, the sum of weights and the pixel count of each pair.

    Splats behind finished pixels are skipped.
    """
    state = np.empty((16, 16), np.float32)
    lanes = np.empty(48, np.float32)  # the three values for each column of pixels
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        for r in range(16):
            for j in range(16):
                state[r, j] = ONE if r < rows and j < columns else -ONE
        pair, last_pair = tile_start[tile], tile_start[tile + 1]
        lit = True
        while lit and pair < last_pair:
            stop = min(pair + CHECK_INTERVAL, last_pair)
            for k in range(pair, stop):
                row = projected[splat[k]]
                first, last = strip_rows(row, left, SPAN, top, rows)
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for j in range(48):
                    lanes[j] = ZERO
                for r in range(first, last):
                    dy = f32(r) + offset_y
                    xy_dy, base = xy * dy, log2_opacity - yy * dy * dy
                    ts = state[r]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        alpha = alpha_of(base - (xx * dx + xy_dy) * dx)
                        t = ts[j]
                        t_next = t - alpha * t
                        takes = t_next > T_MIN
                        w = alpha * t if takes else ZERO
                        ts[j] = t_next if takes else -abs(t)
                        lanes[j] = max(lanes[j], w)
                        lanes[16 + j] += w
                        lanes[32 + j] += ONE if w > ZERO else ZERO
                largest, total, pixels = ZERO, ZERO, ZERO
                for j in range(16):
                    largest = max(largest, lanes[j])
                    total += lanes[16 + j]
                    pixels += lanes[32 + j]
                pair_weights[k, 0], pair_weights[k, 1], pair_weights[k, 2] = largest, total, pixels
            pair = stop
            lit = any_positive(state)
        for k in range(pair, last_pair):
            pair_weights[k, 0], pair_weights[k, 1], pair_weights[k, 2] = ZERO, ZERO, ZERO


def _make_backward(absolute: bool) -> Any:
    """Return the kernel that fills pair_sums (P, SUMS) with each pair's share of its splat's gradients.

    With h = d loss / d image, a pixel contributes Σ w (c·h) + T_end (background·h − d loss / d alpha) to the
    loss. Let Q_i be the part of this sum behind splat i. Then
        d loss / d alpha_i = T_i (c_i·h) − Q_i / (1 − alpha_i)
    and, as sigma = −ln alpha + const,
        g = d loss / d sigma = alpha_i Q_i / (1 − alpha_i) − w_i (c_i·h).
    Q starts as the complete sum, image·h − T_end d loss / d alpha, and is reduced front to back together with
    T. A splat's sums are accumulated from row to row of its tile.

    If ``absolute``, pair_sums has two more columns for Σ |d loss / d mean| / ln 2 over pixels, by x and by
    y (AbsGS, Ye et al. 2024).
    """
    # a row has 16 lanes each for the sums, the three channels of h, T and Q
    H = 128 if absolute else 96
    T, Q, stride = H + 48, H + 64, H + 80

    @kernel(FAST)
    def blend_backward(
        begin, end, projected, splat, tile_start, tiles_x, visited, reached, image, transmittance,
        by_image, by_alpha, pair_sums,
    ):  # fmt: skip
        """Fill pair_sums; :func:`_make_backward` has the formulas."""
        height, width = transmittance.shape
        values = np.zeros(16, np.float32)
        state = np.empty(17 * stride, np.float32)  # the row above the first is zero
        for j in range(state.shape[0]):
            state[j] = ZERO
        for tile in range(begin, end):
            x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            rows, columns = min(TILE, height - y0), min(TILE, width - x0)
            left, top = f32(x0) + HALF, f32(y0) + HALF
            for r in range(16):
                row = state[(r + 1) * stride : (r + 2) * stride]
                for j in range(16):
                    row[T + j] = ONE if r < rows and j < columns else -ONE
                if r < rows:
                    read_lanes(by_alpha, y0 + r, x0, columns, row[Q:])
                    read_lanes(transmittance, y0 + r, x0, columns, values)
                    for j in range(16):
                        row[Q + j] *= -values[j]
                    for c in range(3):
                        read_lanes(by_image[c], y0 + r, x0, columns, row[H + 16 * c :])
                        read_lanes(image[c], y0 + r, x0, columns, values)
                        for j in range(16):
                            row[Q + j] += values[j] * row[H + 16 * c + j]

            lit = tile_start[tile] + visited[tile]
            for pair in range(tile_start[tile], lit):
                if pair % PREFETCH == 0:
                    for later in range(pair + PREFETCH, min(pair + 2 * PREFETCH, lit)):
                        prefetch(projected, splat[later], 0)
                row = projected[splat[pair]]
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                first, last = int(reached[pair, 0]), int(reached[pair, 1])
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for j in range(first * stride, first * stride + H):
                    state[j] = ZERO
                for r in range(first, last):
                    dy = f32(r) + offset_y
                    xy_dy, base, dydy = xy * dy, log2_opacity - yy * dy * dy, dy * dy
                    above = state[r * stride : (r + 2) * stride]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        log2_alpha = base - (xx * dx + xy_dy) * dx
                        uncapped = exp2(log2_alpha)
                        alpha = min(uncapped, CAP)
                        alpha = alpha if log2_alpha >= LOG2_ALPHA_MIN else ZERO
                        t = above[stride + T + j]
                        t_next = t - alpha * t
                        takes = t_next > T_MIN
                        w = alpha * t if takes else ZERO
                        above[stride + T + j] = t_next if takes else -abs(t)
                        h_red, h_green, h_blue = (
                            above[stride + H + j],
                            above[stride + H + 16 + j],
                            above[stride + H + 32 + j],
                        )
                        received = w * (red * h_red + green * h_green + blue * h_blue)
                        q = above[stride + Q + j] - received
                        above[stride + Q + j] = q
                        g = alpha * q / (ONE - alpha) - received
                        g = g if takes and uncapped < CAP else ZERO
                        above[stride + j] = above[j] + g
                        above[stride + 16 + j] = above[16 + j] + g * dy
                        above[stride + 32 + j] = above[32 + j] + g * dydy
                        above[stride + 48 + j] = above[48 + j] + w * h_red
                        above[stride + 64 + j] = above[64 + j] + w * h_green
                        above[stride + 80 + j] = above[80 + j] + w * h_blue
                        if absolute:
                            by_x, by_y = g * (TWO * xx * dx + xy * dy), g * (xy * dx + TWO * yy * dy)
                            above[stride + 96 + j] = above[96 + j] + abs(by_x)
                            above[stride + 112 + j] = above[112 + j] + abs(by_y)
                sums = state[max(first, last) * stride :]
                add_lanes(sums, offset_x, pair_sums[pair])
                if absolute:
                    pair_sums[pair, SUMS], pair_sums[pair, SUMS + 1] = ZERO, ZERO
                    for j in range(16):
                        pair_sums[pair, SUMS] += sums[96 + j]
                        pair_sums[pair, SUMS + 1] += sums[112 + j]
            for pair in range(lit, tile_start[tile + 1]):
                for k in range(pair_sums.shape[1]):
                    pair_sums[pair, k] = ZERO

    return blend_backward


blend_backward, blend_backward_absolute = _make_backward(False), _make_backward(True)
