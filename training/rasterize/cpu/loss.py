"""L1 and structural similarity with their gradient, in one pass down strips that fit the L1 cache.

The window is applied along each row of products, then down the rows in a ring, which gives local moments. The
derivatives by these moments pass through the same two windows, ten rows behind, which gives the gradient. Two
rows are processed at a time, because their windows share ten rows.

Loads limit the speed. :func:`down` therefore orders its terms such that every row is loaded once and no more
than two wait in registers.
"""

from __future__ import annotations

import numpy as np

from .compile import FAST, f32, inlined, kernel, run_parallel
from .lanes import WIDTH, load, magnitude, select, spread, store

ORDERED = FAST - {"reassoc"}
"""Flags for explicit vectors: the compiler must not change the order of terms."""
ROWS, COLUMNS = 128, 54
"""Size of a block."""
REACH = 5
WIDE = COLUMNS + 2 * REACH
"""Columns of a block padded by the reach of one window; a multiple of SIMD vectors."""
LINE = WIDE + 16
"""Columns padded by the reach of both windows, as a multiple of SIMD vectors."""
SLOTS = 12
"""Rows in a ring: those of the windows of two rows. Row y is in slot y % 12."""
PRODUCTS, DERIVATIVES = 4, 3
"""Parts of a row: x, y, x² + y² and xy, or derivatives by the means of x, x² + y² and xy."""

_line = np.exp(-((np.arange(6) - 5.0) ** 2) / (2 * 1.5**2))
_line /= 2 * _line[:5].sum() + _line[5]
W0, W1, W2, W3, W4, W5 = (f32(w) for w in _line)

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
C1, C2 = f32(0.01**2), f32(0.03**2)


@inlined(ORDERED)
def along(lines, first, parts, size, ring, place):
    """Apply the window along the parts of a row, from ``first`` on; store the result from ``place`` on."""
    for part in range(parts):
        for j in range(0, size, WIDTH):
            i = first + part * LINE + j
            value = W5 * load(lines, i + 5)
            value = value + W0 * (load(lines, i) + load(lines, i + 10))
            value = value + W1 * (load(lines, i + 1) + load(lines, i + 9))
            value = value + W2 * (load(lines, i + 2) + load(lines, i + 8))
            value = value + W3 * (load(lines, i + 3) + load(lines, i + 7))
            value = value + W4 * (load(lines, i + 4) + load(lines, i + 6))
            store(ring, place + part * WIDE + j, value)


@inlined(ORDERED)
def down(ring, slots, j):
    """Apply the window at column ``j`` down the first 11 rows at ``slots`` (12,), and down the last 11."""
    r0, r10, r1, r11 = (
        load(ring, slots[0] + j),
        load(ring, slots[10] + j),
        load(ring, slots[1] + j),
        load(ring, slots[11] + j),
    )
    a, b = W0 * (r0 + r10), W0 * (r1 + r11)
    r2, r9 = load(ring, slots[2] + j), load(ring, slots[9] + j)
    a, b = a + W1 * (r1 + r9), b + W1 * (r2 + r10)
    r3, r8 = load(ring, slots[3] + j), load(ring, slots[8] + j)
    a, b = a + W2 * (r2 + r8), b + W2 * (r3 + r9)
    r4, r7 = load(ring, slots[4] + j), load(ring, slots[7] + j)
    a, b = a + W3 * (r3 + r7), b + W3 * (r4 + r8)
    r5, r6 = load(ring, slots[5] + j), load(ring, slots[6] + j)
    a, b = a + W4 * (r4 + r6), b + W4 * (r5 + r7)
    return a + W5 * r5, b + W5 * r6


@inlined(ORDERED)
def differentiate(mx, my, squares, xy, lines, place):
    """Store the derivatives of SSIM by the means in the parts of a line; return SSIM.

    SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy − mx my) + C2, d1 = mx² + my² + C1 and
    d2 = (mxx − mx²) + (myy − my²) + C2 (Wang et al. 2004, Eq. 13).
    """
    product, square = mx * my, mx * mx + my * my
    n1, n2 = TWO * product + C1, TWO * (xy - product) + C2
    d1, d2 = square + C1, squares - square + C2
    per = ONE / (d1 * d2)
    n1_per = n1 * per
    value = n1_per * n2
    by_squares, by_xy = ZERO - value * (d1 * per), TWO * n1_per
    store(lines, place, TWO * (my * (n2 * per) - mx * (value * (d2 * per) + by_squares)) - my * by_xy)
    store(lines, place + LINE, by_squares)
    store(lines, place + 2 * LINE, by_xy)
    return value


@inlined(ORDERED)
def by_pixel(x, y, by_x, by_squares, by_xy, weights):
    """Compute d loss / d x of pixels."""
    through_ssim = by_x + TWO * x * by_squares + y * by_xy
    sign = select(x > y, weights[0], select(x < y, ZERO - weights[0], spread(ZERO)))
    return sign - weights[1] * through_ssim


@inlined(FAST)
def copy(values, target, place):
    """Copy values to the target, from ``place`` on."""
    place = min(max(place, 0), PRODUCTS * LINE)
    for j in range(min(len(values), LINE)):
        target[place + j] = values[j]


@inlined(ORDERED)
def filter_products(image, truth, row, left, lines, ring, place):
    """Store the windowed products of a row of pixels from column ``left`` on in a slot of the ring."""
    first, last = max(left, 0), min(left + WIDE + 2 * REACH, image.shape[1])
    copy(image[row, first:last], lines, first - left)
    copy(truth[row, first:last], lines, LINE + first - left)
    for j in range(0, LINE, WIDTH):
        x, y = load(lines, j), load(lines, LINE + j)
        store(lines, 2 * LINE + j, x * x + y * y)
        store(lines, 3 * LINE + j, x * y)
    along(lines, 0, PRODUCTS, WIDE, ring, place)


@inlined(ORDERED)
def filter_derivatives(first, end, lines, row, ring, place):
    """Store the windowed derivatives of a row in a slot of the ring, zero outside columns first to end."""
    for part in range(DERIVATIVES):
        # limits let LLVM prove that no index is negative: otherwise it scatters single values
        begin = min(max((row * DERIVATIVES + part) * LINE, 0), 2 * DERIVATIVES * LINE)
        for j in range(min(first, WIDE)):
            lines[begin + j] = ZERO
        for j in range(min(max(end, 0), WIDE), WIDE):
            lines[begin + j] = ZERO
    along(lines, row * DERIVATIVES * LINE, DERIVATIVES, COLUMNS, ring, place)


@inlined(ORDERED)
def compare_rows(ring, slots, inside, lines, similar):
    """Store the derivatives of two rows in lines (2 · DERIVATIVES · LINE,) and add their SSIM to ``similar``.

    ``inside`` has 1 for each of the rows whose SSIM counts, otherwise 0.
    """
    for j in range(0, WIDE, WIDTH):
        mx, my = down(ring, slots, j), down(ring, slots, WIDE + j)
        squares, xy = down(ring, slots, 2 * WIDE + j), down(ring, slots, 3 * WIDE + j)
        first = differentiate(mx[0], my[0], squares[0], xy[0], lines, j)
        second = differentiate(mx[1], my[1], squares[1], xy[1], lines, DERIVATIVES * LINE + j)
        store(similar, j, load(similar, j) + (inside[0] * first + inside[1] * second))


@inlined(ORDERED)
def finish_rows(image, truth, row, rows, left, right, ring, slots, weights, gradient, pixels, different):
    """Store the gradient of one or two rows, and add |x − y| to ``different``.

    The window is symmetric, so the derivatives by the means propagate to a pixel as their windowed mean. The
    derivatives of x, x² + y² and xy by x are 1, 2x and y.

    Args:
        pixels: (4 · WIDE,) scratch memory, zero in columns beyond ``right``.
    """
    for j in range(2 * WIDE, 4 * WIDE):
        pixels[j] = ZERO
    for k in range(rows):
        copy(image[row + k, left:right], pixels, 2 * k * WIDE)
        copy(truth[row + k, left:right], pixels, (2 * k + 1) * WIDE)
    for j in range(0, COLUMNS, WIDTH):
        by_x, by_squares, by_xy = (
            down(ring, slots, j),
            down(ring, slots, WIDE + j),
            down(ring, slots, 2 * WIDE + j),
        )
        x, y = load(pixels, j), load(pixels, WIDE + j)
        store(pixels, j, by_pixel(x, y, by_x[0], by_squares[0], by_xy[0], weights))
        x1, y1 = load(pixels, 2 * WIDE + j), load(pixels, 3 * WIDE + j)
        store(pixels, 2 * WIDE + j, by_pixel(x1, y1, by_x[1], by_squares[1], by_xy[1], weights))
        store(different, j, load(different, j) + (magnitude(x - y) + magnitude(x1 - y1)))
    for k in range(rows):
        line = gradient[row + k, left:right]
        for j in range(min(len(line), COLUMNS)):
            line[j] = pixels[2 * k * WIDE + j]


@inlined(FAST)
def sum_columns(values, first, last):
    """Add the values of some columns."""
    result = ZERO
    for j in range(WIDE):
        if first <= j < last:
            result += values[j]
    return result


@kernel(ORDERED)
def compare(begin, end, image, truth, l1_weight, ssim_weight, gradient, sums):
    """Fill gradient (3, H, W), and sums (blocks, 2) with each block's sums of SSIM and |x − y|."""
    _, height, width = image.shape
    across, layers = -(-width // COLUMNS), -(-height // ROWS)
    products = np.empty(SLOTS * PRODUCTS * WIDE, np.float32)
    derivatives = np.empty(SLOTS * DERIVATIVES * WIDE, np.float32)
    lines, back_lines = np.empty(PRODUCTS * LINE, np.float32), np.zeros(2 * DERIVATIVES * LINE, np.float32)
    pixels = np.empty(4 * WIDE, np.float32)
    similar, different = np.empty(WIDE, np.float32), np.empty(WIDE, np.float32)
    slots, back_slots = np.empty(SLOTS, np.intp), np.empty(SLOTS, np.intp)
    weights = l1_weight, ssim_weight
    for block in range(begin, end):
        channel, top, left = (
            block // (layers * across),
            block // across % layers * ROWS,
            block % across * COLUMNS,
        )
        planes = image[channel], truth[channel]
        bottom, right = min(top + ROWS, height), min(left + COLUMNS, width)
        lines[:], pixels[:], similar[:], different[:] = ZERO, ZERO, ZERO, ZERO
        for y in range(top - 2 * REACH, bottom + 2 * REACH, 2):
            for k in range(SLOTS):
                slot = (y + k + 2 + SLOTS) % SLOTS
                slots[k], back_slots[k] = slot * PRODUCTS * WIDE, slot * DERIVATIVES * WIDE
            for k in range(2):
                place = slots[10 + k]
                if y + k >= 0 and y + k < height:
                    filter_products(*planes, y + k, left - 2 * REACH, lines, products, place)
                else:
                    products[place : place + PRODUCTS * WIDE] = ZERO
            if y < top:
                continue
            row = y - REACH
            inside = f32(row >= top and row < bottom), f32(row + 1 >= top and row + 1 < bottom)
            compare_rows(products, slots, inside, back_lines, similar)
            for k in range(2):
                place = back_slots[10 + k]
                if row + k >= 0 and row + k < height:
                    span = max(REACH - left, 0), min(width - left + REACH, WIDE)
                    filter_derivatives(*span, back_lines, k, derivatives, place)
                else:
                    derivatives[place : place + DERIVATIVES * WIDE] = ZERO
            row = y - 2 * REACH
            if row >= top:
                rows = min(bottom - row, 2)
                finish_rows(
                    *planes, row, rows, left, right, derivatives, back_slots, weights, gradient[channel],
                    pixels, different,
                )  # fmt: skip
        sums[block, 0] = sum_columns(similar, REACH, REACH + right - left)
        sums[block, 1] = sum_columns(different, 0, right - left)


def loss_and_gradient(image: np.ndarray, truth: np.ndarray, ssim_weight: float) -> tuple[float, np.ndarray]:
    """Compute (1 − ssim_weight) L1 + ssim_weight (1 − SSIM) of planes (3, H, W), and its gradient by
    image."""
    channels, height, width = image.shape
    blocks = channels * -(-height // ROWS) * -(-width // COLUMNS)
    sums = np.empty((blocks, 2), np.float32)
    gradient = np.empty_like(image)
    weights = f32((1 - ssim_weight) / image.size), f32(ssim_weight / image.size)
    run_parallel(compare, blocks, 1, image, truth, *weights, gradient, sums)
    ssim, l1 = sums.sum(0, dtype=np.float64) / image.size
    return float((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)), gradient
