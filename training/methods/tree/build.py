"""A tree over any splats: pairs that stand together merge into one splat, round by round, up to a root.

A node stands for all leaves below it. Its mean, covariance and harmonics are the leaves' own moments, as in A
LoD of Gaussians, which takes H3DGS's merge; weights are optical depth times area, there opacity times area.
How it is drawn is ours: opacities stay below 1, as files have them, and what the leaves hide more than one
splat of their moments can makes it larger instead, up to ``SPREAD``.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit, spence

from ...errors import LodgsError
from ...lod.blocks import spatial_order
from ...lod.tree import Tree, area_of
from ...rasterize.cpu.compile import STRICT, in_parallel, inlined, kernel
from ...splats.gaussians import SH_C0, Splats

RADIUS = 16
"""A splat's partner is among so many on either side of it on a curve through space."""
COLOR = 4.0
"""How much larger a merged splat counts where its two parts differ by 1 in colour, squared."""
OPAQUE = 0.99
"""Opacity of a node whose leaves hide all behind them: what a rasterizer draws at most."""
SPREAD = 3.0
"""By so much at most is a node's area larger than its leaves' moments make it. A square of a surface has the
standard deviation of 0.29 of its side, which leaves gaps to its neighbours; half of the side closes them."""
LEAST_PROGRESS = 1 / 16
"""Where fewer of all splats than this find a partner in a round, neighbours on the curve merge."""
_ROWS = 1 << 18
"""Covariances that are taken apart at a time."""


def build(leaves: Splats) -> tuple[Splats, Tree]:
    """The nodes of a tree over splats: the leaves in spatial order, then those above them.

    The partner that two splats choose is the one with which they make the least area (of the merged
    covariance, more where colours differ); those that choose each other merge (parallel locally-ordered
    clustering, Meister and Bittner 2018). Deterministic, on any number of threads.

    Args:
        leaves: N of them; their extras go.

    Raises:
        LodgsError: there are fewer than two.
    """
    if len(leaves) < 2:
        raise LodgsError("One splat makes no tree.", "Begin with more splats.")
    leaves = leaves.select(spatial_order(leaves.means))
    leaves.extras = {}
    means, covariances, depths = _moments(leaves)
    colors = 0.5 + SH_C0 * leaves.sh[:, 0].astype(np.float64)
    moments = np.concatenate([means, covariances, depths[:, None], colors], axis=1)
    numbers = np.arange(len(leaves), dtype=np.int32)
    nodes, children = [], []
    best = np.zeros(len(leaves), np.int32)
    while len(moments) > 1:
        count = len(moments)
        in_parallel(_choose_partners, count, 1 << 12, moments, RADIUS, COLOR, best)
        first, second = _pairs(best[:count])
        merged = _merged(moments[first], moments[second])
        children.append(np.stack([numbers[first], numbers[second]], axis=1))
        numbers[first] = len(leaves) + sum(map(len, nodes)) + np.arange(len(first))
        nodes.append(merged)
        moments[first] = merged
        kept = np.ones(count, bool)
        kept[second] = False
        moments, numbers = moments[kept], numbers[kept]
    tree = Tree(np.concatenate(children))
    return Splats.concatenated([leaves, _drawn(np.concatenate(nodes), tree, leaves.sh, depths)]), tree


def optical_depth(opacities: np.ndarray) -> np.ndarray:
    """Li2(o), (N,): what a splat hides, the integral of -ln(1 - alpha) over its shadow, per 2π of its area.

    Those of splats one behind the other add up, and those side by side, too.
    """
    return spence(1 - np.asarray(opacities, np.float64))


def _moments(splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (N, 3), covariances (N, 6) and optical depths times area (N,), float64."""
    covariances = np.empty((len(splats), 6))
    for begin in range(0, len(splats), _ROWS):
        some = slice(begin, begin + _ROWS)
        quats = splats.quats[some].astype(np.float64)
        matrices = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
        matrices *= np.exp(np.minimum(splats.log_scales[some], 40).astype(np.float64))[:, None]
        squares = matrices @ matrices.swapaxes(1, 2)
        covariances[some] = squares[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    depths = optical_depth(np.clip(expit(splats.opacity_logits.astype(np.float64)), 1e-4, OPAQUE))
    areas = np.maximum(area_of(splats.log_scales), 1e-60)
    return splats.means.astype(np.float64), covariances, depths * areas


@inlined(STRICT)
def _merged_area(one, other):
    """sqrt of the second invariant of the merged covariance, which of a flat splat is its area s1 s2."""
    share = one[9] / (one[9] + other[9])
    rest, both = 1 - share, share * (1 - share)
    x, y, z = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    xx = share * one[3] + rest * other[3] + both * x * x
    xy = share * one[4] + rest * other[4] + both * x * y
    xz = share * one[5] + rest * other[5] + both * x * z
    yy = share * one[6] + rest * other[6] + both * y * y
    yz = share * one[7] + rest * other[7] + both * y * z
    zz = share * one[8] + rest * other[8] + both * z * z
    return np.sqrt(max(xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz, 0.0))


@kernel(STRICT)
def _choose_partners(begin, end, moments, radius, color, best):
    """The row whose merger with each costs least; of equal ones the one with the least exclusive or."""
    for i in range(begin, end):
        least, chosen = np.inf, -1
        for j in range(max(i - radius, 0), min(i + radius + 1, len(moments))):
            if j != i:
                one, other = moments[min(i, j)], moments[max(i, j)]  # the same number from either side
                red, green, blue = one[10] - other[10], one[11] - other[11], one[12] - other[12]
                unlike = red * red + green * green + blue * blue
                cost = _merged_area(one, other) * (1 + color * unlike)
                if cost < least or chosen < 0 or (cost == least and (i ^ j) < (i ^ chosen)):
                    least, chosen = cost, j
        best[i] = chosen


def _pairs(best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows (M,) and their partners (M,), larger ones, that chose each other; at least one pair."""
    rows = np.arange(len(best), dtype=np.int32)
    mutual = best[best] == rows
    if mutual.sum() < LEAST_PROGRESS * len(best):  # chains, each of which wants the next
        free = rows[~mutual]
        free = free[: len(free) // 2 * 2]
        best[free[0::2]], best[free[1::2]] = free[1::2], free[0::2]
        mutual[free] = True
    first = np.flatnonzero(mutual & (rows < best)).astype(np.int32)
    return first, best[first]


def _merged(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Moments (M, 13) of pairs: means and covariances of both together, weighted by their depths."""
    depth = one[:, 9] + other[:, 9]
    share = (one[:, 9] / depth)[:, None]
    merged = share * one + (1 - share) * other
    apart = one[:, :3] - other[:, :3]
    between = apart[:, (0, 0, 0, 1, 1, 2)] * apart[:, (0, 1, 2, 1, 2, 2)]
    merged[:, 3:9] += share * (1 - share) * between
    merged[:, 9] = depth
    return merged


def _drawn(moments: np.ndarray, tree: Tree, sh: np.ndarray, depths: np.ndarray) -> Splats:
    """The splats (M,) of moments (M, 13) of the nodes above leaves."""
    count = len(moments)
    log_scales, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
    for begin in range(0, count, _ROWS):
        some = slice(begin, begin + _ROWS)
        matrices = moments[some, 3:9][:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(-1, 3, 3)
        variances, axes = np.linalg.eigh(matrices)
        variances = np.maximum(variances, np.maximum(1e-12 * variances[:, 2:], 1e-60))
        log_scales[some] = np.log(variances) / 2
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        quats[some] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    hidden = moments[:, 9] / area_of(log_scales)  # optical depth, if it were drawn as large as its moments
    known = np.linspace(1e-4, OPAQUE, 4096)
    opacities = np.interp(hidden, optical_depth(known), known)
    wider = np.clip(hidden / optical_depth(opacities), 1, SPREAD)
    log_scales += (np.log(wider) / 2).astype(np.float32)[:, None]
    harmonics = np.empty((count, *sh.shape[1:]), np.float32)
    depths = np.concatenate([depths, moments[:, 9]])
    for layer in reversed(tree.layers):
        below = tree.children[layer - tree.leaves]
        shares = (depths[below] / depths[layer, None]).astype(np.float32)
        of_leaf = below < tree.leaves
        parts = np.where(
            of_leaf[..., None, None],
            sh[np.where(of_leaf, below, 0)],
            harmonics[np.where(of_leaf, 0, below - tree.leaves)],
        )
        harmonics[layer - tree.leaves] = (shares[..., None, None] * parts).sum(axis=1)
    return Splats(
        moments[:, :3].astype(np.float32), quats, log_scales, logit(opacities).astype(np.float32), harmonics
    )
