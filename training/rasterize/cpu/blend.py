"""Every tile's splats blended front to back, and the gradients on the way back.

A pixel sees Σ w c with w = alpha T, T the transmittance of what lies in front (3DGS, Eq. 3). A tile is a
block of 16 rows of 16 lanes that Numba turns into SIMD; the loop over lanes has no branches. What it reads
and writes lies at fixed distances from one address, so that the compiler need not ask, for every row, whether
two arrays overlap: those questions took longer than the arithmetic.
"""

from __future__ import annotations

import numpy as np

from ..rendering import ALPHA_MAX, TRANSMITTANCE_MIN
from .bin import LOG2_ALPHA_MIN, TILE
from .compile import FAST, f32, inlined, kernel
from .fastmath import exp2, fetch_ahead
from .project import (
    AHEAD,
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
    RED,
    SUMS,
    G,
    strip_rows,
)

ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
CAP, T_MIN = f32(ALPHA_MAX), f32(TRANSMITTANCE_MIN)
SPAN = f32(TILE - 1)
"""From a tile's first pixel centre to its last."""
LOOK_EVERY = 16
"""After this many splats a tile looks whether any of its pixels still takes light."""


@inlined(FAST)
def find_rows(projected, splat, begin, end, left, top, rows, reached):
    """Fill reached (P, 2): the first and one past the last row of the tile that each of some pairs reaches.

    Done ahead of blending, which would have to wait for the roots.
    """
    for pair in range(begin, end):
        first, last = strip_rows(projected[splat[pair]], left, SPAN, top, rows)
        reached[pair, 0], reached[pair, 1] = first, last


@inlined(FAST)
def alpha_of(log2_alpha):
    """Alpha with its cap and its least value."""
    alpha = min(exp2(log2_alpha), CAP)
    return alpha if log2_alpha >= LOG2_ALPHA_MIN else ZERO


@kernel(FAST)
def blend_forward(
    begin, end, projected, splat, tile_start, tiles_x, background, limit,
    image, transmittance, walked, reached,
):  # fmt: skip
    """Fill image (3, H, W), transmittance (H, W), the pairs walked in each tile until all was dark, and the
    rows reached by each of those pairs, (P, 2) uint8.

    A lane's T turns negative when its pixel is finished (and is so from the start outside the image):
    whatever follows then fails the test against T_MIN, and |T| stays. So it is with the first splat that lies
    deeper than the pixel's ``limit`` (H, W). Where that is None, Numba compiles a kernel without it.
    """
    height, width = transmittance.shape
    # a row: 16 lanes each of T, red, green, blue, and of the limits
    state = np.empty((16, 64 if limit is None else 80), np.float32)
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        for r in range(16):
            for j in range(16):
                state[r, j] = ONE if r < rows and j < columns else -ONE
            for j in range(16, 64):
                state[r, j] = ZERO
            if limit is not None:
                for j in range(16):
                    inside = r < rows and j < columns
                    state[r, 64 + j] = limit[y0 + r, x0 + j] if inside else ZERO

        pair = tile_start[tile]
        lit = 1
        while lit > 0 and pair < tile_start[tile + 1]:
            start, end = pair, min(pair + LOOK_EVERY, tile_start[tile + 1])
            find_rows(projected, splat, start, end, left, top, rows, reached)
            for pair in range(start, end):
                row = projected[splat[pair]]
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                depth = row[DEPTH]
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for r in range(int(reached[pair, 0]), int(reached[pair, 1])):
                    dy = f32(r) + offset_y
                    xy_dy, rest = xy * dy, log2_opacity - yy * dy * dy
                    lanes = state[r]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        log2_alpha = rest - (xx * dx + xy_dy) * dx
                        alpha = alpha_of(log2_alpha)
                        t = lanes[j]
                        t_behind = t - alpha * t
                        takes = t_behind > T_MIN
                        if limit is not None:
                            takes = takes and depth <= lanes[64 + j]
                        w = alpha * t if takes else ZERO
                        lanes[j] = t_behind if takes else -abs(t)
                        lanes[16 + j] += w * red
                        lanes[32 + j] += w * green
                        lanes[48 + j] += w * blue
            pair = end
            lit = 0
            for r in range(16):
                for j in range(16):
                    lit += state[r, j] > ZERO
        walked[tile] = pair - tile_start[tile]

        for r in range(rows):
            for j in range(columns):
                t = abs(state[r, j])
                transmittance[y0 + r, x0 + j] = t
                for c in range(3):
                    image[c, y0 + r, x0 + j] = state[r, 16 + 16 * c + j] + t * background[c]


@kernel(FAST)
def blend_median(begin, end, projected, splat, tile_start, tiles_x, walked, limit, median):
    """Fill median (H, W): the splat that brings a pixel's T to a half or below; others stay.

    None is looked for beyond ``limit`` (H, W), which may be None.
    """
    height, width = median.shape
    state = np.empty(256, np.float32)
    chosen = np.empty(256, np.int32)
    limits = np.empty(256, np.float32)
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        state[:] = ONE
        chosen[:] = -1
        if limit is not None:
            for r in range(rows):
                for j in range(columns):
                    limits[16 * r + j] = limit[y0 + r, x0 + j]
        for pair in range(tile_start[tile], tile_start[tile] + walked[tile]):
            row = projected[splat[pair]]
            first, last = strip_rows(row, left, SPAN, top, rows)
            offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
            for r in range(first, last):
                dy = f32(r) + offset_y
                xy_dy = row[CONIC_XY] * dy
                rest = row[LOG2_OPACITY] - row[CONIC_YY] * dy * dy
                for j in range(16):
                    dx = f32(j) + offset_x
                    log2_alpha = rest - (row[CONIC_XX] * dx + xy_dy) * dx
                    alpha = alpha_of(log2_alpha)
                    t = state[16 * r + j]
                    behind = t - alpha * t
                    state[16 * r + j] = behind
                    reaches = t > HALF and behind <= HALF
                    if limit is not None:
                        reaches = reaches and row[DEPTH] <= limits[16 * r + j]
                    chosen[16 * r + j] = splat[pair] if reaches else chosen[16 * r + j]
        for r in range(rows):
            for j in range(columns):
                if chosen[16 * r + j] >= 0:
                    median[y0 + r, x0 + j] = chosen[16 * r + j]


@inlined(FAST)
def add_lanes(sums, offset_x, out):
    """Sum the lanes of one splat in one tile; dx depends on the lane only, so its moments are taken here."""
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
    """Fill pair_weights (P, 3): the largest weight, their sum, and the number of pixels of each pair.

    What lies behind pixels that are all dark already is not looked at.
    """
    state = np.empty((16, 16), np.float32)
    lanes = np.empty(48, np.float32)  # of each column of pixels the three
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        for r in range(16):
            for j in range(16):
                state[r, j] = ONE if r < rows and j < columns else -ONE
        pair, last_pair = tile_start[tile], tile_start[tile + 1]
        lit = 1
        while lit > 0 and pair < last_pair:
            stop = min(pair + LOOK_EVERY, last_pair)
            for k in range(pair, stop):
                row = projected[splat[k]]
                first, last = strip_rows(row, left, SPAN, top, rows)
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for j in range(48):
                    lanes[j] = ZERO
                for r in range(first, last):
                    dy = f32(r) + offset_y
                    xy_dy, rest = xy * dy, log2_opacity - yy * dy * dy
                    ts = state[r]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        alpha = alpha_of(rest - (xx * dx + xy_dy) * dx)
                        t = ts[j]
                        behind = t - alpha * t
                        takes = behind > T_MIN
                        w = alpha * t if takes else ZERO
                        ts[j] = behind if takes else -abs(t)
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
            lit = 0
            for r in range(16):
                for j in range(16):
                    lit += state[r, j] > ZERO
        for k in range(pair, last_pair):
            pair_weights[k, 0], pair_weights[k, 1], pair_weights[k, 2] = ZERO, ZERO, ZERO


def _backward(absolute: bool):
    """The kernel that fills pair_sums (P, SUMS), each pair's share of its splat's gradients.

    With h = d loss / d image, the loss gets Σ w (c·h) + T_end (background·h − d loss / d alpha) from a pixel.
    Let Q_i be the part of that sum that lies behind splat i. Then
        d loss / d alpha_i = T_i (c_i·h) − Q_i / (1 − alpha_i)
    and, as sigma = −ln alpha + const,
        g = d loss / d sigma = alpha_i Q_i / (1 − alpha_i) − w_i (c_i·h).
    Q starts as the whole sum, image·h − T_end d loss / d alpha, and is walked down front to back with T.
    A splat's sums are handed down from row to row of its tile.

    With ``absolute``, pair_sums has two more columns for Σ |d loss / d mean| / ln 2 over pixels, by x and by
    y (AbsGS, Ye et al. 2024).
    """
    # a row: 16 lanes each of the sums, of the three of h, of T and of Q
    H = 128 if absolute else 96
    T, Q, stride = H + 48, H + 64, H + 80

    @kernel(FAST)
    def blend_backward(
        begin, end, projected, splat, tile_start, tiles_x, walked, reached, image, transmittance,
        by_image, by_alpha, pair_sums,
    ):  # fmt: skip
        """Each pair's share of its splat's gradients (:func:`_backward` has the formulas)."""
        height, width = transmittance.shape
        state = np.empty(17 * stride, np.float32)  # the row above the first holds sums of zero only
        for j in range(state.shape[0]):
            state[j] = ZERO
        for tile in range(begin, end):
            x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            rows, columns = min(TILE, height - y0), min(TILE, width - x0)
            left, top = f32(x0) + HALF, f32(y0) + HALF
            for r in range(16):
                for j in range(16):
                    lane = (r + 1) * stride + j
                    if r < rows and j < columns:
                        y, x = y0 + r, x0 + j
                        q = -by_alpha[y, x] * transmittance[y, x]
                        for c in range(3):
                            state[lane + H + 16 * c] = by_image[c, y, x]
                            q += image[c, y, x] * by_image[c, y, x]
                        state[lane + T], state[lane + Q] = ONE, q
                    else:
                        state[lane + T] = -ONE

            lit = tile_start[tile] + walked[tile]
            for pair in range(tile_start[tile], lit):
                if pair % AHEAD == 0:
                    for later in range(pair + AHEAD, min(pair + 2 * AHEAD, lit)):
                        fetch_ahead(projected, splat[later], 0)
                row = projected[splat[pair]]
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                first, last = int(reached[pair, 0]), int(reached[pair, 1])
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for j in range(first * stride, first * stride + H):
                    state[j] = ZERO
                for r in range(first, last):
                    dy = f32(r) + offset_y
                    xy_dy, rest, dydy = xy * dy, log2_opacity - yy * dy * dy, dy * dy
                    above = state[r * stride : (r + 2) * stride]
                    for j in range(16):
                        dx = f32(j) + offset_x
                        log2_alpha = rest - (xx * dx + xy_dy) * dx
                        uncapped = exp2(log2_alpha)
                        alpha = min(uncapped, CAP)
                        alpha = alpha if log2_alpha >= LOG2_ALPHA_MIN else ZERO
                        t = above[stride + T + j]
                        t_behind = t - alpha * t
                        takes = t_behind > T_MIN
                        w = alpha * t if takes else ZERO
                        above[stride + T + j] = t_behind if takes else -abs(t)
                        h_red, h_green, h_blue = (
                            above[stride + H + j],
                            above[stride + H + 16 + j],
                            above[stride + H + 32 + j],
                        )
                        seen = w * (red * h_red + green * h_green + blue * h_blue)
                        q = above[stride + Q + j] - seen
                        above[stride + Q + j] = q
                        g = alpha * q / (ONE - alpha) - seen
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


blend_backward, blend_backward_absolute = _backward(False), _backward(True)
