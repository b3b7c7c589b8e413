"""HSPT in memory: the reference for trees on disk, and the subject of measurements."""

import math

import numpy as np

from training.lod.tree.forest import forest_shape
from training.lod.tree.nodes import detail_of
from training.lod.tree.shape import Tree
from training.methods.tree.sequential_point_tree import (
    LEAF,
    UpperTree,
    image_borders,
    node_bounds,
    search_lists,
)
from training.scenes.cameras import Camera


class SequentialPointTree:
    """Tree of splats, prepared for fast cuts.

    Args:
        tree: tree of N leaves.
        means: (2N - 1, 3) float32 of all nodes.
        sizes: (2N - 1,) float32, saturated (``Tree.sizes``).
        log_scales: (2N - 1, 3) float32.
        longest: maximum number of leaves below the root of a list; 0 means a sixth of the square root of the
            number of nodes. Longer lists cull less outside the image; shorter lists cost more traversal.

    Attributes:
        lists: number of lists.
    """

    def __init__(
        self, tree: Tree, means: np.ndarray, sizes: np.ndarray, log_scales: np.ndarray, longest: int = 0
    ) -> None:
        order, forest = forest_shape(tree, longest or max(math.isqrt(len(tree)) // 6, 1))
        in_upper = np.append(forest.ends - 1, np.arange(forest.ends[-1], len(forest)))
        names = self._names = order[in_upper]
        inside = order[: forest.ends[-1]]
        bounds = node_bounds(means[inside], log_scales[inside], forest.begins)
        self._upper = UpperTree.from_bounds(
            forest.upper, means[names], log_scales[names], sizes[names], bounds
        )
        self.lists = len(forest.counts)
        above = inside[inside >= tree.leaves]
        list_index = np.repeat(np.arange(self.lists, dtype=np.int32), forest.counts - 1)
        nodes = above[np.lexsort((-sizes[above], list_index))]
        ranks = np.full(len(tree), LEAF, np.int32)
        ranks[nodes] = np.arange(len(nodes)) - np.repeat(forest.list_begins, forest.counts - 1)
        entries = np.empty((len(nodes), 8), np.float32)
        links, balls = entries.view(np.int32)[:, :4], entries[:, 4:]
        self._lists = links, balls, np.append(0, forest.list_ends)
        links[:, :2] = tree.children[nodes - tree.leaves]
        links[:, 2:] = ranks[links[:, :2]]
        balls[:, :3], balls[:, 3] = means[nodes], sizes[nodes]

    def cut(self, camera: Camera, pixels: float, near: float = 0.01) -> np.ndarray:
        """Return the nodes (M,) int32 to draw for a camera, in any order, without those outside its image.

        Args:
            pixels: maximum node size in pixels, the control of the rule ``cut``.
            near: near depth in world units.
        """
        return self.cut_at(camera.center, detail_of(camera.focal, pixels), image_borders(camera, near))

    def cut_at(self, position: np.ndarray, k: float, borders: np.ndarray | None = None) -> np.ndarray:
        """Return the nodes (M,) int32 to draw for a camera position (3,) and a level of detail k.

        Args:
            borders: see :func:`image_borders`; None disables culling.
        """
        nodes, lists, bands = self._upper.traverse(position, k, borders)
        cut, _ = search_lists(*self._lists, lists, bands, position, k, self._names[nodes])
        return cut
