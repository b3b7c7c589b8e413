"""Cuts of a large tree of splats for one camera after another: the hierarchical sequential point tree.

A LoD of Gaussians, Sec. 4.1 and 4.3: the upper tree is walked from the root down, and what is out of the
image is left out with all below it; the subtrees under it are lists, of which a binary search finds the part
to look at. The nodes found are those of the rule ``cut`` (``lod.rules.cut``), to the bit. In the paper a list
is cut by the distance of its root alone, finer than asked for behind it and, without M_d, coarser before it.
"""

from __future__ import annotations

import math

import numpy as np

from ..lod.blocks import PIXELS, REACH, SLANT
from ..lod.forest import longest_of, shape_of
from ..lod.rules.cut import detail_of
from ..lod.tree import Tree
from ..scenes.cameras import Camera
from .cpu.compile import STRICT, at_once, f32, in_parallel, inlined, kernel

SLACK = 1e-5
"""Share by which single precision may get distances and sizes wrong, and more."""
_GRAIN = 8
"""Lists that a thread takes at a time."""


class Upper:
    """The upper tree with the roots of the lists, which is walked.

    Args:
        tree: of G leaves, each the root of a list.
        balls: (2G - 1, 4) float32, means and sizes.
        boxes: (2G - 1, 7) float64 of all that is at or below each: the middle and half the extent of the
            means, and how far the largest splat reaches from its mean.
    """

    def __init__(self, tree: Tree, balls: np.ndarray, boxes: np.ndarray) -> None:
        self.balls, self.boxes = balls, boxes
        self._children = np.concatenate([np.full((tree.leaves, 2), -1, np.int32), tree.children])

    @classmethod
    def over(
        cls, tree: Tree, means: np.ndarray, log_scales: np.ndarray, sizes: np.ndarray, bounds: Bounds
    ) -> Upper:
        """That of a tree, (2G - 1, ...) of each node, whose leaves have bounds, (G, ...)."""
        own = zip(bounds, bounds_of(means, log_scales), strict=True)
        low, high, reach = (np.append(below, each[tree.leaves :], axis=0) for below, each in own)
        for layer in reversed(tree.layers):
            one, other = tree.children[layer - tree.leaves].T
            for bound, extreme in ((low, np.minimum), (high, np.maximum), (reach, np.maximum)):
                bound[layer] = extreme(bound[layer], extreme(bound[one], bound[other]))
        least, most = low.astype(np.float64), high.astype(np.float64)
        boxes = np.concatenate([(least + most) / 2, (most - least) / 2, reach[:, None]], axis=1)
        return cls(tree, np.concatenate([means, sizes[:, None]], axis=1), boxes)

    def walk(self, eye: np.ndarray, k: float, image: np.ndarray | None) -> tuple[np.ndarray, ...]:
        """What is fine enough, and where a list has to be looked at.

        Args:
            eye: (3,).
            k: the detail.
            image: as of :func:`image_of`; None: nothing is left out.

        Returns:
            Nodes to draw, (M,) int32, those below G roots of lists; lists, (L,) int32, and of each the least
            size, (L,) float64, that a node in it has which is not fine enough.
        """
        image = np.zeros((0, 6)) if image is None else image
        nodes, lists = np.empty((2, len(self.balls)), np.int32)
        least, counts = np.empty(len(self.balls)), np.zeros(2, np.int64)
        arrays = self._children, self.balls, self.boxes, np.asarray(eye, np.float32), f32(k), image
        at_once(_walk, *arrays, nodes, lists, least, counts)
        return nodes[: counts[0]], lists[: counts[1]], least[: counts[1]]


Bounds = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of each of some nodes: the least and the greatest mean, (., 3) float32, and the reach, (.,) float32."""


def bounds_of(means: np.ndarray, log_scales: np.ndarray, begins: np.ndarray | None = None) -> Bounds:
    """Of nodes (N, 3) themselves, or of all from each of ``begins`` (G,) to the next."""
    reach = (REACH * np.exp(np.minimum(log_scales.max(axis=1), 60))).astype(np.float32)
    if begins is None:
        return means, means, reach
    least, most = np.minimum.reduceat(means, begins, axis=0), np.maximum.reduceat(means, begins, axis=0)
    return least, most, np.maximum.reduceat(reach, begins)


class Hspt:
    """The nodes of a tree, ready to be cut.

    Args:
        tree: of N leaves.
        means: (2N - 1, 3) float32 of all nodes.
        sizes: (2N - 1,) float32, saturated (``Tree.sizes``).
        log_scales: (2N - 1, 3) float32.
        longest: most leaves below the root of a list; 0: half the square root of the number of nodes, so
            that the upper tree and a list are about as long.

    Attributes:
        lists: how many there are.
    """

    def __init__(
        self, tree: Tree, means: np.ndarray, sizes: np.ndarray, log_scales: np.ndarray, longest: int = 0
    ) -> None:
        order, forest = shape_of(tree, longest or longest_of(tree.leaves))
        names = self._names = order[forest.in_upper]
        inside = order[: forest.ends[-1]]
        bounds = bounds_of(means[inside], log_scales[inside], forest.begins)
        self._upper = Upper.over(forest.upper, means[names], log_scales[names], sizes[names], bounds)
        self.lists, self._forest = len(forest.counts), forest
        of_list = np.repeat(np.arange(self.lists, dtype=np.int32), 2 * forest.counts - 1)
        above = inside >= tree.leaves
        entries = inside[above][np.lexsort((-sizes[inside[above]], of_list[above]))]
        balls = np.concatenate([means, sizes[:, None]], axis=1)
        pairs = tree.children[entries - tree.leaves]
        families = np.concatenate([balls[entries], balls[pairs].reshape(-1, 8)], axis=1)
        self._lists = pairs, families

    def cut(self, camera: Camera, pixels: float, near: float = 0.01) -> np.ndarray:
        """The nodes (M,) int32 to draw for a camera, but for those that are out of its image; in any order.

        Args:
            pixels: the rule's control.
            near: depth at which drawing begins, in world units.
        """
        return self.cut_at(camera.center, detail_of(camera.focal, pixels), image_of(camera, near))

    def cut_at(self, eye: np.ndarray, k: float, image: np.ndarray | None = None) -> np.ndarray:
        """The same for an eye (3,) and a detail k.

        Args:
            image: as of :func:`image_of`; None: nothing is left out.
        """
        nodes, lists, least = self._upper.walk(eye, k, image)
        begins, ends = self._forest.list_begins[lists], self._forest.list_ends[lists]
        ends = cut_off(self._lists[1][:, 3], begins, ends, least)
        found, _ = search(*self._lists, begins, ends, eye, k)
        return np.append(self._names[nodes], found)


def cut_off(sizes: np.ndarray, begins: np.ndarray, ends: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Where lists come to sizes below their least, (L,) int64.

    Args:
        sizes: (E,) float32, falling from each list's begin, (L,) int64, to its end, (L,).
        least: (L,) float64.
    """
    found = np.empty_like(begins)
    at_once(_cut_off, sizes, begins, ends, least, found)
    return found


def search(
    pairs: np.ndarray, families: np.ndarray, begins: np.ndarray, ends: np.ndarray, eye: np.ndarray, k: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of parts of lists, the children that are fine enough of nodes that are not (Eq. 5).

    Args:
        pairs: (E, 2) int32, the children of each node of the lists.
        families: (E, 12) float32, mean and size of each node and of its children.
        begins, ends: (L,) int64 of the parts, among the E.
        eye: (3,).
        k: the detail.

    Returns:
        Nodes (M,) int32, one part's after the other's; and how many are of each, (L,) int64.
    """
    lengths = ends - begins
    parts = np.stack([begins, ends, 2 * (np.cumsum(lengths) - lengths), np.zeros_like(begins)], axis=1)
    buffer = np.empty(2 * int(lengths.sum()), np.int32)
    eye = np.asarray(eye, np.float32)
    in_parallel(_search, len(parts), _GRAIN, pairs, families, eye, f32(k), parts, buffer)
    found = np.empty(int(parts[:, 3].sum()), np.int32)
    at_once(_gather, parts, buffer, found)
    return found, parts[:, 3]


def image_of(camera: Camera, near: float) -> np.ndarray:
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
def _fine(balls, i, first, eye, k):
    """``lod.rules.cut.acceptable`` of the node whose mean and size begin at ``first``, bit for bit."""
    x, y, z = balls[i, first] - eye[0], balls[i, first + 1] - eye[1], balls[i, first + 2] - eye[2]
    return np.sqrt(x * x + y * y + z * z) >= k * balls[i, first + 3]


@inlined(STRICT)
def _in_image(box, image):
    depth = 0.0
    for i in range(len(image)):
        row = image[i]
        away, room = row[3], 0.0
        for axis in range(3):
            away += row[axis] * box[axis]
            room += abs(row[axis]) * box[3 + axis]
        if i == 0:
            depth = max(room - away + row[5], 0.0)
        else:
            room += row[4] * box[6] + row[5] * depth
        if away > room:
            return False
    return True


@inlined(STRICT)
def _distance(box, eye):
    """From an eye to a box, 0 within."""
    squares = 0.0
    for axis in range(3):
        away = max(abs(np.float64(eye[axis]) - box[axis]) - box[3 + axis], 0.0)
        squares += away * away
    return np.sqrt(squares)


@kernel(STRICT)
def _walk(children, balls, boxes, eye, k, image, nodes, lists, least, counts):
    """From the root, which is the last, down the upper tree: nodes to draw, and lists to look at."""
    count, used, top = 0, 0, 1
    stack = np.empty(len(children) + 1, np.int32)
    stack[0] = len(children) - 1
    while top:
        top -= 1
        i = stack[top]
        if not _in_image(boxes[i], image):
            continue
        if _fine(balls, i, 0, eye, k):
            nodes[count] = i
            count += 1
        elif children[i, 0] >= 0:
            stack[top], stack[top + 1] = children[i, 1], children[i, 0]
            top += 2
        else:
            lists[used], least[used] = i, _distance(boxes[i], eye) * (1 - SLACK) / k
            used += 1
    counts[0], counts[1] = count, used


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
def _search(begin, end, pairs, families, eye, k, parts, buffer):
    """Of parts of lists, the children that are fine enough of nodes that are not (Eq. 5)."""
    for part in range(begin, end):
        first = parts[part, 2]
        place = first
        for i in range(parts[part, 0], parts[part, 1]):
            if not _fine(families, i, 0, eye, k):
                if _fine(families, i, 4, eye, k):
                    buffer[place] = pairs[i, 0]
                    place += 1
                if _fine(families, i, 8, eye, k):
                    buffer[place] = pairs[i, 1]
                    place += 1
        parts[part, 3] = place - first


@kernel(STRICT)
def _gather(parts, buffer, found):
    place = 0
    for part in range(len(parts)):
        first, count = parts[part, 2], parts[part, 3]
        found[place : place + count] = buffer[first : first + count]
        place += count
