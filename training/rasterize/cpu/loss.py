"""L1 and structural similarity with their gradient, in two passes over blocks that fit the L1 cache.

Reduction loops must not write arrays. Otherwise the compiler generates two versions of the loop with
different orders of summation, and selects one at run time by the arrays' addresses.
"""

from __future__ import annotations

import numpy as np

from .compile import FAST, Buffers, f32, helper, kernel, run_parallel

ROWS, COLUMNS = 16, 64
"""Size of a block."""
BLOCKS = 32
"""Blocks in a thread's unit of work."""
REACH = 5
HIGH, WIDE = ROWS + 2 * REACH, 80
"""Size of a block padded by the window's reach; the width is a multiple of SIMD vectors."""

_line = np.exp(-((np.arange(6) - 5.0) ** 2) / (2 * 1.5**2))
_line /= 2 * _line[:5].sum() + _line[5]
W0, W1, W2, W3, W4, W5 = (f32(w) for w in _line)

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
C1, C2 = f32(0.01**2), f32(0.03**2)


@helper(FAST)
def read_padded(plane, y0, x0, out):
    """Copy a padded block of a plane (H, W) with its inner part at (y0, x0) to ``out`` (HIGH, WIDE)."""
    height, width = plane.shape
    for r in range(HIGH):
        y = y0 + r - REACH
        for j in range(WIDE):
            out[r, j] = ZERO
        if y >= 0 and y < height:
            begin = REACH - x0 if x0 < REACH else 0
            end = width + REACH - x0 if width + REACH - x0 < WIDE else WIDE
            for j in range(begin, end):
                out[r, j] = plane[y, x0 + j - REACH]


@helper(FAST)
def windowed(block, line, out):
    """Apply the window to a padded block (HIGH, WIDE), along columns, then rows; fill ``out`` (ROWS,
    COLUMNS).

    ``line`` (WIDE,) is scratch memory.
    """
    for r in range(ROWS):
        for j in range(WIDE):
            line[j] = (
                W0 * (block[r, j] + block[r + 10, j])
                + W1 * (block[r + 1, j] + block[r + 9, j])
                + W2 * (block[r + 2, j] + block[r + 8, j])
                + W3 * (block[r + 3, j] + block[r + 7, j])
                + W4 * (block[r + 4, j] + block[r + 6, j])
                + W5 * block[r + 5, j]
            )
        for j in range(COLUMNS):
            out[r, j] = (
                W0 * (line[j] + line[j + 10])
                + W1 * (line[j + 1] + line[j + 9])
                + W2 * (line[j + 2] + line[j + 8])
                + W3 * (line[j + 3] + line[j + 7])
                + W4 * (line[j + 4] + line[j + 6])
                + W5 * line[j + 5]
            )


@helper(FAST)
def locate_block(block, height, width):
    """Return a block's channel, its first row and column, and its numbers of rows and columns in the
    image."""
    across, down = -(-width // COLUMNS), -(-height // ROWS)
    y0, x0 = block // across % down * ROWS, block % across * COLUMNS
    rows = ROWS if height - y0 > ROWS else height - y0
    columns = COLUMNS if width - x0 > COLUMNS else width - x0
    return block // (down * across), y0, x0, rows, columns


@kernel(FAST)
def target_moments(begin, end, truth, mean_and_square):
    """Fill mean_and_square (2, 3, H, W) with the windowed means of y and y² of a photo (3, H, W)."""
    _, height, width = truth.shape
    wide = np.empty((2, HIGH, WIDE), np.float32)
    line = np.empty(WIDE, np.float32)
    moments = np.empty((2, ROWS, COLUMNS), np.float32)
    for block in range(begin, end):
        channel, y0, x0, rows, columns = locate_block(block, height, width)
        read_padded(truth[channel], y0, x0, wide[0])
        for r in range(HIGH):
            for j in range(WIDE):
                wide[1, r, j] = wide[0, r, j] * wide[0, r, j]
        for k in range(2):
            windowed(wide[k], line, moments[k])
            for r in range(rows):
                for j in range(columns):
                    mean_and_square[k, channel, y0 + r, x0 + j] = moments[k, r, j]


@kernel(FAST)
def similarity(begin, end, image, truth, moments_of_y, by_moments, sums):
    """Compute the sum of SSIM per block, and its derivatives by the windowed means of x, x² and xy.

    SSIM = n1 n2 / (d1 d2) with n1 = 2 mx my + C1, n2 = 2 (mxy − mx my) + C2, d1 = mx² + my² + C1 and
    d2 = (mxx − mx²) + (myy − my²) + C2 (Wang et al. 2004, Eq. 13). by_moments is (3 means, 3, H, W).
    """
    _, height, width = image.shape
    wide = np.empty((3, HIGH, WIDE), np.float32)  # x, x², xy
    line = np.empty(WIDE, np.float32)
    moments = np.empty((3, ROWS, COLUMNS), np.float32)
    target_means = np.empty((2, COLUMNS), np.float32)
    for j in range(COLUMNS):  # columns outside the image stay zero
        target_means[0, j], target_means[1, j] = ZERO, ZERO
    for block in range(begin, end):
        channel, y0, x0, rows, columns = locate_block(block, height, width)
        read_padded(image[channel], y0, x0, wide[0])
        read_padded(truth[channel], y0, x0, wide[2])
        for r in range(HIGH):
            for j in range(WIDE):
                x = wide[0, r, j]
                wide[1, r, j] = x * x
                wide[2, r, j] *= x
        for k in range(3):
            windowed(wide[k], line, moments[k])
        total = ZERO
        for r in range(rows):
            for j in range(columns):
                target_means[0, j] = moments_of_y[0, channel, y0 + r, x0 + j]
                target_means[1, j] = moments_of_y[1, channel, y0 + r, x0 + j]
            for j in range(COLUMNS):
                mx, my = moments[0, r, j], target_means[0, j]
                n1, n2 = TWO * mx * my + C1, TWO * (moments[2, r, j] - mx * my) + C2
                d1 = mx * mx + my * my + C1
                d2 = moments[1, r, j] - mx * mx + target_means[1, j] - my * my + C2
                per_d1, per_d2 = ONE / d1, ONE / d2
                per = per_d1 * per_d2
                value = n1 * n2 * per
                by_xx = -value * per_d2
                by_xy = TWO * n1 * per
                moments[0, r, j] = (
                    TWO * my * n2 * per - TWO * mx * value * per_d1 - TWO * mx * by_xx - my * by_xy
                )
                moments[1, r, j], moments[2, r, j] = by_xx, by_xy
                target_means[0, j] = value
            for j in range(columns):
                total += target_means[0, j]
            for j in range(columns):
                for k in range(3):
                    by_moments[k, channel, y0 + r, x0 + j] = moments[k, r, j]
        sums[block] = total


@kernel(FAST)
def loss_gradient(begin, end, image, truth, by_moments, l1_weight, ssim_weight, gradient, sums):
    """Compute d loss / d image (3, H, W), and the sum of |x − y| per block.

    The window is symmetric, so the derivatives by the means propagate to a pixel as their windowed mean. The
    derivatives of x, x² and xy by x are 1, 2x and y.
    """
    _, height, width = image.shape
    wide = np.empty((HIGH, WIDE), np.float32)
    line = np.empty(WIDE, np.float32)
    back = np.empty((3, ROWS, COLUMNS), np.float32)
    for block in range(begin, end):
        channel, y0, x0, rows, columns = locate_block(block, height, width)
        for k in range(3):
            read_padded(by_moments[k, channel], y0, x0, wide)
            windowed(wide, line, back[k])
        total = ZERO
        for r in range(rows):
            for j in range(columns):
                total += abs(image[channel, y0 + r, x0 + j] - truth[channel, y0 + r, x0 + j])
            for j in range(columns):
                x, y = image[channel, y0 + r, x0 + j], truth[channel, y0 + r, x0 + j]
                sign = ONE if x > y else (-ONE if x < y else ZERO)
                through_ssim = back[0, r, j] + TWO * x * back[1, r, j] + y * back[2, r, j]
                gradient[channel, y0 + r, x0 + j] = l1_weight * sign - ssim_weight * through_ssim
        sums[block] = total


def block_count(channels: int, height: int, width: int) -> int:
    """Count the blocks of ROWS x COLUMNS pixels that cover all channels of an image."""
    return channels * -(-height // ROWS) * -(-width // COLUMNS)


def moments_of(truth: np.ndarray) -> np.ndarray:
    """Compute the moments (2, 3, H, W) of a photo (3, H, W) for :func:`loss_and_gradient`."""
    moments = np.empty((2, *truth.shape), np.float32)
    run_parallel(target_moments, block_count(*truth.shape), BLOCKS, truth, moments)
    return moments


def loss_and_gradient(
    image: np.ndarray, truth: np.ndarray, moments: np.ndarray, ssim_weight: float
) -> tuple[float, np.ndarray]:
    """Compute (1 − ssim_weight) L1 + ssim_weight (1 − SSIM) of planes (3, H, W), and its gradient by
    image."""
    blocks = block_count(*image.shape)
    similar, different = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    buffers = Buffers()
    by_moments = buffers.take("by_moments", np.float32, 3, *image.shape)
    gradient = np.empty_like(image)
    run_parallel(similarity, blocks, BLOCKS, image, truth, moments, by_moments, similar)
    weights = f32((1 - ssim_weight) / image.size), f32(ssim_weight / image.size)
    run_parallel(loss_gradient, blocks, BLOCKS, image, truth, by_moments, *weights, gradient, different)
    l1 = different.sum(dtype=np.float64) / image.size
    ssim = similar.sum(dtype=np.float64) / image.size
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), gradient
