"""Propagate the gradients of projected splats to the parameters of the splats; notation as in ``project``.

Blending leaves sums for each pair of a splat and a tile, which are reduced first.
"""

from __future__ import annotations

import math

import numpy as np

from ...splats import sh as harmonics
from .adam import adam_values
from .compile import FAST, f32, inlined, kernel
from .fastmath import exp_lanes, prefetch
from .lanes import WIDTH, load_row, select, spread
from .project import (
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    FILTERED,
    G_BLUE,
    G_DX,
    G_DXDX,
    G_DXDY,
    G_DY,
    G_DYDY,
    G_GREEN,
    G_RED,
    GREEN,
    HALF,
    LN2,
    LOG_SCALE,
    LOGIT,
    MEAN,
    ONE,
    PARAMETERS,
    PREFETCH,
    QUAT,
    RED,
    SUMS,
    TWO,
    ZERO,
    G,
    camera_axes,
    clamp,
    cross,
    direction_from,
    dot,
    ellipse_axes,
    read_lane,
    sh_basis,
    to_camera,
)

sh_basis_gradient = inlined(FAST)(harmonics.basis_gradient)


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
def area_gradient(u, v, normal, by_log):
    """Return the gradient of ln |u × v| by u and v, times by_log.

    The gradient is (v × c, c × u) / |c|² with the normal c = u × v. Computing the cross product first avoids
    cancellation for needles.
    """
    unit = by_log / dot(normal, normal)
    a, b = cross(v, normal), cross(normal, u)
    return (a[0] * unit, a[1] * unit, a[2] * unit), (b[0] * unit, b[1] * unit, b[2] * unit)


@inlined(FAST)
def quat_gradient(quat, r0, r1, r2):
    """Compute d loss / d quat from the rows of d loss / d Q, including the normalisation."""
    w, x, y, z, inverse = quat
    by_w = TWO * (x * (r2[1] - r1[2]) + y * (r0[2] - r2[0]) + z * (r1[0] - r0[1]))
    by_x = y * (r0[1] + r1[0]) + z * (r0[2] + r2[0]) - TWO * x * (r1[1] + r2[2])
    by_x = TWO * (by_x + w * (r2[1] - r1[2]))
    by_y = x * (r0[1] + r1[0]) - TWO * y * (r0[0] + r2[2]) + z * (r1[2] + r2[1])
    by_y = TWO * (by_y + w * (r0[2] - r2[0]))
    by_z = x * (r0[2] + r2[0]) + y * (r1[2] + r2[1]) - TWO * z * (r0[0] + r1[1])
    by_z = TWO * (by_z + w * (r1[0] - r0[1]))
    along = by_w * w + by_x * x + by_y * y + by_z * z
    return (
        (by_w - along * w) * inverse,
        (by_x - along * x) * inverse,
        (by_y - along * y) * inverse,
        (by_z - along * z) * inverse,
    )


@inlined(FAST)
def rotation_row(pose, j, by_m0, by_m1, by_m2, scales):
    """Return a row of d loss / d Q = Rᵀ (d loss / d M) diag(s)."""
    p0, p1, p2 = pose[0, j], pose[1, j], pose[2, j]
    return (
        (p0 * by_m0[0] + p1 * by_m1[0] + p2 * by_m2[0]) * scales[0],
        (p0 * by_m0[1] + p1 * by_m1[1] + p2 * by_m2[1]) * scales[1],
        (p0 * by_m0[2] + p1 * by_m1[2] + p2 * by_m2[2]) * scales[2],
    )


BY_XX, BY_XY, BY_YY, BY_X, BY_Y, BY_LOG = range(6)
"""Rows of a block of gradients: by cov, the mean in pixels, and ln opacity."""
CONICS = 6
"""First of three rows with the conics."""


@inlined(FAST)
def differentiate_block(
    block, by, by_basis, basis_x, basis_y, basis_z,
    pose, lens, camera_position, degree, min_scale, result,
):  # fmt: skip
    """Fill result (PARAMETERS - 1, WIDTH) with the gradients of a block's splats.

    ``by`` (K, WIDTH) has the gradients by the projected ellipses, and their conics. by_basis (25, WIDTH) has
    the gradients by the SH basis. The other arrays (25, WIDTH) are scratch memory.
    """
    fx, fy = lens[0], lens[1]
    mean_x, mean_y, mean_z = load_row(block, MEAN), load_row(block, MEAN + 1), load_row(block, MEAN + 2)
    x, y = to_camera(pose, 0, mean_x, mean_y, mean_z), to_camera(pose, 1, mean_x, mean_y, mean_z)
    rz = ONE / to_camera(pose, 2, mean_x, mean_y, mean_z)
    quat, scales, axes = camera_axes(pose, block, min_scale)
    unclamped_x, unclamped_y = x * rz, y * rz
    ratio_x, ratio_y = clamp(unclamped_x, lens[4], lens[5]), clamp(unclamped_y, lens[6], lens[7])
    j0, j2 = fx * rz, -fx * ratio_x * rz
    k1, k2 = fy * rz, -fy * ratio_y * rz
    u, v, normal = ellipse_axes(axes, j0, j2, k1, k2)
    by_xx, by_xy, by_yy = load_row(by, BY_XX), load_row(by, BY_XY), load_row(by, BY_YY)
    by_mean_x, by_mean_y, by_log = load_row(by, BY_X), load_row(by, BY_Y), load_row(by, BY_LOG)

    # a filtered opacity has the factor |u × v| / sqrt(det cov): differentiate its logarithm
    by_area = select(load_row(block, FILTERED) > HALF, by_log, ZERO)
    area_u, area_v = area_gradient(u, v, normal, by_area)
    by_xx = by_xx - by_area * LN2 * load_row(by, CONICS)
    by_xy = by_xy - by_area * LN2 * load_row(by, CONICS + 1)
    by_yy = by_yy - by_area * LN2 * load_row(by, CONICS + 2)

    # u = row 0 of J M, v = row 1: xx = u·u, xy = u·v, yy = v·v
    xx2, yy2 = TWO * by_xx, TWO * by_yy
    by_u = (
        xx2 * u[0] + by_xy * v[0] + area_u[0],
        xx2 * u[1] + by_xy * v[1] + area_u[1],
        xx2 * u[2] + by_xy * v[2] + area_u[2],
    )
    by_v = (
        yy2 * v[0] + by_xy * u[0] + area_v[0],
        yy2 * v[1] + by_xy * u[1] + area_v[1],
        yy2 * v[2] + by_xy * u[2] + area_v[2],
    )
    by_j0, by_j2 = dot(by_u, axes[0]), dot(by_u, axes[2])
    by_k1, by_k2 = dot(by_v, axes[1]), dot(by_v, axes[2])
    by_m0 = j0 * by_u[0], j0 * by_u[1], j0 * by_u[2]
    by_m1 = k1 * by_v[0], k1 * by_v[1], k1 * by_v[2]
    by_m2 = j2 * by_u[0] + k2 * by_v[0], j2 * by_u[1] + k2 * by_v[1], j2 * by_u[2] + k2 * by_v[2]

    # the mean affects its projection fx x/z + cx, and j0 = fx/z and j2 = −fx ratio_x/z,
    by_x, by_y = by_mean_x * j0, by_mean_y * k1
    by_z = -rz * (by_x * x + by_y * y + by_j0 * j0 + by_j2 * j2 + by_k1 * k1 + by_k2 * k2)
    # where ratio_x = x/z unless it is clamped
    is_inside = (unclamped_x > lens[4]) & (unclamped_x < lens[5])
    by_ratio = select(is_inside, -by_j2 * j0 * rz, ZERO)
    by_x, by_z = by_x + by_ratio, by_z - by_ratio * ratio_x
    is_inside = (unclamped_y > lens[6]) & (unclamped_y < lens[7])
    by_ratio = select(is_inside, -by_k2 * k1 * rz, ZERO)
    by_y, by_z = by_y + by_ratio, by_z - by_ratio * ratio_y
    # direction = (mean − camera position) / length: only the perpendicular component changes it
    dx, dy, dz, per_length = direction_from(camera_position, mean_x, mean_y, mean_z)
    sh_basis_gradient(dx, dy, dz, degree, basis_x, basis_y, basis_z)
    by_dx, by_dy, by_dz = spread(ZERO), spread(ZERO), spread(ZERO)
    for k in range((degree + 1) * (degree + 1)):
        by_value = load_row(by_basis, k)
        by_dx = by_dx + by_value * load_row(basis_x, k)
        by_dy = by_dy + by_value * load_row(basis_y, k)
        by_dz = by_dz + by_value * load_row(basis_z, k)
    along = by_dx * dx + by_dy * dy + by_dz * dz
    by_mean = pose[0, 0] * by_x + pose[1, 0] * by_y + pose[2, 0] * by_z
    result[MEAN] = by_mean + (by_dx - along * dx) * per_length
    by_mean = pose[0, 1] * by_x + pose[1, 1] * by_y + pose[2, 1] * by_z
    result[MEAN + 1] = by_mean + (by_dy - along * dy) * per_length
    by_mean = pose[0, 2] * by_x + pose[1, 2] * by_y + pose[2, 2] * by_z
    result[MEAN + 2] = by_mean + (by_dz - along * dz) * per_length

    # M = R Q diag(s), and s = exp(log_scale) + min_scale
    m0, m1, m2 = axes
    by_scale = by_m0[0] * m0[0] + by_m1[0] * m1[0] + by_m2[0] * m2[0]
    result[LOG_SCALE] = by_scale * ((scales[0] - min_scale) / scales[0])
    by_scale = by_m0[1] * m0[1] + by_m1[1] * m1[1] + by_m2[1] * m2[1]
    result[LOG_SCALE + 1] = by_scale * ((scales[1] - min_scale) / scales[1])
    by_scale = by_m0[2] * m0[2] + by_m1[2] * m1[2] + by_m2[2] * m2[2]
    result[LOG_SCALE + 2] = by_scale * ((scales[2] - min_scale) / scales[2])
    by_quat = quat_gradient(
        quat,
        rotation_row(pose, 0, by_m0, by_m1, by_m2, scales),
        rotation_row(pose, 1, by_m0, by_m1, by_m2, scales),
        rotation_row(pose, 2, by_m0, by_m1, by_m2, scales),
    )
    result[QUAT] = by_quat[0]
    result[QUAT + 1] = by_quat[1]
    result[QUAT + 2] = by_quat[2]
    result[QUAT + 3] = by_quat[3]

    # opacity = weight · sigmoid
    sigmoid = ONE / (ONE + exp_lanes(-load_row(block, LOGIT)))
    result[LOGIT] = by_log * (ONE - sigmoid)


@inlined(FAST)
def clear_gradients(i, by_means, by_quats, by_log_scales, by_logits, by_weights):
    """Set the gradients at row ``i`` to 0."""
    for k in range(3):
        by_means[i, k], by_log_scales[i, k] = ZERO, ZERO
    for k in range(4):
        by_quats[i, k] = ZERO
    by_logits[i] = ZERO
    if by_weights.shape[0] > 0:
        by_weights[i] = ZERO


@inlined(FAST)
def set_coefficients(by_coefficients, active, basis, red, green, blue):
    """Set the gradients (K, 3) of a splat's active coefficients."""
    for k in range(active):
        by_coefficients[k, 0], by_coefficients[k, 1] = basis[k] * red, basis[k] * green
        by_coefficients[k, 2] = basis[k] * blue


@inlined(FAST)
def step_harmonics(i, trained, gradient, step):
    """Make an Adam step of the first ``trained`` numbers of a splat's harmonics."""
    values, m, v, rates, keep_m, keep_v, scale_v, eps = step
    adam_values(values, i * rates.shape[0], trained, gradient, 0, m, v, rates, keep_m, keep_v, scale_v, eps)


@inlined(FAST)
def step_range(begin, end, index, width, gradient, step):
    """Make an Adam step of the rows ``index[begin:end]`` of ``width`` numbers, with gradients by range."""
    values, m, v, rates, keep_m, keep_v, scale_v, eps = step
    rows, length = end - begin, width
    if index[end - 1] - index[begin] == rows - 1:  # neighbours in memory: one row, in whole vectors
        rows, length = 1, rows * width
    for k in range(rows):
        start = index[begin + k] * width
        adam_values(values, start, length, gradient, k * length, m, v, rates, keep_m, keep_v, scale_v, eps)


@kernel(FAST)
def project_backward(
    begin, end, means, quats, log_scales, opacity_logits, sh, weights,
    pose, lens, camera_position, width, height, degree, min_scale, antialias,
    index, projected, first_pair, pair_count, pair_row, pair_sums, gradients, grad2d, steps, sparse_sh,
):  # fmt: skip
    """Fill the gradients of the parameters and grad2d of the splats at ``index`` from the pairs' sums.

    ``gradients`` has one array per parameter. With ``steps``, the parameters make their Adam steps at once
    instead, and these arrays are empty. ``steps`` has the arguments of ``adam_values`` for each parameter,
    besides positions and gradients. Rates of harmonics are those of one splat, all others those of GRAIN
    splats. Numba compiles a kernel for each case. With ``sparse_sh``, harmonics of splats outside the image
    make no step.
    """
    by_means, by_quats, by_log_scales, by_logits, by_sh, by_weights = gradients
    if steps is not None:
        by_means, by_quats = np.empty((end - begin, 3), np.float32), np.empty((end - begin, 4), np.float32)
        by_log_scales, by_logits = np.empty((end - begin, 3), np.float32), np.empty(end - begin, np.float32)
    block = np.ones((PARAMETERS, WIDTH), np.float32)
    by = np.zeros((CONICS + 3, WIDTH), np.float32)
    result = np.empty((LOGIT + 1, WIDTH), np.float32)
    places = np.empty(WIDTH, np.int32)
    sums = np.empty(SUMS, np.float32)
    basis = np.empty(25, np.float32)
    by_basis = np.zeros((25, WIDTH), np.float32)
    basis_x = np.empty((25, WIDTH), np.float32)
    basis_y = np.empty((25, WIDTH), np.float32)
    basis_z = np.empty((25, WIDTH), np.float32)
    active = (degree + 1) * (degree + 1)
    by_coefficients = np.zeros((25 + WIDTH, 3), np.float32)
    flat_coefficients = by_coefficients.reshape(-1)
    trained = min(-(-3 * active // WIDTH) * WIDTH, 3 * sh.shape[1])  # whole vectors; others have no moments
    count = index.shape[0]
    lanes = 0
    for s in range(begin, end):
        i = index[s]
        place = i if steps is None else s - begin
        ahead = min(s + 2 * PREFETCH, count - 1)
        prefetch(pair_row, first_pair[ahead], 0)
        ahead = min(s + PREFETCH, count - 1)
        for pair in range(first_pair[ahead], first_pair[ahead] + pair_count[ahead]):
            prefetch(pair_sums, pair_row[pair], 0)
            prefetch(pair_sums, pair_row[pair] + 1, 0)  # a row may end in the next cache line
        if pair_count[s] == 0:
            clear_gradients(place, by_means, by_quats, by_log_scales, by_logits, by_weights)
            grad2d[i, 0], grad2d[i, 1] = ZERO, ZERO
            if steps is None:
                by_sh[i] = ZERO
            else:
                flat_coefficients[:trained] = ZERO
        else:
            add_pairs(first_pair[s], pair_count[s], pair_row, pair_sums, sums)
            read_lane(block, lanes, i, means, quats, log_scales, opacity_logits, antialias)
            row = projected[s]
            by_xx, by_xy, by_yy, by_mean_x, by_mean_y = covariance_gradient(row, sums)
            by[BY_XX, lanes], by[BY_XY, lanes] = by_xx, by_xy
            by[BY_YY, lanes], by[BY_LOG, lanes] = by_yy, -sums[G]
            by[BY_X, lanes], by[BY_Y, lanes] = by_mean_x, by_mean_y
            for k in range(3):
                by[CONICS + k, lanes] = row[CONIC_XX + k]
            grad2d[i, 0], grad2d[i, 1] = by_mean_x * HALF * width, by_mean_y * HALF * height
            if by_weights.shape[0] > 0:
                by_weights[i] = -sums[G] / weights[i]
            red = sums[G_RED] if row[RED] > ZERO else ZERO
            green = sums[G_GREEN] if row[GREEN] > ZERO else ZERO
            blue = sums[G_BLUE] if row[BLUE] > ZERO else ZERO
            dx, dy, dz = (
                means[i, 0] - camera_position[0],
                means[i, 1] - camera_position[1],
                means[i, 2] - camera_position[2],
            )
            per_length = ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * per_length, dy * per_length, dz * per_length
            sh_basis(dx, dy, dz, degree, basis)
            for k in range(active):
                by_basis[k, lanes] = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
            if steps is None:
                set_coefficients(by_sh[i], active, basis, red, green, blue)
                by_sh[i, active:] = ZERO
            else:
                set_coefficients(by_coefficients, active, basis, red, green, blue)
            places[lanes] = place
            lanes += 1
        if steps is not None and (pair_count[s] > 0 or not sparse_sh):
            step_harmonics(i, trained, flat_coefficients, steps[4])
        if lanes < WIDTH and s + 1 < end:
            continue
        differentiate_block(
            block, by, by_basis, basis_x, basis_y, basis_z,
            pose, lens, camera_position, degree, min_scale, result,
        )  # fmt: skip
        for lane in range(lanes):
            i = places[lane]
            for k in range(3):
                by_means[i, k] = result[MEAN + k, lane]
                by_log_scales[i, k] = result[LOG_SCALE + k, lane]
            for k in range(4):
                by_quats[i, k] = result[QUAT + k, lane]
            by_logits[i] = result[LOGIT, lane]
        lanes = 0
    if steps is not None:
        step_range(begin, end, index, 3, by_means.reshape(-1), steps[0])
        step_range(begin, end, index, 4, by_quats.reshape(-1), steps[1])
        step_range(begin, end, index, 3, by_log_scales.reshape(-1), steps[2])
        step_range(begin, end, index, 1, by_logits, steps[3])
