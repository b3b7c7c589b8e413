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
from ..lod.rules.cut import detail_of
from ..lod.tree import Tree
from ..scenes.cameras import Camera
from .cpu.compile import STRICT, at_once, f32, in_parallel, inlined, kernel

SLACK = 1e-5
"""Share by which single precision may get distances and sizes wrong, and more."""
_GRAIN = 8
"""Lists that a thread takes at a time."""


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
        leaves, count = tree.leaves, len(tree)
        balls = np.concatenate([means, sizes[:, None]], axis=1)
        below, low, high = np.ones(count, np.int32), means.copy(), means.copy()
        reach = (REACH * np.exp(np.minimum(log_scales.max(axis=1), 60))).astype(np.float32)
        for layer in reversed(tree.layers):
            one, other = tree.children[layer - leaves].T
            below[layer] = below[one] + below[other]
            for bound, extreme in ((low, np.minimum), (high, np.maximum), (reach, np.maximum)):
                bound[layer] = extreme(bound[layer], extreme(bound[one], bound[other]))
        in_lists = below <= (longest or max(math.isqrt(count) // 2, 1))
        # what is walked: the upper tree, and the roots of lists, whose children are in the lists
        root = tree.parents < 0
        walked = np.flatnonzero(~in_lists | root | ~in_lists[tree.parents]).astype(np.int32)[::-1]
        place = np.full(count, -1, np.int32)
        place[walked] = np.arange(len(walked), dtype=np.int32)
        children = np.full((len(walked), 2), -1, np.int32)
        upper = ~in_lists[walked]
        children[upper] = place[tree.children[walked[upper] - leaves]]
        roots = np.flatnonzero(~upper & (walked >= leaves)).astype(np.int32)
        of_list = np.full(count, -1, np.int32)
        of_list[walked[roots]] = np.arange(len(roots), dtype=np.int32)
        for layer in tree.layers:
            inside = layer[of_list[layer] >= 0]
            of_list[tree.children[inside - leaves]] = of_list[inside][:, None]
        entries = leaves + np.flatnonzero(of_list[leaves:] >= 0)
        entries = entries[np.lexsort((-sizes[entries], of_list[entries]))].astype(np.int32)
        counts = np.bincount(of_list[entries], minlength=len(roots))
        begins = np.full(len(walked), -1, np.int64)
        ends = begins.copy()
        ends[roots] = np.cumsum(counts)
        begins[roots] = ends[roots] - counts
        self.lists = len(roots)
        least, most = low[walked].astype(np.float64), high[walked].astype(np.float64)
        boxes = np.concatenate([(least + most) / 2, (most - least) / 2, reach[walked, None]], axis=1)
        self._walked = walked, children, balls[walked], boxes, begins, ends
        pairs = tree.children[entries - leaves]
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
        eye, detail = np.asarray(eye, np.float32), f32(k)
        image = np.zeros((0, 6)) if image is None else image
        nodes = np.empty(len(self._walked[0]), np.int32)
        parts = np.empty((self.lists, 4), np.int64)
        counts = np.zeros(2, np.int64)
        at_once(_walk, *self._walked, self._lists[1], eye, detail, image, nodes, parts, counts)
        parts = parts[: counts[1]]
        lengths = parts[:, 1] - parts[:, 0]
        parts[:, 2] = 2 * (np.cumsum(lengths) - lengths)
        buffer = np.empty(2 * int(lengths.sum()), np.int32)
        in_parallel(_search, len(parts), _GRAIN, *self._lists, eye, detail, parts, buffer)
        found = np.empty(int(counts[0] + parts[:, 3].sum()), np.int32)
        found[: counts[0]] = nodes[: counts[0]]
        at_once(_gather, parts, buffer, found[counts[0] :])
        return found


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
def _walk(walked, children, balls, boxes, begins, ends, families, eye, k, image, nodes, parts, counts):
    """From the root, which is the first, down the upper tree: nodes to draw, and parts of lists to search."""
    count, used, top = 0, 0, 1
    stack = np.empty(len(walked) + 1, np.int32)
    stack[0] = 0
    while top:
        top -= 1
        i = stack[top]
        if not _in_image(boxes[i], image):
            continue
        if _fine(balls, i, 0, eye, k):
            nodes[count] = walked[i]
            count += 1
        elif children[i, 0] >= 0:
            stack[top], stack[top + 1] = children[i, 1], children[i, 0]
            top += 2
        else:
            least = _distance(boxes[i], eye) * (1 - SLACK) / k
            low, high = begins[i], ends[i]
            while low < high:  # sizes fall
                middle = (low + high) // 2
                if families[middle, 3] >= least:
                    low = middle + 1
                else:
                    high = middle
            parts[used, 0], parts[used, 1] = begins[i], low
            used += 1
    counts[0], counts[1] = count, used


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
