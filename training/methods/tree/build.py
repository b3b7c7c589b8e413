"""Build a tree of splats: neighbouring pairs merge into one splat, round by round, up to a root.

A node represents all leaves below it. Its mean, covariance and harmonics are the moments of the leaves, as
in A LoD of Gaussians, which uses the merge of H3DGS. Weights are optical depth times area; the paper uses
opacity times area. Not in the paper: opacities stay below 1, as required by files, and a node that hides
less than its leaves is enlarged instead (``optimize.merging``).

Also not in the paper, and optional: neighbours of least error merge first, as in ``optimize.merging``. The
sum of the errors of all merges in a node becomes its size, which decides the cuts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...errors import LodgsError
from ...lod.tree.forest import Piece, max_subtree_leaves, merge_forest, merge_trees, split_tree
from ...lod.tree.nodes import NODE_SIZE
from ...lod.tree.shape import Tree
from ...optimize import merging
from ...optimize.merging import merge_pairs, shapes_of_moments, splat_moments
from ...rasterize.cpu.compile import STRICT, inlined, kernel, run_parallel
from ...splats.batches import batch_slices
from ...splats.gaussians import SH_C0, SplatRows, Splats
from ...splats.morton import AXIS_BITS, morton_codes
from ...splats.scratch import ScratchFile

RADIUS = 16
"""Number of candidate partners on either side of a splat along a space-filling curve."""
COLOR_WEIGHT = 4.0
"""Cost factor for merging colours that differ by 1 (squared distance)."""
MAX_SPREAD = 3.0
"""Maximum area of a node relative to its leaves' moments.

A uniform square has a standard deviation of 0.29 of its side, which leaves gaps to its neighbours; half the
side closes them.
"""
ERROR = 13
"""Column of moments with the sum of the errors of all merges below."""
ERROR_SCALE = 1.5
"""Size of a node relative to the square root of its error, an area. Nodes then have about the sizes of the
paper."""
MIN_ERROR = 1e-30
"""Minimum error of a node; nodes without an error have the size of the paper."""
MIN_PAIRED_SHARE = 1 / 16
"""Minimum fraction of splats that must pair up in a round; otherwise neighbours on the curve merge."""
CELL_LEAVES = 1 << 18
"""Maximum number of leaves whose tree is built at a time."""
_BATCH_ROWS = 1 << 18
"""Number of leaves to read at a time."""


def build(leaves: Splats, by_error: bool = False) -> tuple[Splats, Tree]:
    """Build a tree over splats in memory.

    Returns the 2N - 1 nodes, leaves in spatial order before inner nodes, and the tree.

    Raises:
        LodgsError: see :class:`ForestBuilder`.
    """
    return merge_forest(ForestBuilder(leaves, by_error=by_error))


class ForestBuilder:
    """A tree over splats that is built during iteration over its subtrees (``lod.tree.forest.Forest``).

    It can be iterated once. Each splat chooses the partner of least cost: merged area, with a penalty for
    different colours, or merge error. Splats that choose each other merge (parallel locally-ordered
    clustering, Meister and Bittner 2018). The result is deterministic for any number of threads.

    Space is halved into cells of at most CELL_LEAVES leaves. Their trees are built one after the other, and
    their roots are merged in the same way. Memory holds one cell, 12 bytes per leaf and the upper tree.

    Args:
        leaves: N splats; extras are dropped.
        scratch: folder for sorting the leaves on disk; None if they are in memory.
        sh_degree: maximum degree of the harmonics; higher ones are dropped.
        subtree_leaves: maximum number of leaves of a subtree; 0 uses ``max_subtree_leaves``.
        cell: see CELL_LEAVES.
        by_error: merge neighbours of least error first, and add the column NODE_SIZE with the nodes' errors.
            Otherwise each splat chooses the partner of least merged area.

    Raises:
        LodgsError: there are fewer than two leaves.
    """

    def __init__(
        self,
        leaves: SplatRows,
        scratch: Path | None = None,
        sh_degree: int = 4,
        subtree_leaves: int = 0,
        cell: int = CELL_LEAVES,
        by_error: bool = False,
    ) -> None:
        if len(leaves) < 2:
            raise LodgsError("Cannot build a tree: it needs at least two splats.", "Start with more splats.")
        self._leaves, self._scratch, self._cell = leaves, scratch, cell
        self._by_error = by_error
        self._coefficients = (sh_degree + 1) ** 2
        self._subtree_leaves = subtree_leaves or max_subtree_leaves(len(leaves))
        self._upper: Piece | None = None

    @property
    def upper(self) -> Piece:
        """The tree above the subtrees, available after iteration."""
        assert self._upper is not None, "iterate over the subtrees first"
        return self._upper

    def __iter__(self) -> Iterator[Piece]:
        uppers, moments, harmonics = [], [], []
        for leaves in _read_cells(self._leaves, self._scratch, self._cell):
            leaves.sh = leaves.sh[:, : self._coefficients]
            nodes, tree, root = _build_cell(leaves, self._by_error)
            moments.append(root)
            harmonics.append(nodes.sh[-1].copy())
            grove = split_tree(nodes, tree, self._subtree_leaves)
            above, upper = grove.upper
            uppers.append((above.select(np.arange(len(above))), upper))  # a copy: a view would keep all nodes
            del nodes, leaves
            yield from grove
            del grove, above
        above, top = _merge_to_root(np.stack(moments), self._by_error)
        nodes = _node_splats(above, top, np.stack(harmonics), np.stack(moments)[:, 9], self._by_error)
        splats = Splats.concatenated([*(splats for splats, _ in uppers), nodes])
        self._upper = splats, merge_trees([tree for _, tree in uppers], top)


def _read_cells(leaves: SplatRows, scratch: Path | None, max_leaves: int) -> Iterator[Splats]:
    """Yield the leaves in spatial order, one cell of limited size at a time."""
    means = np.empty((len(leaves), 3), np.float32)
    for part in batch_slices(len(leaves), _BATCH_ROWS):
        means[part] = leaves.select(part).means
    codes = morton_codes(means)
    del means
    order = np.argsort(codes, kind="stable")
    borders = _cell_bounds(codes[order], max_leaves)
    del codes
    if scratch is None:
        assert isinstance(leaves, Splats)
        for cell in pairwise(borders):
            yield _drop_extras(leaves.select(order[slice(*cell)]))
        return
    cell_of = np.empty(len(leaves), np.int32)
    for number, cell in enumerate(pairwise(borders)):
        cell_of[order[slice(*cell)]] = number
    filled = np.array(borders[:-1])
    with ScratchFile(scratch) as file:
        for part in batch_slices(len(leaves), _BATCH_ROWS):
            splats, cells = _drop_extras(leaves.select(part)), cell_of[part]
            by_cell = np.argsort(cells, kind="stable")
            cell_numbers, begins = np.unique(cells[by_cell], return_index=True)
            for number, rows in zip(cell_numbers.tolist(), np.split(by_cell, begins[1:]), strict=True):
                file.write(int(filled[number]), splats.select(rows))
                filled[number] += len(rows)
        for cell in pairwise(borders):  # its leaves are in the order of reading
            ranks = np.argsort(np.argsort(order[slice(*cell)]))
            yield file.select(slice(*cell)).select(ranks)


def _cell_bounds(codes: np.ndarray, max_leaves: int) -> list[int]:
    """Return the cell boundaries in ascending curve positions (N,), from 0 to N.

    Cells are halved until none has more than ``max_leaves`` leaves. Leaves at equal positions are divided by
    row.
    """
    borders, ahead = [0], [(0, len(codes), 3 * AXIS_BITS)]
    while ahead:
        begin, end, bit = ahead.pop()
        if end - begin <= max_leaves:
            borders.append(end)
            continue
        middle = begin + max_leaves
        if bit:
            bit -= 1
            half = (codes[begin] >> np.uint64(bit) | np.uint64(1)) << np.uint64(bit)
            middle = begin + int(np.searchsorted(codes[begin:end], half))
        ahead += [part for part in ((middle, end, bit), (begin, middle, bit)) if part[0] < part[1]]
    return borders


def _drop_extras(splats: Splats) -> Splats:
    return replace(splats, extras={})


def _build_cell(leaves: Splats, by_error: bool) -> tuple[Splats, Tree, np.ndarray]:
    """Build the tree over splats in spatial order; return nodes, tree and the root's moments (14,)."""
    means, covariances, depths = splat_moments(leaves)
    colors = 0.5 + SH_C0 * leaves.sh[:, 0].astype(np.float64)
    no_errors = np.zeros((len(leaves), 1))
    moments = np.concatenate([means, covariances, depths[:, None], colors, no_errors], axis=1)
    above, tree = _merge_to_root(moments, by_error)
    if by_error:
        leaves.extras = {NODE_SIZE: np.zeros(len(leaves), np.float32)}
    nodes = Splats.concatenated([leaves, _node_splats(above, tree, leaves.sh, depths, by_error)])
    return nodes, tree, (above if len(above) else moments)[-1].copy()


def _merge_to_root(moments: np.ndarray, by_error: bool) -> tuple[np.ndarray, Tree]:
    """Merge N splats in spatial order up to a root.

    Args:
        moments: (N, 14), overwritten.

    Returns:
        The moments (N - 1, 14) of the inner nodes, and the tree.
    """
    leaves = len(moments)
    numbers = np.arange(leaves, dtype=np.int32)
    nodes, children = [np.empty((0, moments.shape[1]))], [np.empty((0, 2), np.int32)]
    best = np.zeros(leaves, np.int32)
    while len(moments) > 1:
        count = len(moments)
        if by_error:
            first, second = merging.cheapest_pairs(moments[:, :ERROR], count)
        else:
            run_parallel(_choose_partners, count, 1 << 12, moments, RADIUS, COLOR_WEIGHT, best)
            first, second = _mutual_pairs(best[:count])
        merged = merge_pairs(moments[first], moments[second])
        if by_error:
            pair_errors = np.maximum(merging.merge_errors(moments[:, :ERROR], first, second), MIN_ERROR)
            merged[:, ERROR] = moments[first, ERROR] + moments[second, ERROR] + pair_errors
        children.append(np.stack([numbers[first], numbers[second]], axis=1))
        remaining = np.ones(count, bool)
        remaining[second] = False
        numbers[first] = leaves + sum(map(len, nodes)) + np.arange(len(first))
        nodes.append(merged)
        moments[first] = merged
        moments, numbers = moments[remaining], numbers[remaining]
    return np.concatenate(nodes), Tree(np.concatenate(children))


@inlined(STRICT)
def _merged_area(first, second):
    """Return the square root of the merged covariance's second invariant; s1 s2 for a flat splat."""
    share = first[9] / (first[9] + second[9])
    other_share, product = 1 - share, share * (1 - share)
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    xx = share * first[3] + other_share * second[3] + product * x * x
    xy = share * first[4] + other_share * second[4] + product * x * y
    xz = share * first[5] + other_share * second[5] + product * x * z
    yy = share * first[6] + other_share * second[6] + product * y * y
    yz = share * first[7] + other_share * second[7] + product * y * z
    zz = share * first[8] + other_share * second[8] + product * z * z
    return np.sqrt(max(xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz, 0.0))


@kernel(STRICT)
def _choose_partners(begin, end, moments, radius, color, best):
    """Choose the partner of least cost for each row; ties go to the least exclusive or."""
    for i in range(begin, end):
        min_cost, chosen = np.inf, -1
        for j in range(max(i - radius, 0), min(i + radius + 1, len(moments))):
            if j != i:
                first, second = moments[min(i, j)], moments[max(i, j)]  # the same result from either side
                red, green, blue = first[10] - second[10], first[11] - second[11], first[12] - second[12]
                unlike = red * red + green * green + blue * blue
                cost = _merged_area(first, second) * (1 + color * unlike)
                if cost < min_cost or chosen < 0 or (cost == min_cost and (i ^ j) < (i ^ chosen)):
                    min_cost, chosen = cost, j
        best[i] = chosen


def _mutual_pairs(best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (M,) and their larger partners (M,) that chose each other; at least one pair."""
    rows = np.arange(len(best), dtype=np.int32)
    mutual = best[best] == rows
    if mutual.sum() < MIN_PAIRED_SHARE * len(best):  # chains: each one chooses the next
        free = rows[~mutual]
        free = free[: len(free) // 2 * 2]
        best[free[0::2]], best[free[1::2]] = free[1::2], free[0::2]
        mutual[free] = True
    first = np.flatnonzero(mutual & (rows < best)).astype(np.int32)
    return first, best[first]


def _node_splats(
    moments: np.ndarray, tree: Tree, sh: np.ndarray, depths: np.ndarray, by_error: bool
) -> Splats:
    """Return the splats (M,) of inner nodes with these moments (M, 14)."""
    spread = merging.MAX_SPREAD if by_error else MAX_SPREAD
    quats, log_scales, logits = shapes_of_moments(moments, spread)
    harmonics = np.empty((len(moments), *sh.shape[1:]), np.float32)
    depths = np.concatenate([depths, moments[:, 9]])
    for layer in reversed(tree.layers):
        below = tree.children[layer - tree.leaves]
        rate_factors = (depths[below] / depths[layer, None]).astype(np.float32)
        of_leaf = below < tree.leaves
        parts = np.where(
            of_leaf[..., None, None],
            sh[np.where(of_leaf, below, 0)],
            harmonics[np.where(of_leaf, 0, below - tree.leaves)],
        )
        harmonics[layer - tree.leaves] = (rate_factors[..., None, None] * parts).sum(axis=1)
    means = moments[:, :3].astype(np.float32)
    sizes = (ERROR_SCALE * np.sqrt(moments[:, ERROR])).astype(np.float32)
    extras = {NODE_SIZE: sizes} if by_error else {}
    return Splats(means, quats, log_scales, logits, harmonics, extras)
