"""Cuts of a large tree of splats for one camera after another: the hierarchical sequential point tree.

A LoD of Gaussians, Sec. 4.1 and 4.3: the upper tree is walked from the root down, and what is out of the
image is left out with all below it; the subtrees under it are lists by size, which are looked at from the
largest node down to where all are fine enough. The nodes found are those of the rule ``cut``
(``lod.rules.cut``), to the bit. In the paper a list is cut by the distance of its root alone, finer than
asked for behind it and, without M_d, coarser before it.
"""

from __future__ import annotations

import math

import numpy as np

from ..lod.blocks import PIXELS, REACH, SLANT
from ..lod.rules.cut import detail_of
from ..lod.tree.forest import forest_shape
from ..lod.tree.shape import Tree
from ..scenes.cameras import Camera
from .cpu.compile import STRICT, Buffers, f32, inlined, kernel, run_parallel, run_serial

SLACK = 1e-5
"""Share by which single precision may get distances and sizes wrong, and more."""
LEAF = 1 << 24
"""Rank of leaves in lists, which they are not in: after all others."""
_GRAIN = 128
"""Lists that a thread takes at a time."""
_NONE = np.empty(0, np.int32)


class UpperTree:
    """The upper tree with the roots of the lists, which is walked.

    Args:
        tree: of G leaves, each the root of a list.
        balls: (2G - 1, 4) float32, means and sizes.
        boxes: (2G - 1, 7) float64 of all that is at or below each: the middle and half the extent of the
            means, and how far the largest splat reaches from its mean.
    """

    def __init__(self, tree: Tree, balls: np.ndarray, boxes: np.ndarray) -> None:
        self.balls, self.boxes = balls, boxes
        order, beyond = _preorder(tree)
        self._walked = order, beyond, order < tree.leaves, balls[order], boxes[order]

    @classmethod
    def from_bounds(
        cls, tree: Tree, means: np.ndarray, log_scales: np.ndarray, sizes: np.ndarray, bounds: Bounds
    ) -> UpperTree:
        """That of a tree, (2G - 1, ...) of each node, whose leaves have bounds, (G, ...)."""
        own = zip(bounds, node_bounds(means, log_scales), strict=True)
        low, high, reach = (np.append(below, each[tree.leaves :], axis=0) for below, each in own)
        for layer in reversed(tree.layers):
            one, other = tree.children[layer - tree.leaves].T
            for bound, extreme in ((low, np.minimum), (high, np.maximum), (reach, np.maximum)):
                bound[layer] = extreme(bound[layer], extreme(bound[one], bound[other]))
        least, most = low.astype(np.float64), high.astype(np.float64)
        boxes = np.concatenate([(least + most) / 2, (most - least) / 2, reach[:, None]], axis=1)
        return cls(tree, np.concatenate([means, sizes[:, None]], axis=1), boxes)

    def traverse(self, eye: np.ndarray, k: float, image: np.ndarray | None) -> tuple[np.ndarray, ...]:
        """What is fine enough, and where a list has to be looked at.

        Args:
            eye: (3,).
            k: the detail.
            image: as of :func:`image_borders`; None: nothing is left out.

        Returns:
            Nodes to draw, (M,) int32, those below G roots of lists; lists, (L,) int32, neighbours together;
            and of each, (L, 2) float32, two sizes: a node in it that is smaller than the first is fine
            enough, and one that is larger than the second is not.
        """
        image = np.zeros((0, 6)) if image is None else image
        nodes, lists = np.empty((2, len(self.balls)), np.int32)
        bands, counts = np.empty((len(self.balls), 2), np.float32), np.zeros(2, np.int64)
        run_serial(
            _walk, *self._walked, np.asarray(eye, np.float32), f32(k), image, nodes, lists, bands, counts
        )
        return nodes[: counts[0]], lists[: counts[1]], bands[: counts[1]]


def _preorder(tree: Tree) -> tuple[np.ndarray, np.ndarray]:
    """The nodes (2G - 1,) int32 from the root, each before those below it and these in the order of leaves;
    and where (2G - 1,) int32 in this order what is below each has an end."""
    leaves, count = tree.leaves, len(tree)
    many, first = np.ones(count, np.int32), np.arange(count)
    for layer in reversed(tree.layers):
        below = tree.children[layer - leaves]
        many[layer] += many[below].sum(axis=1)
        first[layer] = first[below].min(axis=1)
    place = np.zeros(count, np.int32)
    for layer in tree.layers:
        one, other = tree.children[layer - leaves].T
        one, other = np.where(first[one] < first[other], [one, other], [other, one])
        place[one] = place[layer] + 1
        place[other] = place[one] + many[one]
    order = np.empty(count, np.int32)
    order[place] = np.arange(count, dtype=np.int32)
    return order, place[order] + many[order]


Bounds = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of each of some nodes: the least and the greatest mean, (., 3) float32, and the reach, (.,) float32."""


def node_bounds(means: np.ndarray, log_scales: np.ndarray, begins: np.ndarray | None = None) -> Bounds:
    """Of nodes (N, 3) themselves, or of all from each of ``begins`` (G,) to the next."""
    reach = (REACH * np.exp(np.minimum(log_scales.max(axis=1), 60))).astype(np.float32)
    if begins is None:
        return means, means, reach
    least, most = np.minimum.reduceat(means, begins, axis=0), np.maximum.reduceat(means, begins, axis=0)
    return least, most, np.maximum.reduceat(reach, begins)


class SequentialPointTree:
    """The nodes of a tree, ready to be cut.

    Args:
        tree: of N leaves.
        means: (2N - 1, 3) float32 of all nodes.
        sizes: (2N - 1,) float32, saturated (``Tree.sizes``).
        log_scales: (2N - 1, 3) float32.
        longest: most leaves below the root of a list; 0: a sixth of the square root of the number of nodes.
            The longer, the more is found that is out of the image; the shorter, the more is walked.

    Attributes:
        lists: how many there are.
    """

    def __init__(
        self, tree: Tree, means: np.ndarray, sizes: np.ndarray, log_scales: np.ndarray, longest: int = 0
    ) -> None:
        order, forest = forest_shape(tree, longest or max(math.isqrt(len(tree)) // 6, 1))
        names = self._names = order[forest.in_upper]
        inside = order[: forest.ends[-1]]
        bounds = node_bounds(means[inside], log_scales[inside], forest.begins)
        self._upper = UpperTree.from_bounds(
            forest.upper, means[names], log_scales[names], sizes[names], bounds
        )
        self.lists = len(forest.counts)
        above = inside[inside >= tree.leaves]
        of_list = np.repeat(np.arange(self.lists, dtype=np.int32), forest.counts - 1)
        nodes = above[np.lexsort((-sizes[above], of_list))]
        ranks = np.full(len(tree), LEAF, np.int32)
        ranks[nodes] = np.arange(len(nodes)) - np.repeat(forest.list_begins, forest.counts - 1)
        entries = np.empty((len(nodes), 8), np.float32)
        links, balls = entries.view(np.int32)[:, :4], entries[:, 4:]
        self._lists = links, balls, np.append(0, forest.list_ends)
        links[:, :2] = tree.children[nodes - tree.leaves]
        links[:, 2:] = ranks[links[:, :2]]
        balls[:, :3], balls[:, 3] = means[nodes], sizes[nodes]

    def cut(self, camera: Camera, pixels: float, near: float = 0.01) -> np.ndarray:
        """The nodes (M,) int32 to draw for a camera, but for those that are out of its image; in any order.

        Args:
            pixels: the rule's control.
            near: depth at which drawing begins, in world units.
        """
        return self.cut_at(camera.center, detail_of(camera.focal, pixels), image_borders(camera, near))

    def cut_at(self, eye: np.ndarray, k: float, image: np.ndarray | None = None) -> np.ndarray:
        """The same for an eye (3,) and a detail k.

        Args:
            image: as of :func:`image_borders`; None: nothing is left out.
        """
        nodes, lists, bands = self._upper.traverse(eye, k, image)
        found, _ = search_lists(*self._lists, lists, bands, eye, k, self._names[nodes])
        return found


def first_below(sizes: np.ndarray, begins: np.ndarray, ends: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Where lists come to sizes below their least, (L,) int64.

    Args:
        sizes: (E,) float32, falling from each list's begin, (L,) int64, to its end, (L,).
        least: (L,) float64.
    """
    found = np.empty_like(begins)
    run_serial(_cut_off, sizes, begins, ends, least, found)
    return found


def search_lists(
    links: np.ndarray,
    balls: np.ndarray,
    borders: np.ndarray,
    lists: np.ndarray,
    bands: np.ndarray,
    eye: np.ndarray,
    k: float,
    before: np.ndarray = _NONE,
) -> tuple[np.ndarray, np.ndarray]:
    """Of lists whose roots are not fine enough, the nodes that are and whose parents are not (Eq. 5).

    Args:
        links: (E, 4) int32, of each node of the lists its two children, and their ranks: where they are in
            the list, or LEAF.
        balls: (E, 4) float32, mean and size, which falls within a list. Quickest where ``links`` and these
            lie side by side in memory.
        borders: (G + 1,) int64, where each list, or its first part, begins, and the last one's end.
        lists: (L,), which of these.
        bands: (L, 2) as ``UpperTree.traverse`` says them.
        eye: (3,).
        k: the detail.
        before: nodes to begin with.

    Returns:
        Nodes (M,) int32, one list's after the other's; and how many are of each list, (L,) int64.
    """
    longest = int(np.diff(borders).max(initial=0))
    buffers = Buffers()
    found = buffers.take("cut", np.int32, 2 * longest * len(lists))
    counts = np.empty(len(lists), np.int64)
    asked = np.asarray(eye, np.float32), f32(k), longest
    run_parallel(_search, len(lists), _GRAIN, links, balls, borders, lists, bands, *asked, found, counts)
    chunks = range(0, len(lists), _GRAIN)
    sums = np.add.reduceat(counts, chunks) if chunks else chunks
    places = (2 * longest * chunk for chunk in chunks)
    parts = [found[place : place + count] for place, count in zip(places, sums, strict=True)]
    return np.concatenate([before, *parts]), counts


def image_borders(camera: Camera, near: float) -> np.ndarray:
    """(5, 6) float64: what ``lod.blocks.Blocks.in_view`` asks, here of a box, one border of the image a row.

    (n, c, s, p): out of the image is where n · middle + c > |n| · half + s reach + p depth, depth that of the
    box's far end. The first row is the near plane, and has the near depth as p.
    """
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    rows = [(*-turn[2], near - shift[2], 0.0, near)]
    for axis, focal, least, most in (
        (0, camera.fx, -camera.cx, camera.width - camera.cx),
        (1, camera.fy, -camera.cy, camera.height - camera.cy),
    ):
        for sign, border in ((1, most / focal), (-1, -least / focal)):
            normal, offset = (sign * part[axis] - border * part[2] for part in (turn, shift))
            rows.append((*normal, offset, math.hypot(1, SLANT * border), PIXELS / focal))
    return np.array(rows)


@inlined(STRICT)
def _fine(balls, i, eye, k):
    """``lod.rules.cut.is_fine_enough`` of a node, bit for bit."""
    x, y, z = balls[i, 0] - eye[0], balls[i, 1] - eye[1], balls[i, 2] - eye[2]
    return np.sqrt(x * x + y * y + z * z) >= k * balls[i, 3]


@kernel(STRICT)
def _walk(order, beyond, is_list, balls, boxes, eye, k, image, nodes, lists, bands, counts):
    """Down the upper tree, from the root: nodes to draw, and lists to look at.

    What is within a border of the image is not asked again below; ``asked`` has a bit for each border that is
    to be, for as long as ``until`` says.
    """
    count, used, top, i = 0, 0, 0, 0
    until, asked = np.empty(len(order) + 1, np.int32), np.empty(len(order) + 1, np.int32)
    until[0], asked[0] = len(order), (1 << len(image)) - 1
    while i < len(order):
        while i >= until[top]:
            top -= 1
        crossed = asked[top]
        if crossed:
            crossed = _borders(boxes[i], image, crossed)
            if crossed < 0:
                i = beyond[i]
                continue
            if crossed != asked[top] and not is_list[i]:
                top += 1
                until[top], asked[top] = beyond[i], crossed
        if _fine(balls, i, eye, k):
            nodes[count] = order[i]
            count += 1
            i = beyond[i]
            continue
        if is_list[i]:
            near, far = 0.0, 0.0
            for axis in range(3):
                away, half = abs(np.float64(eye[axis]) - boxes[i, axis]), boxes[i, 3 + axis]
                near += max(away - half, 0.0) ** 2
                far += (away + half) ** 2
            lists[used] = order[i]
            bands[used, 0] = f32(np.sqrt(near) * (1 - SLACK) / k)
            bands[used, 1] = f32(np.sqrt(far) * (1 + SLACK) / k)
            used += 1
        i += 1
    counts[0], counts[1] = count, used


@inlined(STRICT)
def _borders(box, image, asked):
    """Of the borders that are asked for those that a box crosses; -1 where it is beyond one."""
    x, y, z = box[0], box[1], box[2]
    a, b, c = box[3], box[4], box[5]
    ahead = image[0, 0] * x + image[0, 1] * y + image[0, 2] * z + image[0, 3]
    across = abs(image[0, 0]) * a + abs(image[0, 1]) * b + abs(image[0, 2]) * c
    depth = max(across - ahead + image[0, 5], 0.0)
    crossed = asked
    for i in range(len(image)):
        if (asked >> i) & 1:
            row = image[i]
            away = row[0] * x + row[1] * y + row[2] * z + row[3]
            room = abs(row[0]) * a + abs(row[1]) * b + abs(row[2]) * c
            if away > room + (row[4] * box[6] + row[5] * depth if i else 0.0):
                return -1
            if away < -room:
                crossed &= ~(1 << i)
    return crossed


@kernel(STRICT)
def _cut_off(sizes, begins, ends, least, found):
    for i in range(len(begins)):
        low, high = begins[i], ends[i]
        while low < high:
            middle = (low + high) // 2
            if sizes[middle] >= least[i]:
                low = middle + 1
            else:
                high = middle
        found[i] = low


@kernel(STRICT)
def _search(begin, end, links, balls, borders, lists, bands, eye, k, longest, found, counts):
    """Of lists, the nodes that are fine enough and whose parents are not (Eq. 5).

    Sizes alone decide about most. A parent comes before its children: those whose sizes say nothing wait at
    their ranks until it is their turn. Where there are many, nothing branches that cannot be foreseen: every
    child is written, and the next one over it where it is not wanted. Numbers have no sign, as those that
    have are looked at for whether they count from the end.
    """
    waiting, leaf = np.empty(longest + 1, np.int32), np.uint32(longest)  # what leaves leave there is not read
    place, one = np.uint64(2 * longest * begin), np.uint64(1)
    for part in range(begin, end):
        before, first, last = place, np.uint64(borders[lists[part]]), np.uint64(borders[lists[part] + 1])
        least, most = bands[part, 0], bands[part, 1]
        sure = first
        while sure < last and balls[sure, 3] > most:
            sure += one
        many = sure
        while many < last and balls[many, 3] >= least:
            waiting[many - first] = -1
            many += one
        ranks = np.uint32(many - first)
        for i in range(first, sure):
            place = _hand_down(links, i, ranks, leaf, waiting, found, place)
        for i in range(sure, many):
            if _fine(balls, i, eye, k):
                found[place] = waiting[i - first]
                place += np.uint64(waiting[i - first] >= 0)
            else:
                place = _hand_down(links, i, ranks, leaf, waiting, found, place)
        counts[part] = place - before


@inlined(STRICT)
def _hand_down(links, i, ranks, leaf, waiting, found, place):
    """The children of a node that is not fine enough: those beyond ``ranks`` are found, others wait."""
    for child in range(2):
        node, rank = links[i, child], np.uint32(links[i, 2 + child])
        found[place] = node
        place += np.uint64(rank >= ranks)
        waiting[min(rank, leaf)] = node
    return place
