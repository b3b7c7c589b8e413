"""Project splats to ellipses on the image, and propagate the ellipses' gradients to the splats' parameters.

Notation: p = R m + t the mean in camera coordinates, M = R Q diag(s) with covariance M Mᵀ, J the Jacobian of
(fx x/z, fy y/z) at p (clamped to a frustum a little wider than the image), cov = J M Mᵀ Jᵀ + dilation (EWA
splatting, Zwicker et al. 2001, as in 3DGS Eq. 5), conic = cov⁻¹.
"""

from __future__ import annotations

import math

import numpy as np

from ...editing.bake_filter import MIP_VARIANCE
from ...splats import sh as harmonics
from ..rendering import ALPHA_MIN, DILATION, KernelCamera
from .compile import FAST, f32, inlined, kernel
from .fastmath import prefetch
from .lanes import larger, root, select, smaller

# Columns of a projected splat, the input of blending.
MEAN_X, MEAN_Y = 0, 1
"""Mean in pixels."""
CONIC_XX, CONIC_XY, CONIC_YY, LOG2_OPACITY = 2, 3, 4, 5
"""log2 alpha = LOG2_OPACITY − (CONIC_XX dx² + CONIC_XY dx dy + CONIC_YY dy²)."""
RED, GREEN, BLUE = 6, 7, 8
HALF_WIDTH, HALF_HEIGHT = 9, 10
"""Half the size of the bounding box of the ellipse alpha = ALPHA_MIN, in pixels."""
SLOPE, RISE, X_OF_TOP = 11, 12, 13
"""At offset dx this ellipse spans dy = SLOPE dx ± RISE sqrt(1 − (dx / HALF_WIDTH)²). Its maximum, dy =
HALF_HEIGHT, is at dx = X_OF_TOP."""
DEPTH = 14
"""Along the camera's z axis."""
FALLOFF = 15
"""2^(−2 CONIC_YY); see ``blend.first_alphas``."""
COLUMNS = 16
"""A row is one cache line of 64 bytes."""

# Columns of the sums of blending's backward pass, with sigma = -ln(alpha / opacity) and (dx, dy) = pixel −
# mean: g = d loss / d sigma, its moments, and d loss / d colour.
G, G_DX, G_DY, G_DXDX, G_DXDY, G_DYDY, G_RED, G_GREEN, G_BLUE = range(9)
SUMS = 9

GRAIN = 1024
"""Splats in a thread's unit of work."""
PREFETCH = 8
"""Prefetch distance in splats, for data that is scattered in memory: selected splats and sums of pairs."""
ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
MARGIN = f32(1 / 64)
"""Pixels by which the ellipse's rows and columns are extended against rounding."""
ALPHA_MIN32, DILATION32, MIP_VARIANCE32 = f32(ALPHA_MIN), f32(DILATION), f32(MIP_VARIANCE)
LOG2_E, LN2 = f32(math.log2(math.e)), f32(math.log(2))

sh_basis = inlined(FAST)(harmonics.basis)
sh_basis_gradient = inlined(FAST)(harmonics.basis_gradient)


def kernel_arguments(view: KernelCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert a view to float32 kernel arguments: pose (3, 4), lens (9,) and camera position (3,)."""
    pose = np.column_stack([view.rotation, view.translation]).astype(np.float32)
    lens = [view.fx, view.fy, view.cx, view.cy, *view.x_limits, *view.y_limits, view.near]
    return np.ascontiguousarray(pose), np.array(lens, np.float32), view.position.astype(np.float32)


@inlined(FAST)
def to_camera(pose, axis, mean):
    """Return a point's coordinate along one axis of a camera."""
    return pose[axis, 0] * mean[0] + pose[axis, 1] * mean[1] + pose[axis, 2] * mean[2] + pose[axis, 3]


@inlined(FAST)
def clamp(value, low, high):
    """Clamp a value to a range."""
    return min(max(value, low), high)


@inlined(FAST)
def strip_bounds(mean_x, mean_y, half_width, slope, rise, x_of_top, left, across, top, rows):
    """Return the ends of the rows that an ellipse reaches in a strip; see :func:`strip_rows`.

    Takes the columns of a projected splat as numbers, or those of several splats as lanes. The ellipse is
    convex, so its maximum dy in the strip is at the dx closest to X_OF_TOP, and its minimum at the dx closest
    to −X_OF_TOP.
    """
    half_width = half_width + MARGIN
    near = left - mean_x
    far = near + across
    per_width = ONE / half_width
    highest = smaller(larger(x_of_top, near), far)
    lowest = smaller(larger(ZERO - x_of_top, near), far)
    high, low = highest * per_width, lowest * per_width
    dy_high = slope * highest + rise * root(larger(ONE - high * high, ZERO))
    dy_low = slope * lowest - rise * root(larger(ONE - low * low, ZERO))
    middle = mean_y - top + ONE
    # clamp before conversion to int: mean and size may be millions of pixels
    first = smaller(larger(middle + dy_low - MARGIN, ZERO), f32(rows))
    last = smaller(larger(middle + dy_high + MARGIN, ZERO), f32(rows))
    outside = (near > half_width) | (far + half_width < ZERO)
    return select(outside, ZERO, first), select(outside, ZERO, last)


@inlined(FAST)
def strip_rows(row, left, across, top, rows):
    """Return the first row and one past the last that a splat's ellipse reaches in a strip of pixel columns.

    The strip's pixel centres lie between x = ``left`` and ``left + across``. Its rows are at y = ``top``,
    ``top`` + 1, …
    """
    bounds = strip_bounds(
        row[MEAN_X],
        row[MEAN_Y],
        row[HALF_WIDTH],
        row[SLOPE],
        row[RISE],
        row[X_OF_TOP],
        left,
        across,
        top,
        rows,
    )
    first, last = int(bounds[0]), int(bounds[1])
    return first, max(first, last)


@inlined(FAST)
def camera_axes(pose, quat, log_scale, min_scale, scale, axes):
    """Fill scale (3,) and axes M (3, 3); return the normalised quaternion and its inverse length."""
    inverse = ONE / math.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    w, x, y, z = quat[0] * inverse, quat[1] * inverse, quat[2] * inverse, quat[3] * inverse
    for k in range(3):
        scale[k] = math.exp(log_scale[k]) + min_scale
    for i in range(3):
        r0, r1, r2 = pose[i, 0], pose[i, 1], pose[i, 2]
        axes[i, 0] = (
            r0 * (ONE - TWO * (y * y + z * z)) + r1 * TWO * (x * y + w * z) + r2 * TWO * (x * z - w * y)
        )
        axes[i, 1] = (
            r0 * TWO * (x * y - w * z) + r1 * (ONE - TWO * (x * x + z * z)) + r2 * TWO * (y * z + w * x)
        )
        axes[i, 2] = (
            r0 * TWO * (x * z + w * y) + r1 * TWO * (y * z - w * x) + r2 * (ONE - TWO * (x * x + y * y))
        )
        for k in range(3):
            axes[i, k] *= scale[k]
    return w, x, y, z, inverse


@kernel(FAST)
def project_forward(
    begin, end, means, quats, log_scales, opacity_logits, sh, weights,
    pose, lens, camera_position, width, height, degree, min_scale, antialias,
    index, depths, projected, radii,
):  # fmt: skip
    """Project the splats at ``index`` (M,).

    Fill depths (M,), with 0 for splats that are not drawn, and for drawn splats the rows of projected
    (M, COLUMNS) and radii (N,). ``weights`` is empty if all are 1. ``antialias`` has one entry, or N.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    scale = np.empty(3, np.float32)
    axes = np.empty((3, 3), np.float32)
    basis = np.empty(25, np.float32)
    for k in range(begin, end):
        i = index[k]
        ahead = index[min(k + PREFETCH, index.shape[0] - 1)]
        prefetch(means, ahead, 0)
        prefetch(quats, ahead, 0)
        prefetch(log_scales, ahead, 0)
        for line in range((sh.shape[1] * 3 + 15) // 16):
            prefetch(sh, ahead, line)
        depths[k] = ZERO
        weight = weights[i] if weights.shape[0] > 0 else ONE
        mean = means[i]
        z = to_camera(pose, 2, mean)
        opacity = weight / (ONE + math.exp(-opacity_logits[i]))
        if z <= lens[8] or opacity <= ALPHA_MIN32:
            continue
        x, y = to_camera(pose, 0, mean), to_camera(pose, 1, mean)
        camera_axes(pose, quats[i], log_scales[i], min_scale, scale, axes)

        rz = ONE / z
        j0, j2 = fx * rz, -fx * clamp(x * rz, lens[4], lens[5]) * rz
        k1, k2 = fy * rz, -fy * clamp(y * rz, lens[6], lens[7]) * rz
        # u and v are the rows of J M
        u0, u1, u2 = (
            j0 * axes[0, 0] + j2 * axes[2, 0],
            j0 * axes[0, 1] + j2 * axes[2, 1],
            j0 * axes[0, 2] + j2 * axes[2, 2],
        )
        v0, v1, v2 = (
            k1 * axes[1, 0] + k2 * axes[2, 0],
            k1 * axes[1, 1] + k2 * axes[2, 1],
            k1 * axes[1, 2] + k2 * axes[2, 2],
        )
        uu = u0 * u0 + u1 * u1 + u2 * u2
        uv = u0 * v0 + u1 * v1 + u2 * v2
        vv = v0 * v0 + v1 * v1 + v2 * v2
        # |u × v|² = uu vv − uv², without the cancellation that needles suffer
        cross0, cross1, cross2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        filtered = antialias[min(i, antialias.shape[0] - 1)]
        dilation = MIP_VARIANCE32 if filtered else DILATION32
        undilated = cross0 * cross0 + cross1 * cross1 + cross2 * cross2
        determinant = undilated + dilation * (uu + vv + dilation)
        xx, yy = uu + dilation, vv + dilation
        if filtered:
            opacity *= math.sqrt(undilated / determinant)
            if opacity <= ALPHA_MIN32:
                continue

        mean_x, mean_y = fx * x * rz + cx, fy * y * rz + cy
        reach = math.sqrt(TWO * math.log(opacity / ALPHA_MIN32))
        half_width, half_height = reach * math.sqrt(xx), reach * math.sqrt(yy)
        if mean_x + half_width <= ZERO or mean_x - half_width >= width:
            continue
        if mean_y + half_height <= ZERO or mean_y - half_height >= height:
            continue
        depths[k] = z
        half_difference = HALF * (xx - yy)
        longest = HALF * (xx + yy) + math.sqrt(half_difference * half_difference + uv * uv)
        radii[i] = f32(3) * math.sqrt(longest)

        row = projected[k]
        row[MEAN_X], row[MEAN_Y] = mean_x, mean_y
        unit = LOG2_E / determinant
        row[CONIC_XX], row[CONIC_XY], row[CONIC_YY] = HALF * unit * yy, -unit * uv, HALF * unit * xx
        row[LOG2_OPACITY] = math.log(opacity) * LOG2_E
        row[HALF_WIDTH], row[HALF_HEIGHT] = half_width, half_height
        row[SLOPE], row[RISE], row[X_OF_TOP] = (
            uv / xx,
            reach * math.sqrt(determinant / xx),
            uv / yy * half_height,
        )

        dx, dy, dz = mean[0] - camera_position[0], mean[1] - camera_position[1], mean[2] - camera_position[2]
        inverse = ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        sh_basis(dx * inverse, dy * inverse, dz * inverse, degree, basis)
        red, green, blue = HALF, HALF, HALF
        for k in range((degree + 1) * (degree + 1)):
            red += basis[k] * sh[i, k, 0]
            green += basis[k] * sh[i, k, 1]
            blue += basis[k] * sh[i, k, 2]
        row[RED], row[GREEN], row[BLUE] = max(red, ZERO), max(green, ZERO), max(blue, ZERO)
        row[DEPTH] = z
        row[FALLOFF] = math.exp(-TWO * LN2 * row[CONIC_YY])


@kernel(FAST)
def gather_weights(begin, end, first_pair, pair_count, pair_row, pair_weights, weights):
    """Reduce pair_weights (P, 3) to weights (M, 3): maximum of the first column, sums of the others."""
    for i in range(begin, end):
        largest, total, pixels = ZERO, ZERO, ZERO
        for pair in range(first_pair[i], first_pair[i] + pair_count[i]):
            row = pair_weights[pair_row[pair]]
            largest, total, pixels = max(largest, row[0]), total + row[1], pixels + row[2]
        weights[i, 0], weights[i, 1], weights[i, 2] = largest, total, pixels


@kernel(FAST)
def gather_sums(begin, end, first_pair, pair_count, pair_row, pair_sums, sums):
    """Add the rows of a splat's pairs in pair_sums (P, K) to the splat's row of sums (M, K)."""
    for i in range(begin, end):
        if pair_count[i] > 0:
            for pair in range(first_pair[i], first_pair[i] + pair_count[i]):
                for k in range(sums.shape[1]):
                    sums[i, k] += pair_sums[pair_row[pair], k]


@inlined(FAST)
def add_pairs(first, count, pair_row, pair_sums, sums):
    """Fill sums (SUMS,) with the sums of a splat's pairs, in registers."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = ZERO
    for pair in range(first, first + count):
        row = pair_row[pair]
        s0, s1, s2 = s0 + pair_sums[row, 0], s1 + pair_sums[row, 1], s2 + pair_sums[row, 2]
        s3, s4, s5 = s3 + pair_sums[row, 3], s4 + pair_sums[row, 4], s5 + pair_sums[row, 5]
        s6, s7, s8 = s6 + pair_sums[row, 6], s7 + pair_sums[row, 7], s8 + pair_sums[row, 8]
    sums[0], sums[1], sums[2], sums[3], sums[4] = s0, s1, s2, s3, s4
    sums[5], sums[6], sums[7], sums[8] = s5, s6, s7, s8


@inlined(FAST)
def covariance_gradient(row, sums):
    """Compute d loss / d (xx, xy, yy) of cov; the two off-diagonal entries are one variable.

    d loss / d conic = H with H_xx = ½ Σ g dx², H_xy = ½ Σ g dx dy (each of the two), H_yy = ½ Σ g dy²; and as
    conic = cov⁻¹, d loss / d cov = −conic H conic. In float64, because these products nearly cancel for
    needles.
    """
    ln2 = math.log(2.0)
    a, b, c = 2 * ln2 * row[CONIC_XX], ln2 * row[CONIC_XY], 2 * ln2 * row[CONIC_YY]
    h_xx, h_xy, h_yy = 0.5 * sums[G_DXDX], 0.5 * sums[G_DXDY], 0.5 * sums[G_DYDY]
    t00, t01 = a * h_xx + b * h_xy, a * h_xy + b * h_yy
    t10, t11 = b * h_xx + c * h_xy, b * h_xy + c * h_yy
    by_xx = f32(-(t00 * a + t01 * b))
    by_xy = f32(-(t00 * b + t01 * c) - (t10 * a + t11 * b))
    by_yy = f32(-(t10 * b + t11 * c))
    by_mean_x, by_mean_y = -(a * sums[G_DX] + b * sums[G_DY]), -(b * sums[G_DX] + c * sums[G_DY])
    return by_xx, by_xy, by_yy, f32(by_mean_x), f32(by_mean_y)


@inlined(FAST)
def area_gradient(axes, j0, j2, k1, k2, by_log, by_area):
    """Fill by_area (2, 3) with the gradient of ln |u × v| by u and v, times by_log.

    The gradient is (v × c, c × u) / |c|² with c = u × v; u and v are the rows of J M. Computing the cross
    product first avoids cancellation for needles.
    """
    u0, v0 = j0 * axes[0, 0] + j2 * axes[2, 0], k1 * axes[1, 0] + k2 * axes[2, 0]
    u1, v1 = j0 * axes[0, 1] + j2 * axes[2, 1], k1 * axes[1, 1] + k2 * axes[2, 1]
    u2, v2 = j0 * axes[0, 2] + j2 * axes[2, 2], k1 * axes[1, 2] + k2 * axes[2, 2]
    c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    unit = by_log / (c0 * c0 + c1 * c1 + c2 * c2)
    by_area[0, 0], by_area[1, 0] = (v1 * c2 - v2 * c1) * unit, (c1 * u2 - c2 * u1) * unit
    by_area[0, 1], by_area[1, 1] = (v2 * c0 - v0 * c2) * unit, (c2 * u0 - c0 * u2) * unit
    by_area[0, 2], by_area[1, 2] = (v0 * c1 - v1 * c0) * unit, (c0 * u1 - c1 * u0) * unit


@inlined(FAST)
def quat_gradient(w, x, y, z, inverse, by_rotation, gradient):
    """Compute d loss / d quat (4,) from d loss / d Q (3, 3), including the normalisation."""
    r = by_rotation
    by_w = TWO * (x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]))
    by_x = -TWO * x * (r[1, 1] + r[2, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0])
    by_x = TWO * (by_x + w * (r[2, 1] - r[1, 2]))
    by_y = x * (r[0, 1] + r[1, 0]) - TWO * y * (r[0, 0] + r[2, 2]) + z * (r[1, 2] + r[2, 1])
    by_y = TWO * (by_y + w * (r[0, 2] - r[2, 0]))
    by_z = x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1]) - TWO * z * (r[0, 0] + r[1, 1])
    by_z = TWO * (by_z + w * (r[1, 0] - r[0, 1]))
    along = by_w * w + by_x * x + by_y * y + by_z * z
    gradient[0] = (by_w - along * w) * inverse
    gradient[1] = (by_x - along * x) * inverse
    gradient[2] = (by_y - along * y) * inverse
    gradient[3] = (by_z - along * z) * inverse


@kernel(FAST)
def project_backward(
    begin, end, means, quats, log_scales, opacity_logits, sh, weights,
    pose, lens, camera_position, width, height, degree, min_scale, antialias,
    index, projected, first_pair, pair_count, pair_row, pair_sums,
    by_means, by_quats, by_log_scales, by_logits, by_sh, by_weights, grad2d,
):  # fmt: skip
    """Fill the gradients of the parameters and grad2d of the splats at ``index`` from the pairs' sums."""
    fx, fy = lens[0], lens[1]
    scale = np.empty(3, np.float32)
    axes = np.empty((3, 3), np.float32)
    by_axes = np.empty((3, 3), np.float32)
    by_rotation = np.empty((3, 3), np.float32)
    by_area = np.empty((2, 3), np.float32)
    sums = np.empty(SUMS, np.float32)
    basis = np.empty(25, np.float32)
    basis_x = np.empty(25, np.float32)
    basis_y = np.empty(25, np.float32)
    basis_z = np.empty(25, np.float32)
    count = index.shape[0]
    for s in range(begin, end):
        i = index[s]
        ahead = min(s + 2 * PREFETCH, count - 1)
        prefetch(pair_row, first_pair[ahead], 0)
        ahead = min(s + PREFETCH, count - 1)
        for pair in range(first_pair[ahead], first_pair[ahead] + pair_count[ahead]):
            prefetch(pair_sums, pair_row[pair], 0)
            prefetch(pair_sums, pair_row[pair] + 1, 0)  # a row may end in the next cache line
        if pair_count[s] == 0:
            for k in range(3):
                by_means[i, k], by_log_scales[i, k] = ZERO, ZERO
            for k in range(4):
                by_quats[i, k] = ZERO
            for k in range(sh.shape[1]):
                by_sh[i, k, 0], by_sh[i, k, 1], by_sh[i, k, 2] = ZERO, ZERO, ZERO
            by_logits[i] = ZERO
            grad2d[i, 0], grad2d[i, 1] = ZERO, ZERO
            if by_weights.shape[0] > 0:
                by_weights[i] = ZERO
            continue
        add_pairs(first_pair[s], pair_count[s], pair_row, pair_sums, sums)

        mean, row = means[i], projected[s]
        x, y, z = to_camera(pose, 0, mean), to_camera(pose, 1, mean), to_camera(pose, 2, mean)
        w, qx, qy, qz, inverse = camera_axes(pose, quats[i], log_scales[i], min_scale, scale, axes)
        rz = ONE / z
        ratio_x, ratio_y = clamp(x * rz, lens[4], lens[5]), clamp(y * rz, lens[6], lens[7])
        j0, j2 = fx * rz, -fx * ratio_x * rz
        k1, k2 = fy * rz, -fy * ratio_y * rz
        by_xx, by_xy, by_yy, by_mean_x, by_mean_y = covariance_gradient(row, sums)
        ndc_x, ndc_y = by_mean_x * HALF * width, by_mean_y * HALF * height
        grad2d[i, 0], grad2d[i, 1] = ndc_x, ndc_y

        if antialias[min(i, antialias.shape[0] - 1)]:
            # opacity has the factor |u × v| / sqrt(det cov): differentiate its logarithm by u, v and det cov
            by_log = -sums[G]
            area_gradient(axes, j0, j2, k1, k2, by_log, by_area)
            by_xx -= by_log * LN2 * row[CONIC_XX]
            by_xy -= by_log * LN2 * row[CONIC_XY]
            by_yy -= by_log * LN2 * row[CONIC_YY]
        else:
            for k in range(3):
                by_area[0, k], by_area[1, k] = ZERO, ZERO

        # u = row 0 of J M, v = row 1: xx = u·u, xy = u·v, yy = v·v
        by_j0, by_j2, by_k1, by_k2 = ZERO, ZERO, ZERO, ZERO
        for k in range(3):
            u, v = j0 * axes[0, k] + j2 * axes[2, k], k1 * axes[1, k] + k2 * axes[2, k]
            by_u = TWO * by_xx * u + by_xy * v + by_area[0, k]
            by_v = TWO * by_yy * v + by_xy * u + by_area[1, k]
            by_j0 += by_u * axes[0, k]
            by_j2 += by_u * axes[2, k]
            by_k1 += by_v * axes[1, k]
            by_k2 += by_v * axes[2, k]
            by_axes[0, k], by_axes[1, k], by_axes[2, k] = j0 * by_u, k1 * by_v, j2 * by_u + k2 * by_v

        # the mean affects its projection fx x/z + cx, and j0 = fx/z and j2 = −fx ratio_x/z,
        by_x, by_y = by_mean_x * j0, by_mean_y * k1
        by_z = -(by_x * x + by_y * y + by_j0 * j0 + by_j2 * j2 + by_k1 * k1 + by_k2 * k2) * rz
        # where ratio_x = x/z unless it is clamped
        if lens[4] < x * rz and x * rz < lens[5]:
            by_ratio = -by_j2 * j0
            by_x += by_ratio * rz
            by_z -= by_ratio * ratio_x * rz
        if lens[6] < y * rz and y * rz < lens[7]:
            by_ratio = -by_k2 * k1
            by_y += by_ratio * rz
            by_z -= by_ratio * ratio_y * rz

        # M = R Q diag(s): d loss / d Q = Rᵀ (d loss / d M) diag(s), and s = exp(log_scale) + min_scale
        for k in range(3):
            by_scale = ZERO
            for j in range(3):
                by_scale += by_axes[j, k] * axes[j, k]
                by_entry = (
                    pose[0, j] * by_axes[0, k] + pose[1, j] * by_axes[1, k] + pose[2, j] * by_axes[2, k]
                )
                by_rotation[j, k] = by_entry * scale[k]
            by_log_scales[i, k] = by_scale * ((scale[k] - min_scale) / scale[k])
        quat_gradient(w, qx, qy, qz, inverse, by_rotation, by_quats[i])

        # sigma = ln opacity − ln alpha, so d loss / d ln opacity = −g; opacity = weight · sigmoid
        sigmoid = ONE / (ONE + math.exp(-opacity_logits[i]))
        by_logits[i] = -sums[G] * (ONE - sigmoid)
        if by_weights.shape[0] > 0:
            by_weights[i] = -sums[G] / weights[i]

        red = sums[G_RED] if row[RED] > ZERO else ZERO
        green = sums[G_GREEN] if row[GREEN] > ZERO else ZERO
        blue = sums[G_BLUE] if row[BLUE] > ZERO else ZERO
        dx, dy, dz = mean[0] - camera_position[0], mean[1] - camera_position[1], mean[2] - camera_position[2]
        per_length = ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * per_length, dy * per_length, dz * per_length
        sh_basis(dx, dy, dz, degree, basis)
        sh_basis_gradient(dx, dy, dz, degree, basis_x, basis_y, basis_z)
        by_dx, by_dy, by_dz = ZERO, ZERO, ZERO
        active = (degree + 1) * (degree + 1)
        for k in range(active):
            by_sh[i, k, 0], by_sh[i, k, 1], by_sh[i, k, 2] = (
                basis[k] * red,
                basis[k] * green,
                basis[k] * blue,
            )
            by_basis = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
            by_dx += by_basis * basis_x[k]
            by_dy += by_basis * basis_y[k]
            by_dz += by_basis * basis_z[k]
        for k in range(active, sh.shape[1]):
            by_sh[i, k, 0], by_sh[i, k, 1], by_sh[i, k, 2] = ZERO, ZERO, ZERO
        # direction = (mean − camera position) / length: only the perpendicular component changes it
        along = by_dx * dx + by_dy * dy + by_dz * dz
        by_means[i, 0] = (by_dx - along * dx) * per_length
        by_means[i, 1] = (by_dy - along * dy) * per_length
        by_means[i, 2] = (by_dz - along * dz) * per_length
        for k in range(3):
            by_means[i, k] += pose[0, k] * by_x + pose[1, k] * by_y + pose[2, k] * by_z
