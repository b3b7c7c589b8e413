"""Hierarchical sequential point tree (HSPT): fast cuts of a large splat tree for many cameras.

A LoD of Gaussians, Sec. 4.1 and 4.3. The upper tree is traversed from the root, and subtrees outside the
image are culled. The subtrees below the upper tree are lists sorted by size, which are scanned from the
largest node to the first position from which all nodes are fine enough. The cut is bit-identical to that of
the rule ``cut`` (``lod.rules.cut``). The paper instead cuts a list by the distance of its root only. This is
finer than required for nodes behind the root and, without M_d, coarser for nodes in front of it.
"""

from __future__ import annotations

import math

import numpy as np

from ...lod.blocks import PIXELS, REACH, SLANT
from ...lod.tree.shape import Tree
from ...rasterize.cpu.compile import STRICT, Buffers, f32, inlined, kernel, run_parallel, run_serial
from ...scenes.cameras import Camera

SLACK = 1e-5
"""Upper bound of the relative rounding errors of distances and sizes in single precision."""
LEAF = 1 << 24
"""Rank of leaves, which are not stored in lists; it is larger than all other ranks."""
_GRAIN = 128
"""Lists in a thread's unit of work."""
_NO_NODES = np.empty(0, np.int32)


class UpperTree:
    """Upper tree, whose leaves are the roots of the lists.

    Args:
        tree: tree of G leaves; every leaf is the root of a list.
        balls: (2G - 1, 4) float32, means and sizes.
        boxes: (2G - 1, 7) float64, bounds of each node's subtree: centre and half the extent of the means,
            and the largest reach of a splat from its mean.
    """

    def __init__(self, tree: Tree, balls: np.ndarray, boxes: np.ndarray) -> None:
        self.balls = balls
        self.boxes = boxes
        order, subtree_end = _preorder(tree)
        self._arrays = order, subtree_end, order < tree.leaves, balls[order], boxes[order]

    @classmethod
    def from_bounds(
        cls, tree: Tree, means: np.ndarray, log_scales: np.ndarray, sizes: np.ndarray, bounds: Bounds
    ) -> UpperTree:
        """Create it from arrays (2G - 1, ...) of all nodes, and bounds (G, ...) of the lists at its
        leaves."""
        own = zip(bounds, node_bounds(means, log_scales), strict=True)
        low, high, reach = (np.append(lists, nodes[tree.leaves :], axis=0) for lists, nodes in own)
        for layer in reversed(tree.layers):
            first, second = tree.children[layer - tree.leaves].T
            for bound, extreme in ((low, np.minimum), (high, np.maximum), (reach, np.maximum)):
                bound[layer] = extreme(bound[layer], extreme(bound[first], bound[second]))
        low = low.astype(np.float64)
        high = high.astype(np.float64)
        boxes = np.concatenate([(low + high) / 2, (high - low) / 2, reach[:, None]], axis=1)
        return cls(tree, np.concatenate([means, sizes[:, None]], axis=1), boxes)

    def traverse(
        self, position: np.ndarray, k: float, borders: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the nodes that are fine enough, and the lists to search.

        Args:
            position: (3,) camera position.
            k: level of detail.
            borders: see :func:`image_borders`; None disables culling.

        Returns:
            Nodes to draw, (M,) int32, where nodes below G are roots of lists; lists to search, (L,) int32, in
            spatial order; and size ranges (L, 2) float32: nodes smaller than the first size are fine enough,
            and nodes larger than the second are not.
        """
        borders = np.zeros((0, 6)) if borders is None else borders
        nodes, lists = np.empty((2, len(self.balls)), np.int32)
        bands, counts = np.empty((len(self.balls), 2), np.float32), np.zeros(2, np.int64)
        run_serial(
            _traverse,
            *self._arrays,
            np.asarray(position, np.float32),
            f32(k),
            borders,
            nodes,
            lists,
            bands,
            counts,
        )
        return nodes[: counts[0]], lists[: counts[1]], bands[: counts[1]]


def _preorder(tree: Tree) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (2G - 1,) int32 in preorder, and the end (2G - 1,) int32 of each node's subtree in it.

    Siblings are in the order of their leaves.
    """
    leaves = tree.leaves
    count = len(tree)
    sizes = np.ones(count, np.int32)
    first_leaf = np.arange(count)
    for layer in reversed(tree.layers):
        children = tree.children[layer - leaves]
        sizes[layer] += sizes[children].sum(axis=1)
        first_leaf[layer] = first_leaf[children].min(axis=1)
    place = np.zeros(count, np.int32)
    for layer in tree.layers:
        a, b = tree.children[layer - leaves].T
        first, second = np.where(first_leaf[a] < first_leaf[b], [a, b], [b, a])
        place[first] = place[layer] + 1
        place[second] = place[first] + sizes[first]
    order = np.empty(count, np.int32)
    order[place] = np.arange(count, dtype=np.int32)
    return order, place[order] + sizes[order]


Bounds = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Minimum and maximum of the means (n, 3) float32, and maximum reach (n,) float32."""


def node_bounds(means: np.ndarray, log_scales: np.ndarray, begins: np.ndarray | None = None) -> Bounds:
    """Return the bounds of N nodes, or of the groups of nodes that begin at ``begins`` (G,)."""
    reach = (REACH * np.exp(np.minimum(log_scales.max(axis=1), 60))).astype(np.float32)
    if begins is None:
        return means, means, reach
    low = np.minimum.reduceat(means, begins, axis=0)
    high = np.maximum.reduceat(means, begins, axis=0)
    return low, high, np.maximum.reduceat(reach, begins)


def first_below(sizes: np.ndarray, begins: np.ndarray, ends: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the first position (L,) int64 in each list whose size is below the list's limit.

    Args:
        sizes: (E,) float32, descending from each list's begin, (L,) int64, to its end, (L,).
        limits: (L,) float64.
    """
    positions = np.empty_like(begins)
    run_serial(_first_below, sizes, begins, ends, limits, positions)
    return positions


def search_lists(
    links: np.ndarray,
    balls: np.ndarray,
    borders: np.ndarray,
    lists: np.ndarray,
    bands: np.ndarray,
    position: np.ndarray,
    k: float,
    prefix: np.ndarray = _NO_NODES,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nodes of lists that are fine enough and whose parents are not (Eq. 5).

    The roots of the lists must not be fine enough.

    Args:
        links: (E, 4) int32, two children of each node and their ranks, which are positions in the list or
            LEAF.
        balls: (E, 4) float32, mean and size, which descends within a list. Access is fastest if ``links`` and
            ``balls`` are adjacent in memory.
        borders: (G + 1,) int64, begin of each list, or of its first part, and the end of the last list.
        lists: (L,), indices of the lists to search.
        bands: (L, 2), size ranges of ``UpperTree.traverse``.
        position: (3,) camera position.
        k: level of detail.
        prefix: nodes to put in front of the result.

    Returns:
        Nodes (M,) int32, list after list; and their number in each list, (L,) int64.
    """
    longest = int(np.diff(borders).max(initial=0))
    buffers = Buffers()
    cut = buffers.take("cut", np.int32, 2 * longest * len(lists))
    counts = np.empty(len(lists), np.int64)
    criterion = np.asarray(position, np.float32), f32(k), longest
    run_parallel(_search, len(lists), _GRAIN, links, balls, borders, lists, bands, *criterion, cut, counts)
    chunks = range(0, len(lists), _GRAIN)
    sums = np.add.reduceat(counts, chunks) if chunks else chunks
    places = (2 * longest * chunk for chunk in chunks)
    parts = [cut[place : place + count] for place, count in zip(places, sums, strict=True)]
    return np.concatenate([prefix, *parts]), counts


def image_borders(camera: Camera, near: float) -> np.ndarray:
    """Return the frustum planes (5, 6) float64 for culling boxes, one row per border of the image.

    The test is that of ``lod.blocks.Blocks.in_view``. A row is (n, c, s, p), and a box is outside if
    n · centre + c > |n| · half + s reach + p depth, where depth is the depth of the box's far end. The first
    row is the near plane and has the near depth as p.
    """
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    rows = [(*-turn[2], near - shift[2], 0.0, near)]
    for axis, focal, low, high in (
        (0, camera.fx, -camera.cx, camera.width - camera.cx),
        (1, camera.fy, -camera.cy, camera.height - camera.cy),
    ):
        for sign, border in ((1, high / focal), (-1, -low / focal)):
            normal, offset = (sign * part[axis] - border * part[2] for part in (turn, shift))
            rows.append((*normal, offset, math.hypot(1, SLANT * border), PIXELS / focal))
    return np.array(rows)


@inlined(STRICT)
def _is_fine(balls, i, position, k):
    """Compute ``lod.tree.nodes.is_fine_enough`` of a node, bit for bit."""
    x, y, z = balls[i, 0] - position[0], balls[i, 1] - position[1], balls[i, 2] - position[2]
    return np.sqrt(x * x + y * y + z * z) >= k * balls[i, 3]


@kernel(STRICT)
def _traverse(order, subtree_end, is_list, balls, boxes, position, k, borders, nodes, lists, bands, counts):
    """Traverse the upper tree from the root; fill nodes to draw and lists to search.

    Borders that contain a whole box are not tested again for its subtree. ``pending`` is a stack of bit masks
    of borders to test, and each mask is valid until position ``valid_until``.
    """
    count, used, top, i = 0, 0, 0, 0
    valid_until, pending = np.empty(len(order) + 1, np.int32), np.empty(len(order) + 1, np.int32)
    valid_until[0], pending[0] = len(order), (1 << len(borders)) - 1
    while i < len(order):
        while i >= valid_until[top]:
            top -= 1
        crossed = pending[top]
        if crossed:
            crossed = _crossed_borders(boxes[i], borders, crossed)
            if crossed < 0:
                i = subtree_end[i]
                continue
            if crossed != pending[top] and not is_list[i]:
                top += 1
                valid_until[top], pending[top] = subtree_end[i], crossed
        if _is_fine(balls, i, position, k):
            nodes[count] = order[i]
            count += 1
            i = subtree_end[i]
            continue
        if is_list[i]:
            near, far = 0.0, 0.0
            for axis in range(3):
                away, half = abs(np.float64(position[axis]) - boxes[i, axis]), boxes[i, 3 + axis]
                near += max(away - half, 0.0) ** 2
                far += (away + half) ** 2
            lists[used] = order[i]
            bands[used, 0] = f32(np.sqrt(near) * (1 - SLACK) / k)
            bands[used, 1] = f32(np.sqrt(far) * (1 + SLACK) / k)
            used += 1
        i += 1
    counts[0], counts[1] = count, used


@inlined(STRICT)
def _crossed_borders(box, borders, pending):
    """Return the bit mask of the pending borders that a box crosses; -1 if it is outside one of them."""
    x, y, z = box[0], box[1], box[2]
    a, b, c = box[3], box[4], box[5]
    ahead = borders[0, 0] * x + borders[0, 1] * y + borders[0, 2] * z + borders[0, 3]
    across = abs(borders[0, 0]) * a + abs(borders[0, 1]) * b + abs(borders[0, 2]) * c
    depth = max(across - ahead + borders[0, 5], 0.0)
    crossed = pending
    for i in range(len(borders)):
        if (pending >> i) & 1:
            row = borders[i]
            away = row[0] * x + row[1] * y + row[2] * z + row[3]
            half = abs(row[0]) * a + abs(row[1]) * b + abs(row[2]) * c
            if away > half + (row[4] * box[6] + row[5] * depth if i else 0.0):
                return -1
            if away < -half:
                crossed &= ~(1 << i)
    return crossed


@kernel(STRICT)
def _first_below(sizes, begins, ends, limits, positions):
    for i in range(len(begins)):
        low, high = begins[i], ends[i]
        while low < high:
            middle = (low + high) // 2
            if sizes[middle] >= limits[i]:
                low = middle + 1
            else:
                high = middle
        positions[i] = low


@kernel(STRICT)
def _search(begin, end, links, balls, borders, lists, bands, position, k, longest, cut, counts):
    """Find the nodes of lists that are fine enough and whose parents are not (Eq. 5).

    For most nodes, sizes are enough to decide. Parents precede their children, so undecided nodes are queued
    at their ranks. The inner loops have no unpredictable branches: every child is written, and
    overwritten by the next node if it is not part of the cut. Indices are unsigned, because signed indices
    require a test for negative values.
    """
    queue, leaf = np.empty(longest + 1, np.int32), np.uint32(longest)  # the entry of leaves is not read
    place, step = np.uint64(2 * longest * begin), np.uint64(1)
    for part in range(begin, end):
        start, first, last = place, np.uint64(borders[lists[part]]), np.uint64(borders[lists[part] + 1])
        low, high = bands[part, 0], bands[part, 1]
        coarse_end = first
        while coarse_end < last and balls[coarse_end, 3] > high:
            coarse_end += step
        fine_start = coarse_end
        while fine_start < last and balls[fine_start, 3] >= low:
            queue[fine_start - first] = -1
            fine_start += step
        ranks = np.uint32(fine_start - first)
        for i in range(first, coarse_end):
            place = _refine(links, i, ranks, leaf, queue, cut, place)
        for i in range(coarse_end, fine_start):
            if _is_fine(balls, i, position, k):
                cut[place] = queue[i - first]
                place += np.uint64(queue[i - first] >= 0)
            else:
                place = _refine(links, i, ranks, leaf, queue, cut, place)
        counts[part] = place - start


@inlined(STRICT)
def _refine(links, i, ranks, leaf, queue, cut, place):
    """Replace a node by its children: add those with rank >= ``ranks`` to the cut, and queue the others."""
    for child in range(2):
        node, rank = links[i, child], np.uint32(links[i, 2 + child])
        cut[place] = node
        place += np.uint64(rank >= ranks)
        queue[min(rank, leaf)] = node
    return place
