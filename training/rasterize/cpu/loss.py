"""L1 and structural similarity with their gradient, in one pass down strips that fit the L1 cache.

The products of a strip's last rows are in a ring, and the window reduces them to local moments. The
derivatives by these moments enter a second ring, five rows behind, and the window reduces them to the
gradient.

The bounds of inner loops and indices are constant or clamped, so that the compiler knows that no index is
negative. Otherwise it would gather and scatter single values. Reduction loops must not write arrays.
Otherwise the compiler generates two versions of the loop with different orders of summation, and selects one
at run time by the arrays' addresses.
"""

from __future__ import annotations

import numpy as np

from .compile import FAST, f32, inlined, kernel, run_parallel

ROWS, COLUMNS = 80, 108
"""Size of a block."""
REACH = 5
WIDE = COLUMNS + 4 * REACH
"""Columns of a block padded by the reach of both windows; a multiple of SIMD vectors."""
X, SQUARES, XY, Y = 0, WIDE, 2 * WIDE, 3 * WIDE
"""Parts of a line: x, x² + y², xy and y, their windowed means, or derivatives by the first three."""
PARTS = 4
SLOTS = 16
"""Rows in a ring. Row y is in slot y & 15."""

_line = np.exp(-((np.arange(6) - 5.0) ** 2) / (2 * 1.5**2))
_line /= 2 * _line[:5].sum() + _line[5]
W0, W1, W2, W3, W4, W5 = (f32(w) for w in _line)

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
C1, C2 = f32(0.01**2), f32(0.03**2)


@inlined(FAST)
def clear(row):
    """Set a row of a ring (PARTS · WIDE,) to zero."""
    for j in range(PARTS * WIDE):
        row[j] = ZERO


@inlined(FAST)
def windowed(ring, row, size, line, means):
    """Apply the window along columns, to a row and its neighbours, then along the row.

    Args:
        line: scratch memory, with ten zeros at its end.
        means: the values around ring[row, 5], ring[row, 6], …
    """
    size = min(size, PARTS * WIDE)
    r0, r1, r2, r3, r4, r5 = row - 5 & 15, row - 4 & 15, row - 3 & 15, row - 2 & 15, row - 1 & 15, row & 15
    r6, r7, r8, r9, r10 = row + 1 & 15, row + 2 & 15, row + 3 & 15, row + 4 & 15, row + 5 & 15
    for j in range(size):
        line[j] = (
            W0 * (ring[r0, j] + ring[r10, j])
            + W1 * (ring[r1, j] + ring[r9, j])
            + W2 * (ring[r2, j] + ring[r8, j])
            + W3 * (ring[r3, j] + ring[r7, j])
            + W4 * (ring[r4, j] + ring[r6, j])
            + W5 * ring[r5, j]
        )
    for j in range(size):
        means[j] = (
            W0 * (line[j] + line[j + 10])
            + W1 * (line[j + 1] + line[j + 9])
            + W2 * (line[j + 2] + line[j + 8])
            + W3 * (line[j + 3] + line[j + 7])
            + W4 * (line[j + 4] + line[j + 6])
            + W5 * line[j + 5]
        )


@inlined(FAST)
def multiply(xs, ys, place, row):
    """Store the products of pixels in the parts of a line, from ``place`` on."""
    place = min(max(place, 0), 2 * REACH)
    for j in range(min(len(xs), WIDE)):
        x, y, k = xs[j], ys[j], place + j
        row[X + k], row[SQUARES + k], row[XY + k], row[Y + k] = x, x * x + y * y, x * y, y


@inlined(FAST)
def similarity(means, first, last, values, row):
    """Compute SSIM and its derivatives by the means, from the column ``first`` to before ``last``.

    SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy − mx my) + C2, d1 = mx² + my² + C1 and
    d2 = (mxx − mx²) + (myy − my²) + C2 (Wang et al. 2004, Eq. 13).
    """
    for j in range(max(first, 0), min(last, WIDE)):
        mx, my = means[X + j], means[Y + j]
        product, squares = mx * my, mx * mx + my * my
        n1, n2 = TWO * product + C1, TWO * (means[XY + j] - product) + C2
        d1, d2 = squares + C1, means[SQUARES + j] - squares + C2
        per = ONE / (d1 * d2)
        value = n1 * n2 * per
        by_squares, by_xy = -value * d1 * per, TWO * n1 * per
        values[j] = value
        row[X + j] = TWO * (my * n2 * per - mx * (value * d2 * per + by_squares)) - my * by_xy
        row[SQUARES + j] = by_squares
        row[XY + j] = by_xy


@inlined(FAST)
def finish(back, xs, ys, l1_weight, ssim_weight, gradient):
    """Compute d loss / d x of pixels, and return their sum of |x − y|.

    The window is symmetric, so the derivatives by the means propagate to a pixel as their windowed mean. The
    derivatives of x, x² + y² and xy by x are 1, 2x and y.
    """
    for j in range(min(len(gradient), WIDE)):
        x, y = xs[j], ys[j]
        sign = ONE if x > y else (-ONE if x < y else ZERO)
        through_ssim = back[X + j] + TWO * x * back[SQUARES + j] + y * back[XY + j]
        gradient[j] = l1_weight * sign - ssim_weight * through_ssim
    total = ZERO
    for j in range(len(xs)):
        total += abs(xs[j] - ys[j])
    return total


@kernel(FAST)
def compare(begin, end, image, truth, l1_weight, ssim_weight, gradient, sums):
    """Fill gradient (3, H, W), and sums (blocks, 2) with each block's sums of SSIM and |x − y|."""
    _, height, width = image.shape
    across, down = -(-width // COLUMNS), -(-height // ROWS)
    rings = np.empty((2, SLOTS, PARTS * WIDE), np.float32)  # of products, and of derivatives
    line, means = np.zeros(PARTS * WIDE + 2 * REACH, np.float32), np.empty(PARTS * WIDE, np.float32)
    values = np.empty(WIDE, np.float32)
    for block in range(begin, end):
        channel, top, left = block // (down * across), block // across % down * ROWS, block % across * COLUMNS
        bottom, right = min(top + ROWS, height), min(left + COLUMNS, width)
        first, last = max(left - 2 * REACH, 0), min(right + 2 * REACH, width)
        similar, different = ZERO, ZERO
        for slot in range(SLOTS):
            clear(rings[0, slot])
            clear(rings[1, slot])
        for y in range(top - 2 * REACH, bottom + 2 * REACH):
            if y >= 0 and y < height:
                pixels = image[channel, y, first:last], truth[channel, y, first:last]
                multiply(*pixels, first - left + 2 * REACH, rings[0, y & 15])
            else:
                clear(rings[0, y & 15])
            for stage in range(2):
                row = y - REACH - REACH * stage
                if row < top + REACH * (stage - 1):
                    continue
                if row < 0 or row >= height:
                    clear(rings[1, row & 15])
                    continue
                windowed(rings[stage], row, (PARTS - stage) * WIDE, line, means)
                if stage == 0:
                    similarity(means, REACH - left, width - left + REACH, values, rings[1, row & 15])
                    if row >= top and row < bottom:
                        for j in range(min(right - left, COLUMNS)):
                            similar += values[REACH + j]
                else:
                    pixels = image[channel, row, left:right], truth[channel, row, left:right]
                    out = gradient[channel, row, left:right]
                    different += finish(means, *pixels, l1_weight, ssim_weight, out)
        sums[block, 0], sums[block, 1] = similar, different


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
