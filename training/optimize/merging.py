"""Reduction of splats to a smaller number: neighbours merge by moment matching. Does not import torch.

A merged splat has the joint mean, covariance and harmonics of its members. Weights are masses: optical depth
times area. Masses add up, so a merged splat hides as much as its members. Pairs of least cost merge first
(Runnalls 2007, Eq. 16): the bound of the information that a merge loses, here with areas instead of volumes,
plus the loss of colour.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit, spence

from ..rasterize.cpu.compile import STRICT, inlined, kernel, run_parallel
from ..splats.batches import batch_slices
from ..splats.gaussians import SH_C0, Splats, splat_area
from ..splats.morton import spatial_order
from .neighbors import query_neighbors

MAX_OPACITY = 0.99
"""Maximum opacity of a merged splat, the maximum that a rasterizer draws."""
MAX_SPREAD = 1.5
"""Maximum area of a merged splat relative to its members' moments. Larger ones blur small images."""
NEIGHBORS = 8
"""Number of candidate partners of a splat."""
COLOR_WEIGHT = 5.0
"""Weight of a squared colour difference relative to the information loss."""
MIN_PAIRED_SHARE = 1 / 64
"""Minimum fraction of splats that must pair up in a round; otherwise neighbours on a curve merge."""
_BATCH_ROWS = 1 << 15
"""Number of splats to process at a time, few enough for the processor's cache."""
_GRAIN = 1 << 10
"""Rows of a thread's unit of work."""
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Indices of the six entries of a covariance: xx, xy, xz, yy, yz, zz."""


def merge(splats: Splats, count: int) -> Splats:
    """Merge neighbouring splats until ``count`` remain.

    Args:
        splats: N splats.
        count: number of splats of the result; one remains for less.

    Returns:
        ``min(max(count, 1), N)`` splats in the order of their first members. Unmerged ones are unchanged; a
            merged one has the extras of its heaviest member.
    """
    count = max(count, 1)
    if len(splats) <= count:
        return splats
    means, covariances, masses = splat_moments(splats)
    colors = 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)
    moments = np.concatenate([means, covariances, masses[:, None], colors], axis=1)
    members = np.arange(len(splats))
    while len(moments) > count:
        first, second = cheapest_pairs(moments, len(moments) - count)
        moments[first] = merge_pairs(moments[first], moments[second])
        remaining = np.ones(len(moments), bool)
        remaining[second] = False
        numbers = np.cumsum(remaining) - 1
        numbers[second] = numbers[first]
        members, moments = numbers[members], moments[remaining]
    return _merged_splats(splats, masses, members, moments)


def optical_depth(opacities: np.ndarray) -> np.ndarray:
    """Return Li2(opacity), (N,): the integral of -ln(1 - alpha) over a splat's footprint, per 2π of its area.

    Optical depths add up, for splats side by side and for splats behind one another.
    """
    return spence(1 - np.asarray(opacities, np.float64))


def splat_moments(splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means (N, 3), covariances (N, 6) and masses (N,), float64."""
    covariances = np.empty((len(splats), 6))
    for part in batch_slices(len(splats), _BATCH_ROWS):
        quats = splats.quats[part].astype(np.float64)
        matrices = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
        matrices *= np.exp(np.minimum(splats.log_scales[part], 40).astype(np.float64))[:, None]
        squares = matrices @ matrices.swapaxes(1, 2)
        covariances[part] = squares[:, _ROWS, _COLUMNS]
    depths = optical_depth(np.clip(expit(splats.opacity_logits.astype(np.float64)), 1e-4, MAX_OPACITY))
    areas = np.maximum(splat_area(splats.log_scales), 1e-60)
    return splats.means.astype(np.float64), covariances, depths * areas


def merge_pairs(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Merge pairs of moments (..., 10 or more): mean (3), covariance (6), mass, columns to average."""
    mass = first[..., 9] + second[..., 9]
    share = (first[..., 9] / mass)[..., None]
    merged = share * first + (1 - share) * second
    offset = first[..., :3] - second[..., :3]
    merged[..., 3:9] += share * (1 - share) * (offset[..., _ROWS] * offset[..., _COLUMNS])
    merged[..., 9] = mass
    return merged


def shapes_of_moments(
    moments: np.ndarray, max_spread: float = MAX_SPREAD
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return quats (M, 4), log-scales (M, 3) and opacity logits (M,) of moments, float32.

    Opacities stay below MAX_OPACITY. A splat that then hides less than its members is enlarged, up to
    ``max_spread`` times its area.
    """
    quats = np.empty((len(moments), 4), np.float32)
    log_scales = np.empty((len(moments), 3), np.float32)
    for part in batch_slices(len(moments), _BATCH_ROWS):
        matrices = moments[part, 3:9][:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3)
        variances, axes = np.linalg.eigh(matrices)
        variances = np.maximum(variances, np.maximum(1e-12 * variances[:, 2:], 1e-60))
        log_scales[part] = np.log(variances) / 2
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        quats[part] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    depths = moments[:, 9] / splat_area(log_scales)  # before enlarging
    samples = np.linspace(1e-4, MAX_OPACITY, 4096)
    opacities = np.interp(depths, optical_depth(samples), samples)
    spread = np.clip(depths / optical_depth(opacities), 1, max_spread)
    log_scales += (np.log(spread) / 2).astype(np.float32)[:, None]
    return quats, log_scales, logit(opacities).astype(np.float32)


def cheapest_pairs(moments: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (M,) and their larger partners (M,): disjoint pairs of least cost, 1 to ``limit``."""
    count = len(moments)
    _, neighbors = query_neighbors(KDTree(moments[:, :3]), moments[:, :3], min(NEIGHBORS + 1, count))
    partners, costs = np.empty(count, np.int64), np.empty(count)
    moments = np.ascontiguousarray(moments)
    run_parallel(_choose_partners, count, _GRAIN, moments, _log_areas(moments), neighbors, partners, costs)
    # a pair merges if no cheaper one has a splat in common with it
    rank = np.empty(count, np.int64)
    rank[np.argsort(costs, kind="stable")] = np.arange(count)
    lowest = rank.copy()
    np.minimum.at(lowest, partners, rank)
    chosen = np.flatnonzero((lowest == rank) & (lowest[partners] == rank))
    if len(chosen) < min(limit, MIN_PAIRED_SHARE * count):  # all choose the same few: pair along a curve
        chosen, following = spatial_order(moments[:, :3])[: count // 2 * 2].reshape(-1, 2).T
        partners[chosen] = following
    chosen = chosen[np.argsort(rank[chosen])][:limit]
    return np.minimum(chosen, partners[chosen]), np.maximum(chosen, partners[chosen])


def merge_errors(moments: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the errors of merging rows ``first`` (M,) with rows ``second`` (M,) of moments (N, 10 or more).

    Returns:
        (M,) float64: areas in squared scene units, times an optical depth.
    """
    moments, errors = np.ascontiguousarray(moments), np.empty(len(first))
    run_parallel(_fill_errors, len(first), _GRAIN, moments, _log_areas(moments), first, second, errors)
    return errors


def _log_areas(moments: np.ndarray) -> np.ndarray:
    """Return half the log of the second invariant of covariances, (N,); log(s1 s2) for a flat splat."""
    areas = np.empty(len(moments))
    run_parallel(_fill_log_areas, len(moments), _GRAIN, moments, areas)
    return areas


@inlined(STRICT)
def _log_area(xx, xy, xz, yy, yz, zz):
    return math.log(max(xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz, 1e-120)) / 2


@kernel(STRICT)
def _fill_log_areas(begin, end, moments, areas):
    for i in range(begin, end):
        row = moments[i]
        areas[i] = _log_area(row[3], row[4], row[5], row[6], row[7], row[8])


@inlined(STRICT)
def _pair_error(moments, log_areas, first, second):
    """Return the error of merging two rows. It depends on their order in the last bits."""
    a, b = moments[first], moments[second]
    mass = a[9] + b[9]
    p = a[9] / mass
    q = 1 - p
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    log_area = _log_area(
        p * a[3] + q * b[3] + p * q * (x * x),
        p * a[4] + q * b[4] + p * q * (x * y),
        p * a[5] + q * b[5] + p * q * (x * z),
        p * a[6] + q * b[6] + p * q * (y * y),
        p * a[7] + q * b[7] + p * q * (y * z),
        p * a[8] + q * b[8] + p * q * (z * z),
    )
    color = 0.0
    for k in range(10, a.shape[0]):
        color += (a[k] - b[k]) ** 2
    loss = log_area - p * log_areas[first] - q * log_areas[second]
    return mass * (loss + COLOR_WEIGHT * p * q * color)


@kernel(STRICT)
def _fill_errors(begin, end, moments, log_areas, first, second, errors):
    for i in range(begin, end):
        errors[i] = _pair_error(moments, log_areas, first[i], second[i])


@kernel(STRICT)
def _choose_partners(begin, end, moments, log_areas, neighbors, partners, costs):
    """Fill the cheapest partner of each row among its neighbors (N, K), and the cost of the pair."""
    for i in range(begin, end):
        partners[i], costs[i] = neighbors[i, 0], math.inf
        for j in neighbors[i]:
            if j != i:
                cost = _pair_error(moments, log_areas, min(i, j), max(i, j))
                if cost < costs[i]:
                    partners[i], costs[i] = j, cost


def _merged_splats(splats: Splats, masses: np.ndarray, members: np.ndarray, moments: np.ndarray) -> Splats:
    """Return the splats of moments (M, 10 or more).

    Args:
        splats: N original splats.
        masses: (N,).
        members: (N,) index of the merged splat of each original one.
    """
    order = np.lexsort((-masses, members))
    begins = np.flatnonzero(np.diff(members[order], prepend=-1))
    result = splats.select(order[begins])  # the heaviest members
    changed = np.diff(begins, append=len(members)) > 1
    shares = (masses / moments[members, 9])[order, None, None].astype(np.float32)
    harmonics = np.add.reduceat(shares * splats.sh[order], begins, axis=0)
    quats, log_scales, logits = shapes_of_moments(moments[changed])
    result.means[changed] = moments[changed, :3]
    result.quats[changed] = quats
    result.log_scales[changed] = log_scales
    result.opacity_logits[changed] = logits
    result.sh[changed] = harmonics[changed]
    return result
