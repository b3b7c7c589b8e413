"""A tree over any splats: pairs that stand together merge into one splat, round by round, up to a root.

A node stands for all leaves below it. Its mean, covariance and harmonics are the leaves' own moments, as in A
LoD of Gaussians, which takes H3DGS's merge; weights are optical depth times area, there opacity times area.
How it is drawn is ours: opacities stay below 1, as files have them, and what the leaves hide more than one
splat of their moments can makes it larger instead, up to ``SPREAD``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit, spence

from ...errors import LodgsError
from ...lod.blocks import AXIS_BITS, morton_codes
from ...lod.tree.forest import Piece, max_subtree_leaves, merge_forest, merge_trees, split_tree
from ...lod.tree.shape import Tree, splat_area
from ...rasterize.cpu.compile import STRICT, inlined, kernel, run_parallel
from ...splats.gaussians import SH_C0, SplatRows, Splats
from ...splats.scratch import ScratchFile

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
CELL = 1 << 18
"""Most leaves whose tree is built at a time."""
_ROWS = 1 << 18
"""Leaves that are read, and covariances that are taken apart, at a time."""


def build(leaves: Splats) -> tuple[Splats, Tree]:
    """The nodes of a tree over splats in memory, 2N - 1: the leaves in spatial order, then those above them.

    Raises:
        LodgsError: as :class:`GrowingForest`.
    """
    return merge_forest(GrowingForest(leaves))


class GrowingForest:
    """A tree over splats, built while its subtrees are asked for, which is once (``lod.tree.forest.Forest``).

    The partner that two splats choose is the one with which they make the least area (of the merged
    covariance, more where colours differ); those that choose each other merge (parallel locally-ordered
    clustering, Meister and Bittner 2018). Deterministic, on any number of threads.

    Cells of space, halved until none has more than CELL leaves, are built one after the other; their roots
    are then merged in the same way. In memory are one cell, 12 bytes of each leaf, and the upper tree.

    Args:
        leaves: N of them; their extras go.
        scratch: a folder where they are put in order; None: they are in memory.
        sh_degree: of their harmonics at most; what is above goes.
        longest: most leaves of a subtree; 0: ``longest_of``.
        cell: see CELL.

    Raises:
        LodgsError: there are fewer than two.
    """

    def __init__(
        self,
        leaves: SplatRows,
        scratch: Path | None = None,
        sh_degree: int = 4,
        longest: int = 0,
        cell: int = CELL,
    ) -> None:
        if len(leaves) < 2:
            raise LodgsError("One splat makes no tree.", "Begin with more splats.")
        self._leaves, self._scratch, self._cell = leaves, scratch, cell
        self._coefficients = (sh_degree + 1) ** 2
        self._longest = longest or max_subtree_leaves(len(leaves))
        self._upper: Piece | None = None

    @property
    def upper(self) -> Piece:
        """The tree above the subtrees, as soon as all have been asked for."""
        assert self._upper is not None, "the subtrees come first"
        return self._upper

    def __iter__(self) -> Iterator[Piece]:
        uppers, moments, harmonics = [], [], []
        for leaves in _by_cells(self._leaves, self._scratch, self._cell):
            leaves.sh = leaves.sh[:, : self._coefficients]
            nodes, tree, root = _grown(leaves)
            moments.append(root)
            harmonics.append(nodes.sh[-1].copy())
            grove = split_tree(nodes, tree, self._longest)
            above, upper = grove.upper
            uppers.append((above.select(np.arange(len(above))), upper))  # a copy: a view would keep all nodes
            del nodes, leaves
            yield from grove
            del grove, above
        above, top = _merged_up(np.stack(moments))
        nodes = _drawn(above, top, np.stack(harmonics), np.stack(moments)[:, 9])
        splats = Splats.concatenated([*(splats for splats, _ in uppers), nodes])
        self._upper = splats, merge_trees([tree for _, tree in uppers], top)


def _by_cells(leaves: SplatRows, scratch: Path | None, most: int) -> Iterator[Splats]:
    """Leaves in spatial order, those of a cell of space at a time, which are at most so many."""
    means = np.empty((len(leaves), 3), np.float32)
    for part in _parts(len(leaves)):
        means[part] = leaves.select(part).means
    places = morton_codes(means)
    del means
    order = np.argsort(places, kind="stable")
    borders = _cells(places[order], most)
    del places
    if scratch is None:
        assert isinstance(leaves, Splats)
        for cell in pairwise(borders):
            yield _bare(leaves.select(order[slice(*cell)]))
        return
    cell_of = np.empty(len(leaves), np.int32)
    for number, cell in enumerate(pairwise(borders)):
        cell_of[order[slice(*cell)]] = number
    filled = np.array(borders[:-1])
    with ScratchFile(scratch) as file:
        for part in _parts(len(leaves)):
            splats, cells = _bare(leaves.select(part)), cell_of[part]
            by_cell = np.argsort(cells, kind="stable")
            found, begins = np.unique(cells[by_cell], return_index=True)
            for number, rows in zip(found.tolist(), np.split(by_cell, begins[1:]), strict=True):
                file.write(int(filled[number]), splats.select(rows))
                filled[number] += len(rows)
        for cell in pairwise(borders):  # whose leaves are there as they were read
            ranks = np.argsort(np.argsort(order[slice(*cell)]))
            yield file.select(slice(*cell)).select(ranks)


def _cells(places: np.ndarray, most: int) -> list[int]:
    """Where cells begin in places (N,) on the curve, ascending, and N: halves of cells, until none has more
    than so many places; those that are in one are told apart by their rows."""
    borders, ahead = [0], [(0, len(places), 3 * AXIS_BITS)]
    while ahead:
        begin, end, bit = ahead.pop()
        if end - begin <= most:
            borders.append(end)
            continue
        middle = begin + most
        if bit:
            bit -= 1
            half = (places[begin] >> np.uint64(bit) | np.uint64(1)) << np.uint64(bit)
            middle = begin + int(np.searchsorted(places[begin:end], half))
        ahead += [part for part in ((middle, end, bit), (begin, middle, bit)) if part[0] < part[1]]
    return borders


def _parts(count: int) -> Iterator[slice]:
    for begin in range(0, count, _ROWS):
        yield slice(begin, min(begin + _ROWS, count))


def _bare(splats: Splats) -> Splats:
    return replace(splats, extras={})


def _grown(leaves: Splats) -> tuple[Splats, Tree, np.ndarray]:
    """The nodes of a tree over splats in spatial order, the tree, and the moments (13,) of its root."""
    means, covariances, depths = _moments(leaves)
    colors = 0.5 + SH_C0 * leaves.sh[:, 0].astype(np.float64)
    moments = np.concatenate([means, covariances, depths[:, None], colors], axis=1)
    above, tree = _merged_up(moments)
    nodes = Splats.concatenated([leaves, _drawn(above, tree, leaves.sh, depths)])
    return nodes, tree, (above if len(above) else moments)[-1].copy()


def _merged_up(moments: np.ndarray) -> tuple[np.ndarray, Tree]:
    """The moments (N - 1, 13) of the nodes above N splats in spatial order, and the tree.

    Args:
        moments: (N, 13) of the splats; they are overwritten.
    """
    leaves = len(moments)
    numbers = np.arange(leaves, dtype=np.int32)
    nodes, children = [np.empty((0, moments.shape[1]))], [np.empty((0, 2), np.int32)]
    best = np.zeros(leaves, np.int32)
    while len(moments) > 1:
        count = len(moments)
        run_parallel(_choose_partners, count, 1 << 12, moments, RADIUS, COLOR, best)
        first, second = _pairs(best[:count])
        merged = _merged(moments[first], moments[second])
        children.append(np.stack([numbers[first], numbers[second]], axis=1))
        kept = np.ones(count, bool)
        kept[second] = False
        numbers[first] = leaves + sum(map(len, nodes)) + np.arange(len(first))
        nodes.append(merged)
        moments[first] = merged
        moments, numbers = moments[kept], numbers[kept]
    return np.concatenate(nodes), Tree(np.concatenate(children))


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
    areas = np.maximum(splat_area(splats.log_scales), 1e-60)
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
    hidden = moments[:, 9] / splat_area(log_scales)  # optical depth, if it were drawn as large as its moments
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
