"""L1 and structural similarity with their gradient, in two passes over blocks that fit the L1 cache."""

from __future__ import annotations

import numpy as np

from .compile import FAST, f32, in_parallel, inlined, kernel, scratch

ROWS, COLUMNS = 16, 64
"""Size of a block."""
BLOCKS = 32
"""How many blocks a thread takes at a time."""
REACH = 5
HIGH, WIDE = ROWS + 2 * REACH, 80
"""Size of a block with the window's reach around it, zeros outside the image; as wide as SIMD likes it."""

_line = np.exp(-((np.arange(6) - 5.0) ** 2) / (2 * 1.5**2))
_line /= 2 * _line[:5].sum() + _line[5]
W0, W1, W2, W3, W4, W5 = (f32(w) for w in _line)

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
C1, C2 = f32(0.01**2), f32(0.03**2)


@inlined(FAST)
def read_padded(plane, y0, x0, out):
    """Copy the padded block of a plane (H, W) whose inner part begins at (y0, x0) to ``out`` (HIGH, WIDE)."""
    height, width = plane.shape
    begin, end = max(0, REACH - x0), min(WIDE, width + REACH - x0)
    for r in range(HIGH):
        y = y0 + r - REACH
        inside = y >= 0 and y < height
        for j in range(WIDE):
            out[r, j] = ZERO
        if inside:
            for j in range(begin, end):
                out[r, j] = plane[y, x0 + j - REACH]


@inlined(FAST)
def window_down(source, out):
    """The window's line along columns: (HIGH, WIDE) to (ROWS, WIDE)."""
    for r in range(ROWS):
        for j in range(WIDE):
            out[r, j] = (
                W0 * (source[r, j] + source[r + 10, j])
                + W1 * (source[r + 1, j] + source[r + 9, j])
                + W2 * (source[r + 2, j] + source[r + 8, j])
                + W3 * (source[r + 3, j] + source[r + 7, j])
                + W4 * (source[r + 4, j] + source[r + 6, j])
                + W5 * source[r + 5, j]
            )


@inlined(FAST)
def window_along(line, out):
    """The window's line along one row: (WIDE,) to (COLUMNS,)."""
    for j in range(COLUMNS):
        out[j] = (
            W0 * (line[j] + line[j + 10])
            + W1 * (line[j + 1] + line[j + 9])
            + W2 * (line[j + 2] + line[j + 8])
            + W3 * (line[j + 3] + line[j + 7])
            + W4 * (line[j + 4] + line[j + 6])
            + W5 * line[j + 5]
        )


@kernel(FAST)
def target_moments(begin, end, truth, mean, mean_square):
    """Windowed mean of y and of y² of a photograph; all (3, H, W)."""
    _, height, width = truth.shape
    across, down = -(-width // COLUMNS), -(-height // ROWS)
    for block in range(begin, end):
        channel, y0, x0 = block // (down * across), block // across % down * ROWS, block % across * COLUMNS
        wide = np.empty((HIGH, WIDE), np.float32)
        lines = np.empty((ROWS, WIDE), np.float32)
        result = np.empty(COLUMNS, np.float32)
        read_padded(truth[channel], y0, x0, wide)
        for moment in (mean, mean_square):
            window_down(wide, lines)
            for r in range(min(ROWS, height - y0)):
                window_along(lines[r], result)
                for j in range(min(COLUMNS, width - x0)):
                    moment[channel, y0 + r, x0 + j] = result[j]
            for r in range(HIGH):
                for j in range(WIDE):
                    wide[r, j] *= wide[r, j]


@kernel(FAST)
def similarity(begin, end, image, truth, mean_y, mean_yy, by_moments, sums):
    """Sum of SSIM per block, and its derivatives by the windowed means of x, x² and xy, (3 of them, 3, H, W).

    SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy − mx my) + C2, d1 = mx² + my² + C1 and
    d2 = (mxx − mx²) + (myy − my²) + C2 (Wang et al. 2004, Eq. 13).
    """
    _, height, width = image.shape
    across, down = -(-width // COLUMNS), -(-height // ROWS)
    for block in range(begin, end):
        channel, y0, x0 = block // (down * across), block // across % down * ROWS, block % across * COLUMNS
        wide = np.empty((3, HIGH, WIDE), np.float32)  # x, x², xy
        lines = np.empty((3, ROWS, WIDE), np.float32)
        moments = np.zeros((5, COLUMNS), np.float32)
        read_padded(image[channel], y0, x0, wide[0])
        read_padded(truth[channel], y0, x0, wide[2])
        for r in range(HIGH):
            for j in range(WIDE):
                x = wide[0, r, j]
                wide[1, r, j] = x * x
                wide[2, r, j] *= x
        for k in range(3):
            window_down(wide[k], lines[k])
        total = ZERO
        columns = min(COLUMNS, width - x0)
        for r in range(min(ROWS, height - y0)):
            for k in range(3):
                window_along(lines[k, r], moments[k])
            for j in range(columns):
                moments[3, j] = mean_y[channel, y0 + r, x0 + j]
                moments[4, j] = mean_yy[channel, y0 + r, x0 + j]
            for j in range(COLUMNS):
                mx, my = moments[0, j], moments[3, j]
                n1, n2 = TWO * mx * my + C1, TWO * (moments[2, j] - mx * my) + C2
                d1 = mx * mx + my * my + C1
                d2 = moments[1, j] - mx * mx + moments[4, j] - my * my + C2
                per_d1, per_d2 = ONE / d1, ONE / d2
                per = per_d1 * per_d2
                value = n1 * n2 * per
                by_xx = -value * per_d2
                by_xy = TWO * n1 * per
                moments[0, j] = (
                    TWO * my * n2 * per - TWO * mx * value * per_d1 - TWO * mx * by_xx - my * by_xy
                )
                moments[1, j], moments[2, j] = by_xx, by_xy
                moments[3, j] = value
            for j in range(columns):
                total += moments[3, j]
                for k in range(3):
                    by_moments[k, channel, y0 + r, x0 + j] = moments[k, j]
        sums[block] = total


@kernel(FAST)
def loss_gradient(begin, end, image, truth, by_moments, l1_weight, ssim_weight, gradient, sums):
    """d loss / d image (3, H, W), and the sum of |x − y| per block.

    The window is symmetric, so what the means' derivatives give back to a pixel is their own windowed mean; x
    reaches the means of x, x² and xy with 1, 2x and y.
    """
    _, height, width = image.shape
    across, down = -(-width // COLUMNS), -(-height // ROWS)
    for block in range(begin, end):
        channel, y0, x0 = block // (down * across), block // across % down * ROWS, block % across * COLUMNS
        wide = np.empty((3, HIGH, WIDE), np.float32)
        lines = np.empty((3, ROWS, WIDE), np.float32)
        back = np.empty((3, COLUMNS), np.float32)
        for k in range(3):
            read_padded(by_moments[k, channel], y0, x0, wide[k])
            window_down(wide[k], lines[k])
        total = ZERO
        for r in range(min(ROWS, height - y0)):
            for k in range(3):
                window_along(lines[k, r], back[k])
            for j in range(min(COLUMNS, width - x0)):
                x, y = image[channel, y0 + r, x0 + j], truth[channel, y0 + r, x0 + j]
                total += abs(x - y)
                sign = ONE if x > y else (-ONE if x < y else ZERO)
                through_ssim = back[0, j] + TWO * x * back[1, j] + y * back[2, j]
                gradient[channel, y0 + r, x0 + j] = l1_weight * sign - ssim_weight * through_ssim
        sums[block] = total


def block_count(channels: int, height: int, width: int) -> int:
    return channels * -(-height // ROWS) * -(-width // COLUMNS)


def moments_of(truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What :func:`loss_and_gradient` wants to know about a photograph (3, H, W)."""
    mean, mean_square = np.empty_like(truth), np.empty_like(truth)
    in_parallel(target_moments, block_count(*truth.shape), BLOCKS, truth, mean, mean_square)
    return mean, mean_square


def loss_and_gradient(
    image: np.ndarray, truth: np.ndarray, moments: tuple[np.ndarray, np.ndarray], ssim_weight: float
) -> tuple[float, np.ndarray]:
    """(1 − ssim_weight) L1 + ssim_weight (1 − SSIM) of planes (3, H, W), and its gradient by the image."""
    blocks = block_count(*image.shape)
    similar, different = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    by_moments = scratch("by_moments", 3, *image.shape)
    gradient = np.empty_like(image)
    in_parallel(similarity, blocks, BLOCKS, image, truth, *moments, by_moments, similar)
    weights = f32((1 - ssim_weight) / image.size), f32(ssim_weight / image.size)
    in_parallel(loss_gradient, blocks, BLOCKS, image, truth, by_moments, *weights, gradient, different)
    l1 = different.sum(dtype=np.float64) / image.size
    ssim = similar.sum(dtype=np.float64) / image.size
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), gradient
