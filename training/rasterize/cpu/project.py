"""Project splats to ellipses on the image; ``project_backward`` propagates gradients.

Notation: p = R m + t the mean in camera coordinates, M = R Q diag(s) with covariance M Mᵀ, J the Jacobian of
(fx x/z, fy y/z) at p (clamped to a frustum a little wider than the image), cov = J M Mᵀ Jᵀ + dilation (EWA
splatting, Zwicker et al. 2001, as in 3DGS Eq. 5), conic = cov⁻¹. Kernels compute blocks of WIDTH splats in
lanes.
"""

from __future__ import annotations

import math

import numpy as np

from ...editing.bake_filter import MIP_VARIANCE
from ...splats import sh as harmonics
from ..rendering import ALPHA_MIN, DILATION, KernelCamera
from .compile import FAST, f32, inlined, kernel
from .fastmath import LOWEST_EXPONENT, exp2_lanes, exp_lanes, log2_lanes, prefetch
from .lanes import WIDTH, larger, load_row, root, select, smaller, spread

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

MEAN, QUAT, LOG_SCALE, LOGIT, FILTERED = 0, 3, 7, 10, 11
"""First rows of a block (PARAMETERS, WIDTH) of splats, one per lane. FILTERED is 1 with Mip-Splatting's
filter. A block of gradients has the same rows."""
PARAMETERS = 12

GRAIN = 1024
"""Splats in a thread's unit of work."""
PREFETCH = 8
"""Prefetch distance in splats, for data that is scattered in memory: selected splats and sums of pairs."""
ZERO, HALF, ONE, TWO = f32(0), f32(0.5), f32(1), f32(2)
MARGIN = f32(1 / 64)
"""Pixels by which the ellipse's rows and columns are extended against rounding."""
ALPHA_MIN32, DILATION32, MIP_VARIANCE32 = f32(ALPHA_MIN), f32(DILATION), f32(MIP_VARIANCE)
LOG2_ALPHA_MIN32 = f32(math.log2(ALPHA_MIN))
LOG2_E, LN2 = f32(math.log2(math.e)), f32(math.log(2))

sh_basis = inlined(FAST)(harmonics.basis)


def kernel_arguments(view: KernelCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert a view to float32 kernel arguments: pose (3, 4), lens (9,) and camera position (3,)."""
    pose = np.column_stack([view.rotation, view.translation]).astype(np.float32)
    lens = [view.fx, view.fy, view.cx, view.cy, *view.x_limits, *view.y_limits, view.near]
    return np.ascontiguousarray(pose), np.array(lens, np.float32), view.position.astype(np.float32)


@inlined(FAST)
def to_camera(pose, axis, x, y, z):
    """Return a point's coordinate along one axis of a camera."""
    return pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@inlined(FAST)
def clamp(value, low, high):
    """Clamp a value to a range."""
    return smaller(larger(value, low), high)


@inlined(FAST)
def strip_bounds(mean_x, mean_y, half_width, slope, rise, x_of_top, left, across, top, rows, margin):
    """Return the ends of the rows that an ellipse, enlarged by ``margin``, reaches in a strip.

    See :func:`strip_rows`.

    Takes the columns of a projected splat as numbers, or those of several splats as lanes. The ellipse is
    convex, so its maximum dy in the strip is at the dx closest to X_OF_TOP, and its minimum at the dx closest
    to −X_OF_TOP.
    """
    half_width = half_width + margin
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
    first = smaller(larger(middle + dy_low - margin, ZERO), f32(rows))
    last = smaller(larger(middle + dy_high + margin, ZERO), f32(rows))
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
        MARGIN,
    )
    first, last = int(bounds[0]), int(bounds[1])
    return first, max(first, last)


@inlined(FAST)
def read_lane(block, lane, i, means, quats, log_scales, opacity_logits, antialias):
    """Copy the parameters of splat ``i`` to a lane of ``block``."""
    for k in range(3):
        block[MEAN + k, lane] = means[i, k]
        block[LOG_SCALE + k, lane] = log_scales[i, k]
    for k in range(4):
        block[QUAT + k, lane] = quats[i, k]
    block[LOGIT, lane] = opacity_logits[i]
    block[FILTERED, lane] = ONE if antialias[min(i, antialias.shape[0] - 1)] else ZERO


@inlined(FAST)
def camera_axes(pose, block, min_scale):
    """Return the normalised quaternions and their inverse lengths, scales, and axes M, row by row."""
    w, x, y, z = (
        load_row(block, QUAT),
        load_row(block, QUAT + 1),
        load_row(block, QUAT + 2),
        load_row(block, QUAT + 3),
    )
    inverse = ONE / root(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    s0 = exp_lanes(load_row(block, LOG_SCALE)) + min_scale
    s1 = exp_lanes(load_row(block, LOG_SCALE + 1)) + min_scale
    s2 = exp_lanes(load_row(block, LOG_SCALE + 2)) + min_scale
    q00, q01, q02 = ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)
    q10, q11, q12 = TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)
    q20, q21, q22 = TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)
    rows = (
        axes_row(pose, 0, q00, q10, q20, q01, q11, q21, q02, q12, q22, s0, s1, s2),
        axes_row(pose, 1, q00, q10, q20, q01, q11, q21, q02, q12, q22, s0, s1, s2),
        axes_row(pose, 2, q00, q10, q20, q01, q11, q21, q02, q12, q22, s0, s1, s2),
    )
    return (w, x, y, z, inverse), (s0, s1, s2), rows


@inlined(FAST)
def axes_row(pose, i, q00, q10, q20, q01, q11, q21, q02, q12, q22, s0, s1, s2):
    """Return a row of M = R Q diag(s)."""
    r0, r1, r2 = pose[i, 0], pose[i, 1], pose[i, 2]
    return (
        (r0 * q00 + r1 * q10 + r2 * q20) * s0,
        (r0 * q01 + r1 * q11 + r2 * q21) * s1,
        (r0 * q02 + r1 * q12 + r2 * q22) * s2,
    )


@inlined(FAST)
def ellipse_axes(axes, j0, j2, k1, k2):
    """Return the rows u and v of J M, and their cross product."""
    m0, m1, m2 = axes
    u = j0 * m0[0] + j2 * m2[0], j0 * m0[1] + j2 * m2[1], j0 * m0[2] + j2 * m2[2]
    v = k1 * m1[0] + k2 * m2[0], k1 * m1[1] + k2 * m2[1], k1 * m1[2] + k2 * m2[2]
    return u, v, cross(u, v)


@inlined(FAST)
def dot(a, b):
    """Return the scalar product of two vectors of three lanes."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined(FAST)
def cross(a, b):
    """Return the vector product of two vectors of three lanes."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined(FAST)
def direction_from(camera_position, x, y, z):
    """Return the unit vector from the camera to a point, and its inverse length."""
    dx, dy, dz = x - camera_position[0], y - camera_position[1], z - camera_position[2]
    per_length = ONE / root(dx * dx + dy * dy + dz * dz)
    return dx * per_length, dy * per_length, dz * per_length, per_length


RADIUS = COLUMNS
"""Row of a projected block after its columns: radius in pixels."""


@inlined(FAST)
def project_block(
    block, weight, pose, lens, camera_position, width, height, degree, min_scale, projected, basis
):  # fmt: skip
    """Fill projected (COLUMNS + 1, WIDTH), besides colours, and the SH basis (25, WIDTH) from a block.

    DEPTH is 0 if a splat is not drawn.
    """
    fx, fy, cx, cy, near = lens[0], lens[1], lens[2], lens[3], lens[8]
    mean_x, mean_y, mean_z = load_row(block, MEAN), load_row(block, MEAN + 1), load_row(block, MEAN + 2)
    ahead = to_camera(pose, 2, mean_x, mean_y, mean_z)
    x, y = to_camera(pose, 0, mean_x, mean_y, mean_z), to_camera(pose, 1, mean_x, mean_y, mean_z)
    z = larger(ahead, near)
    opacity = weight / (ONE + exp_lanes(-load_row(block, LOGIT)))
    _, _, axes = camera_axes(pose, block, min_scale)

    rz = ONE / z
    j0, j2 = fx * rz, -fx * clamp(x * rz, lens[4], lens[5]) * rz
    k1, k2 = fy * rz, -fy * clamp(y * rz, lens[6], lens[7]) * rz
    u, v, normal = ellipse_axes(axes, j0, j2, k1, k2)
    uu, uv, vv = dot(u, u), dot(u, v), dot(v, v)
    # |u × v|² = uu vv − uv², without the cancellation that needles suffer
    undilated = dot(normal, normal)
    filtered = load_row(block, FILTERED) > HALF
    dilation = select(filtered, spread(MIP_VARIANCE32), DILATION32)
    determinant = undilated + dilation * (uu + vv + dilation)
    xx, yy = uu + dilation, vv + dilation
    opacity = select(filtered, opacity * root(undilated / determinant), opacity)

    log2_opacity = log2_lanes(larger(opacity, ALPHA_MIN32))
    reach = root(TWO * LN2 * larger(log2_opacity - LOG2_ALPHA_MIN32, ZERO))
    image_x, image_y = fx * x * rz + cx, fy * y * rz + cy
    half_width, half_height = reach * root(xx), reach * root(yy)
    is_drawn = (ahead > near) & (opacity > ALPHA_MIN32)
    is_drawn = is_drawn & (image_x + half_width > ZERO) & (image_x - half_width < f32(width))
    is_drawn = is_drawn & (image_y + half_height > ZERO) & (image_y - half_height < f32(height))
    half_difference = HALF * (xx - yy)
    longest = HALF * (xx + yy) + root(half_difference * half_difference + uv * uv)
    unit = LOG2_E / determinant
    conic_yy = HALF * unit * xx
    dx, dy, dz, _ = direction_from(camera_position, mean_x, mean_y, mean_z)

    projected[MEAN_X] = image_x
    projected[MEAN_Y] = image_y
    projected[CONIC_XX] = HALF * unit * yy
    projected[CONIC_XY] = -unit * uv
    projected[CONIC_YY] = conic_yy
    projected[LOG2_OPACITY] = log2_opacity
    projected[HALF_WIDTH] = half_width
    projected[HALF_HEIGHT] = half_height
    projected[SLOPE] = uv / xx
    projected[RISE] = reach * root(determinant / xx)
    projected[X_OF_TOP] = uv / yy * half_height
    projected[DEPTH] = select(is_drawn, z, ZERO)
    projected[FALLOFF] = exp2_lanes(larger(-TWO * conic_yy, LOWEST_EXPONENT))
    projected[RADIUS] = f32(3) * root(longest)
    sh_basis(dx, dy, dz, degree, basis)


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
    block = np.empty((PARAMETERS + 1, WIDTH), np.float32)
    result = np.empty((COLUMNS + 1, WIDTH), np.float32)
    basis = np.empty((25, WIDTH), np.float32)
    last = index.shape[0] - 1
    for start in range(begin, end, WIDTH):
        for lane in range(WIDTH):
            ahead = index[min(start + lane + WIDTH, last)]
            prefetch(means, ahead, 0)
            prefetch(quats, ahead, 0)
            prefetch(log_scales, ahead, 0)
            i = index[min(start + lane, end - 1)]
            read_lane(block, lane, i, means, quats, log_scales, opacity_logits, antialias)
            block[PARAMETERS, lane] = weights[i] if weights.shape[0] > 0 else ONE
        weight = load_row(block, PARAMETERS)
        project_block(
            block, weight, pose, lens, camera_position, width, height, degree, min_scale, result, basis
        )  # fmt: skip
        for lane in range(min(WIDTH, end - start)):
            s = start + lane
            i = index[s]
            ahead = index[min(s + PREFETCH, last)]
            for line in range((sh.shape[1] * 3 + 15) // 16):
                prefetch(sh, ahead, line)
            depth = result[DEPTH, lane]
            depths[s] = depth
            if depth == ZERO:
                continue
            for k in range(COLUMNS):
                projected[s, k] = result[k, lane]
            radii[i] = result[RADIUS, lane]
            red, green, blue = HALF, HALF, HALF
            for k in range((degree + 1) * (degree + 1)):
                red += basis[k, lane] * sh[i, k, 0]
                green += basis[k, lane] * sh[i, k, 1]
                blue += basis[k, lane] * sh[i, k, 2]
            projected[s, RED], projected[s, GREEN] = max(red, ZERO), max(green, ZERO)
            projected[s, BLUE] = max(blue, ZERO)
