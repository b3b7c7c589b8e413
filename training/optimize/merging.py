"""Merging of splats: mass-preserving moment matching of neighbours.

Pairs of neighbours merge in rounds, those of least image error first, as in NanoGS (Xiong et al. 2026,
arXiv 2603.16103). A merged splat has the joint mean and covariance of its members, weighted by mass. Mass is
optical depth times area, so a merged splat hides as much as its members. The error of a pair is the squared
difference between the images of its members and of the merged splat (not in the paper). It grows with size,
opacity and difference of colour, so thin and contrasting structures remain longest.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit, spence

from ..rasterize.cpu.compile import STRICT, inlined, kernel, run_parallel
from ..splats.gaussians import SH_C0, Splats, splat_area

MAX_OPACITY = 0.99
"""Maximum opacity of a merged splat, the maximum that a rasterizer draws."""
MAX_SPREAD = 3.0
"""Maximum area of a merged splat relative to its members' moments.

A uniform square has a standard deviation of 0.29 of its side, which leaves gaps to its neighbours; half the
side closes them.
"""
NEIGHBOURS = 8
"""Number of candidate partners of a splat."""
ROUND_SHARE = 0.25
"""Maximum fraction of the splats that merge in a round; later rounds have better candidates."""
COVERAGE = 0.5
"""Weight of opacity in the error of a pair, as a channel beside red, green and blue."""
_BATCH_ROWS = 1 << 18
"""Number of covariances to decompose at a time."""
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Indices of the six entries of a covariance: xx, xy, xz, yy, yz, zz."""


def merge(splats: Splats, count: int) -> Splats:
    """Merge neighbours until ``count`` splats remain.

    Returns:
        ``min(count, N)`` splats in the order of their first members, at least one. Unmerged splats are
            unchanged. Extras of a merged splat are those of its heaviest member.
    """
    total, count = len(splats), max(count, 1)
    if total <= count:
        return splats
    means, covariances, masses = splat_moments(splats)
    colors = 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)
    rows = np.column_stack([means, covariances, masses, colors])
    labels = np.arange(total)
    while len(rows) > count:
        first, second = _cheapest_pairs(rows, min(len(rows) - count, int(ROUND_SHARE * len(rows)) + 1))
        rows[first] = merge_pairs(rows[first], rows[second])
        remaining = np.ones(len(rows), bool)
        remaining[second] = False
        numbers = np.cumsum(remaining) - 1
        numbers[second] = numbers[first]
        labels, rows = numbers[labels], rows[remaining]
    return _join_members(splats, rows, masses, labels)


def optical_depth(opacities: np.ndarray) -> np.ndarray:
    """Return Li2(opacity), (N,): the integral of -ln(1 - alpha) over a splat's footprint, per 2π of its area.

    Optical depths add up, for splats side by side and for splats behind one another.
    """
    return spence(1 - np.asarray(opacities, np.float64))


_MAX_DEPTH = float(optical_depth(np.array(MAX_OPACITY)))
_OPACITIES = np.interp(
    np.linspace(0, _MAX_DEPTH, 2049),
    optical_depth(np.linspace(0, MAX_OPACITY, 1 << 14)),
    np.linspace(0, MAX_OPACITY, 1 << 14),
)
"""Opacities at equidistant optical depths, up to ``_MAX_DEPTH``."""


def splat_moments(splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means (N, 3), covariances (N, 6) and masses (N,), float64."""
    covariances = np.empty((len(splats), 6))
    for begin in range(0, len(splats), _BATCH_ROWS):
        part = slice(begin, begin + _BATCH_ROWS)
        quats = splats.quats[part].astype(np.float64)
        matrices = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
        matrices *= np.exp(np.minimum(splats.log_scales[part], 40).astype(np.float64))[:, None]
        squares = matrices @ matrices.swapaxes(1, 2)
        covariances[part] = squares[:, _ROWS, _COLUMNS]
    depths = optical_depth(np.clip(expit(splats.opacity_logits.astype(np.float64)), 1e-4, MAX_OPACITY))
    areas = np.maximum(splat_area(splats.log_scales), 1e-60)
    return splats.means.astype(np.float64), covariances, depths * areas


def merge_pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Merge pairs of moments (M, 10 or more): joint means and covariances, weighted by mass.

    Columns: mean (3), covariance (6), mass, and further ones to average.
    """
    mass = first[:, 9] + second[:, 9]
    share = (first[:, 9] / mass)[:, None]
    merged = share * first + (1 - share) * second
    apart = first[:, :3] - second[:, :3]
    merged[:, 3:9] += share * (1 - share) * (apart[:, _ROWS] * apart[:, _COLUMNS])
    merged[:, 9] = mass
    return merged


def shapes_of_moments(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return quats (M, 4), log-scales (M, 3) and opacity logits (M,) of merged moments, float32.

    Opacities stay below ``MAX_OPACITY``. A splat that then hides less than its members is enlarged, up to
    ``MAX_SPREAD``.
    """
    count = len(moments)
    log_scales, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    for begin in range(0, count, _BATCH_ROWS):
        part = slice(begin, begin + _BATCH_ROWS)
        matrices = moments[part, 3:9][:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3)
        variances, axes = np.linalg.eigh(matrices)
        variances = np.maximum(variances, np.maximum(1e-12 * variances[:, 2:], 1e-60))
        log_scales[part] = np.log(variances) / 2
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        quats[part] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    hidden = moments[:, 9] / splat_area(log_scales)  # optical depth before enlarging
    samples = np.linspace(1e-4, MAX_OPACITY, 4096)
    opacities = np.interp(hidden, optical_depth(samples), samples)
    wider = np.clip(hidden / optical_depth(opacities), 1, MAX_SPREAD)
    log_scales += (np.log(wider) / 2).astype(np.float32)[:, None]
    return quats, log_scales, logit(opacities).astype(np.float32)


def _join_members(splats: Splats, rows: np.ndarray, masses: np.ndarray, labels: np.ndarray) -> Splats:
    """Return the splats with these moments (M, >9), given the label of each original splat (N,)."""
    by_label = np.lexsort((-masses, labels))
    begins = np.flatnonzero(np.diff(labels[by_label], prepend=-1))
    result = splats.select(by_label[begins])  # the heaviest members
    joined = np.diff(begins, append=len(labels)) > 1
    shares = (masses / rows[labels, 9])[by_label, None, None]
    sh = np.add.reduceat(shares * splats.sh[by_label], begins, axis=0)
    quats, log_scales, logits = shapes_of_moments(rows[joined])
    result.means[joined] = rows[joined, :3]
    result.quats[joined], result.log_scales[joined], result.opacity_logits[joined] = quats, log_scales, logits
    result.sh[joined] = sh[joined]
    return result


def _cheapest_pairs(rows: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (M,) and their larger partners (M,): disjoint pairs of least error, 1 to ``limit``."""
    count = len(rows)
    neighbours = KDTree(rows[:, :3]).query(rows[:, :3], min(NEIGHBOURS + 1, count), workers=-1)[1]
    partners, errors = np.zeros(count, np.int64), np.empty(count)
    run_parallel(_choose_partners, count, 1 << 10, rows, neighbours, _OPACITIES, _MAX_DEPTH, partners, errors)
    # a pair merges if no proposal with a smaller error has a splat in common with it
    rank = np.empty(count, np.int64)
    rank[np.argsort(errors, kind="stable")] = np.arange(count)
    lowest = rank.copy()
    np.minimum.at(lowest, partners, rank)
    chosen = np.flatnonzero((lowest == rank) & (lowest[partners] == rank))
    chosen = chosen[np.argsort(rank[chosen])][:limit]
    pairs = np.sort(np.stack([chosen, partners[chosen]]), axis=0)
    return pairs[0], pairs[1]


@kernel(STRICT)
def _choose_partners(begin, end, rows, neighbours, opacities, max_depth, partners, errors):
    """Choose the neighbour of least error for each row."""
    for i in range(begin, end):
        least, chosen = np.inf, -1
        for j in neighbours[i]:
            if j != i:
                error = _pair_error(rows[min(i, j)], rows[max(i, j)], opacities, max_depth)
                if error < least or chosen < 0:
                    least, chosen = error, j
        partners[i], errors[i] = chosen, least


@inlined(STRICT)
def _appearance(mass, xx, xy, xz, yy, yz, zz, opacities, max_depth):
    """Return opacity and variance factor of moments; area is the root of the second invariant."""
    area = np.sqrt(max(xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz, 1e-120))
    depth = mass / area
    if depth >= max_depth:
        return opacities[-1], min(depth / max_depth, 3.0)
    place = depth / max_depth * (len(opacities) - 1)
    index = int(place)
    return opacities[index] + (place - index) * (opacities[index + 1] - opacities[index]), 1.0


@inlined(STRICT)
def _overlap(first, second, x, y):
    """Return the integral of a product of two image-plane Gaussians of peak 1, at offset x, y.

    Args:
        first, second: covariances (xx, xy, yy).
    """
    xx, xy, yy = first[0] + second[0], first[1] + second[1], first[2] + second[2]
    determinant = max(xx * yy - xy * xy, 1e-120)
    product = max(first[0] * first[2] - first[1] * first[1], 0.0) * max(
        second[0] * second[2] - second[1] * second[1], 0.0
    )
    power = (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant
    return 2 * np.pi * np.sqrt(product / determinant) * np.exp(-power / 2)


@inlined(STRICT)
def _square(covariance):
    """Return the integral of a squared image-plane Gaussian of peak 1."""
    return np.pi * np.sqrt(max(covariance[0] * covariance[2] - covariance[1] * covariance[1], 0.0))


@inlined(STRICT)
def _scaled(covariance, factor):
    return covariance[0] * factor, covariance[1] * factor, covariance[2] * factor


@inlined(STRICT)
def _pair_error(first, second, opacities, max_depth):
    """Return the squared image error of merging two rows, summed over three axis-parallel projections."""
    share = first[9] / (first[9] + second[9])
    rest = 1 - share
    both = share * rest
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    xx = share * first[3] + rest * second[3] + both * x * x
    xy = share * first[4] + rest * second[4] + both * x * y
    xz = share * first[5] + rest * second[5] + both * x * z
    yy = share * first[6] + rest * second[6] + both * y * y
    yz = share * first[7] + rest * second[7] + both * y * z
    zz = share * first[8] + rest * second[8] + both * z * z
    a, wide_a = _appearance(
        first[9], first[3], first[4], first[5], first[6], first[7], first[8], opacities, max_depth
    )
    b, wide_b = _appearance(
        second[9], second[3], second[4], second[5], second[6], second[7], second[8], opacities, max_depth
    )
    c, wide_c = _appearance(first[9] + second[9], xx, xy, xz, yy, yz, zz, opacities, max_depth)
    aa, bb, ab = COVERAGE * COVERAGE, COVERAGE * COVERAGE, COVERAGE * COVERAGE
    for k in range(10, 13):
        aa += first[k] * first[k]
        bb += second[k] * second[k]
        ab += first[k] * second[k]
    cc = share * share * aa + rest * rest * bb + 2 * both * ab
    ac, bc = share * aa + rest * ab, share * ab + rest * bb
    error = 0.0
    for axis in range(3):
        if axis == 0:
            s, t, m = (first[3], first[4], first[6]), (second[3], second[4], second[6]), (xx, xy, yy)
            u, v = x, y
        elif axis == 1:
            s, t, m = (first[3], first[5], first[8]), (second[3], second[5], second[8]), (xx, xz, zz)
            u, v = x, z
        else:
            s, t, m = (first[6], first[7], first[8]), (second[6], second[7], second[8]), (yy, yz, zz)
            u, v = y, z
        s, t, m = _scaled(s, wide_a), _scaled(t, wide_b), _scaled(m, wide_c)
        error += (
            a * a * aa * _square(s)
            + b * b * bb * _square(t)
            + c * c * cc * _square(m)
            + 2 * a * b * ab * _overlap(s, t, u, v)
            - 2 * a * c * ac * _overlap(s, m, rest * u, rest * v)
            - 2 * b * c * bc * _overlap(t, m, share * u, share * v)
        )
    return error
