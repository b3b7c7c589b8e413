"""Blend the splats of every tile front to back, and compute the gradients in the backward pass.

The colour of a pixel is Σ w c with w = alpha T, where T is the transmittance of the splats in front (3DGS,
Eq. 3). A tile has 16 rows of 16 pixels, in one part of 16 lanes or two parts of 8 lanes. A pair visits only
the rows of a part that its ellipse reaches.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..rendering import ALPHA_MAX, TRANSMITTANCE_MIN
from .bin import TILE
from .compile import FAST, f32, inlined, kernel
from .fastmath import any_positive, exp2, exp2_lanes, prefetch, read_lanes, write_lanes
from .lanes import (
    WIDTH,
    any_of,
    larger,
    load,
    magnitude,
    ramp,
    root,
    select,
    smaller,
    spread,
    store,
    store_bytes,
    store_totals,
    total,
)
from .project import (
    ALPHA_MIN32,
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    FALLOFF,
    G_DX,
    GREEN,
    HALF_WIDTH,
    LOG2_ALPHA_MIN32,
    LOG2_OPACITY,
    MARGIN,
    MEAN_X,
    MEAN_Y,
    PREFETCH,
    RED,
    RISE,
    SLOPE,
    SUMS,
    X_OF_TOP,
    G,
    strip_bounds,
    strip_rows,
)

ORDERED = FAST - {"reassoc"}
"""Flags for explicit vectors: the compiler must not move the small terms of sums out of loops."""
ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
CAP, T_MIN = f32(ALPHA_MAX), f32(TRANSMITTANCE_MIN)
SPAN = f32(TILE - 1)
"""Distance from a tile's first pixel centre to its last."""
PARTS = TILE // WIDTH
"""Parts of a tile, side by side."""
STRIPS = PARTS * TILE
"""Rows of the first part, then those of the next."""
GROUP = 2 * PARTS
REACHED = GROUP + 1
"""Values of a pair; see :func:`find_rows`."""
FORWARD = 5 * WIDTH
"""Values of a strip: T, red, green, blue and the limit, of each pixel."""
BACKWARD = 5 * WIDTH
"""Values of a strip in the backward pass: T, Q and three channels of h."""
REACHABLE, FAINTEST, INVISIBLE = f32(37), f32(-85), f32(-30)
"""In n rows with CONIC_YY n² < REACHABLE, no alpha rises from 2^FAINTEST to ALPHA_MIN, or falls from one of
these to a denormal number."""
CHECK_INTERVAL = 16
"""Number of splats after which a tile checks if any pixel is unfinished."""


@inlined(ORDERED)
def store_integers(values, start, end, lanes, spare):
    """Store the integer parts of lanes from ``start`` on, but none from ``end`` on."""
    if start + WIDTH <= end:
        store_bytes(values, start, lanes)
    else:
        store(spare, 0, lanes)
        for j in range(end - start):
            values[start + j] = int(spare[j])


@inlined(ORDERED)
def find_rows(projected, splat, begin, end, left, top, rows, spare, reached):
    """Fill reached (REACHED, P) with the rows that each pair reaches in each part of the tile.

    A part has the first row and one past the last, which may be smaller. The entry GROUP is the number of
    rows for which :func:`first_alphas` is valid. Lanes are pairs. This runs before blending, which would
    otherwise wait for the square roots. ``spare`` (7, WIDTH) is scratch memory.
    """
    for start in range(begin, end, WIDTH):
        for j in range(WIDTH):
            row = projected[splat[min(start + j, end - 1)]]
            spare[0, j], spare[1, j], spare[2, j] = row[MEAN_X], row[MEAN_Y], row[HALF_WIDTH]
            spare[3, j], spare[4, j], spare[5, j] = row[SLOPE], row[RISE], row[X_OF_TOP]
            spare[6, j] = row[CONIC_YY]
        mean_x, mean_y, half_width = load(spare[0], 0), load(spare[1], 0), load(spare[2], 0)
        slope, rise, x_of_top = load(spare[3], 0), load(spare[4], 0), load(spare[5], 0)
        group = root(REACHABLE / larger(load(spare[6], 0), f32(0.01)))
        store_integers(reached[GROUP], start, end, larger(smaller(group, f32(TILE)), ONE), spare[6])
        for part in range(PARTS):
            bounds = strip_bounds(
                mean_x, mean_y, half_width, slope, rise, x_of_top,
                left + f32(WIDTH * part), f32(WIDTH - 1), top, rows, MARGIN,
            )  # fmt: skip
            store_integers(reached[2 * part], start, end, bounds[0], spare[0])
            store_integers(reached[2 * part + 1], start, end, bounds[1], spare[1])


@inlined(FAST)
def alpha_of(log2_alpha):
    """Compute alpha with its upper and lower limits."""
    alpha = min(exp2(log2_alpha), CAP)
    return alpha if log2_alpha >= LOG2_ALPHA_MIN32 else ZERO


@inlined(ORDERED)
def first_alphas(constant, slope, yy, dy):
    """Return the alphas of a row at ``dy``, and their ratios to those of the next row.

    The logarithm of alpha is a parabola along a column of pixels, so alpha(row + 1) = alpha(row) ratio(row)
    and ratio(row + 1) = ratio(row) FALLOFF. Lanes that stay invisible for the next GROUP rows get a small
    alpha and the ratio 1. Otherwise numbers could become denormal, which is slow.
    """
    line = slope + yy * dy
    log2_alpha = constant - line * dy
    log2_ratio = ZERO - line - yy * (dy + ONE)
    invisible = (log2_alpha < FAINTEST) | ((log2_alpha < LOG2_ALPHA_MIN32) & (log2_ratio < ZERO))
    return (
        exp2_lanes(select(invisible, INVISIBLE, log2_alpha)),
        exp2_lanes(select(invisible, ZERO, log2_ratio)),
    )


@inlined(ORDERED)
def initial_transmittance(x, width, inside):
    """Return 1 in pixels of the image and -1 outside."""
    return select(ramp() + f32(x) < f32(width), ONE if inside else -ONE, spread(-ONE))


@kernel(ORDERED)
def blend_forward(
    begin, end, projected, splat, tile_start, tiles_x, background, limit,
    image, transmittance, visited, reached,
):  # fmt: skip
    """Fill image (3, H, W) and transmittance (H, W).

    Also fill ``visited`` with the number of pairs blended in each tile, and ``reached`` (REACHED, P) uint8;
    see :func:`find_rows`. A lane's T becomes negative when its pixel is finished, and is negative
    from the start outside the image. All later splats then fail the test against T_MIN, and |T| is preserved.
    The first splat deeper than the pixel's ``limit`` (H, W) finishes it too. If ``limit`` is None,
    Numba compiles a kernel without it.
    """
    height, width = transmittance.shape
    colors, transmittances = image.reshape(-1), transmittance.reshape(-1)
    if limit is not None:
        limits = limit.reshape(-1)
    state, spare = np.empty(STRIPS * FORWARD, np.float32), np.empty(WIDTH, np.float32)
    shapes = np.empty((7, WIDTH), np.float32)
    for tile in range(begin, end):
        x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
        rows = min(TILE, height - y0)
        left, top = f32(x0) + HALF, f32(y0) + HALF
        for strip in range(STRIPS):
            x, r = x0 + strip // TILE * WIDTH, strip % TILE
            place = strip * FORWARD
            store(state, place, initial_transmittance(x, width, r < rows))
            for c in range(1, 4):
                store(state, place + WIDTH * c, spread(ZERO))
            if limit is not None and r < rows:
                store(state, place + WIDTH * 4, read_lanes(limits, y0 + r, x, width, spare))  # pyrefly: ignore[unbound-name]

        pair = tile_start[tile]
        lit = True
        while lit and pair < tile_start[tile + 1]:
            start, end = pair, min(pair + CHECK_INTERVAL, tile_start[tile + 1])
            for later in range(end, min(end + CHECK_INTERVAL, tile_start[tile + 1])):
                prefetch(projected, splat[later], 0)
            find_rows(projected, splat, start, end, left, top, rows, shapes, reached)
            for pair in range(start, end):
                row = projected[splat[pair]]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                depth = row[DEPTH]
                xx, xy, yy, log2_opacity = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY], row[LOG2_OPACITY]
                falloff, group = row[FALLOFF], int(reached[GROUP, pair])
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                for part in range(PARTS):
                    dx = ramp() + (offset_x + f32(WIDTH * part))
                    constant, slope = log2_opacity - xx * dx * dx, xy * dx
                    first, last = int(reached[2 * part, pair]), int(reached[2 * part + 1, pair])
                    while first < last:
                        power, ratio = first_alphas(constant, slope, yy, spread(f32(first) + offset_y))
                        for r in range(first, min(first + group, last)):
                            place = (TILE * part + r) * FORWARD
                            alpha = select(power >= ALPHA_MIN32, smaller(power, CAP), ZERO)
                            power, ratio = power * ratio, ratio * falloff
                            t = load(state, place)
                            t_next = t - alpha * t
                            takes = t_next > T_MIN
                            if limit is not None:
                                takes = takes & (load(state, place + WIDTH * 4) >= depth)
                            w = select(takes, alpha * t, ZERO)
                            store(state, place, select(takes, t_next, ZERO - magnitude(t)))
                            store(state, place + WIDTH, load(state, place + WIDTH) + w * red)
                            store(state, place + 2 * WIDTH, load(state, place + 2 * WIDTH) + w * green)
                            store(state, place + 3 * WIDTH, load(state, place + 3 * WIDTH) + w * blue)
                        first += group
            pair = end
            largest = load(state, 0)
            for strip in range(1, STRIPS):
                largest = larger(largest, load(state, strip * FORWARD))
            lit = any_of(largest > ZERO)
        visited[tile] = pair - tile_start[tile]

        for strip in range(STRIPS):
            x, r = x0 + strip // TILE * WIDTH, strip % TILE
            if r < rows and x < width:
                t = magnitude(load(state, strip * FORWARD))
                write_lanes(transmittances, y0 + r, x, width, spare, t)
                for c in range(3):
                    color = load(state, strip * FORWARD + WIDTH * (c + 1))
                    write_lanes(colors, c * height + y0 + r, x, width, spare, color + t * background[c])


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
    T. A finished pixel has T = 0.

    If ``absolute``, pair_sums has two more columns for Σ |d loss / d mean| / ln 2 over pixels, by x and by
    y (AbsGS, Ye et al. 2024).
    """

    @kernel(ORDERED)
    def blend_backward(
        begin, end, projected, splat, tile_start, tiles_x, visited, reached, image, transmittance,
        by_image, by_alpha, pair_sums,
    ):  # fmt: skip
        """Fill pair_sums; :func:`_make_backward` has the formulas."""
        height, width = transmittance.shape
        colors, transmittances = image.reshape(-1), transmittance.reshape(-1)
        gradients, alpha_gradients = by_image.reshape(-1), by_alpha.reshape(-1)
        state, spare = np.empty(STRIPS * BACKWARD, np.float32), np.empty(WIDTH, np.float32)
        for tile in range(begin, end):
            x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
            rows = min(TILE, height - y0)
            left, top = f32(x0) + HALF, f32(y0) + HALF
            for strip in range(STRIPS):
                x, r = x0 + strip // TILE * WIDTH, strip % TILE
                place = strip * BACKWARD
                store(state, place, initial_transmittance(x, width, r < rows))
                if r < rows and x < width:
                    t = read_lanes(transmittances, y0 + r, x, width, spare)
                    q = ZERO - t * read_lanes(alpha_gradients, y0 + r, x, width, spare)
                    for c in range(3):
                        line = c * height + y0 + r
                        h = read_lanes(gradients, line, x, width, spare)
                        q = q + read_lanes(colors, line, x, width, spare) * h
                        store(state, place + WIDTH * (2 + c), h)
                    store(state, place + WIDTH, q)
                else:
                    for c in range(1, 5):
                        store(state, place + WIDTH * c, spread(ZERO))

            lit = tile_start[tile] + visited[tile]
            for pair in range(tile_start[tile], lit):
                if pair % PREFETCH == 0:
                    for later in range(pair + PREFETCH, min(pair + 2 * PREFETCH, lit)):
                        prefetch(projected, splat[later], 0)
                row = projected[splat[pair]]
                xx, xy, yy = row[CONIC_XX], row[CONIC_XY], row[CONIC_YY]
                red, green, blue = row[RED], row[GREEN], row[BLUE]
                offset_x, offset_y = left - row[MEAN_X], top - row[MEAN_Y]
                falloff, group = row[FALLOFF], int(reached[GROUP, pair])
                log2_opacity = row[LOG2_OPACITY]
                all_g = all_dx = all_dxdx = all_dy = all_dxdy = all_dydy = spread(ZERO)
                all_red = all_green = all_blue = all_x = all_y = spread(ZERO)
                for part in range(PARTS):
                    first, last = int(reached[2 * part, pair]), int(reached[2 * part + 1, pair])
                    if first >= last:
                        continue
                    dx = ramp() + (offset_x + f32(WIDTH * part))
                    constant, slope = log2_opacity - xx * dx * dx, xy * dx
                    once = twice = thrice = spread(ZERO)
                    while first < last:
                        power, ratio = first_alphas(constant, slope, yy, spread(f32(first) + offset_y))
                        for r in range(first, min(first + group, last)):
                            place = (TILE * part + r) * BACKWARD
                            alpha = select(power >= ALPHA_MIN32, smaller(power, CAP), ZERO)
                            power, ratio = power * ratio, ratio * falloff
                            t, q = load(state, place), load(state, place + WIDTH)
                            h_red = load(state, place + 2 * WIDTH)
                            h_green = load(state, place + 3 * WIDTH)
                            h_blue = load(state, place + 4 * WIDTH)
                            t_next = t - alpha * t
                            takes = t_next > T_MIN
                            w = select(takes, alpha * t, ZERO)
                            store(state, place, select(takes, t_next, ZERO))
                            received = w * (red * h_red + green * h_green + blue * h_blue)
                            q = q - received
                            store(state, place + WIDTH, q)
                            g = alpha / (ONE - alpha) * q - received
                            g = select(takes & (alpha < CAP), g, ZERO)
                            once = once + g
                            twice = twice + once
                            thrice = thrice + twice
                            all_red = all_red + w * h_red
                            all_green = all_green + w * h_green
                            all_blue = all_blue + w * h_blue
                            if absolute:
                                dy = f32(r) + offset_y
                                all_x = all_x + magnitude(g * (TWO * xx * dx + xy * dy))
                                all_y = all_y + magnitude(g * (xy * dx + TWO * yy * dy))
                        first += group
                    # with m = last - r: sum of g, of g m and of g m (m + 1) / 2
                    beyond = f32(last) + offset_y
                    sum_dy = once * beyond - twice
                    sum_dx = once * dx
                    all_g, all_dx, all_dxdx = all_g + once, all_dx + sum_dx, all_dxdx + sum_dx * dx
                    all_dy, all_dxdy = all_dy + sum_dy, all_dxdy + sum_dy * dx
                    all_dydy = all_dydy + (sum_dy * beyond - twice * (beyond + ONE) + TWO * thrice)
                sums = pair_sums[pair]
                sums[G] = total(all_g)
                store_totals(
                    sums, G_DX, all_dx, all_dy, all_dxdx, all_dxdy, all_dydy, all_red, all_green, all_blue
                )
                if absolute:
                    sums[SUMS], sums[SUMS + 1] = total(all_x), total(all_y)
            for pair in range(lit, tile_start[tile + 1]):
                for k in range(pair_sums.shape[1]):
                    pair_sums[pair, k] = ZERO

    return blend_backward


blend_backward, blend_backward_absolute = _make_backward(False), _make_backward(True)
