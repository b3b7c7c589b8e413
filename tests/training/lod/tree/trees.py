"""Trees of splats for tests: neighbours are merged simply, and sizes give proper cuts."""

from __future__ import annotations

import numpy as np

from training.lod.blocks import BLOCKS, block_table
from training.lod.tree.nodes import ABOVE_ROOT, BLOCK_BOUNDS, min_parent_size, streaming_order
from training.lod.tree.shape import Tree
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.morton import spatial_order


def random_tree(rng: np.random.Generator, leaves: int) -> Tree:
    """Merge random pairs: deep and shallow branches, distant children."""
    free, children = list(range(leaves)), []
    while len(free) > 1:
        pair = [free.pop(rng.integers(len(free))) for _ in range(2)]
        free.append(leaves + len(children))
        children.append(pair)
    return Tree(np.array(children, np.int32).reshape(-1, 2))


def surfaces(count: int, degree: int = 0) -> Splats:
    """Return splats on a wavy ground and two walls, 20 units wide."""
    rng = np.random.default_rng(4)
    means = rng.uniform(-10, 10, (count, 3))
    means[: count // 2, 2] = 0.1 * np.sin(means[: count // 2, 0])
    means[count // 2 :, 0] = 5 * np.sign(means[count // 2 :, 0])
    return Splats(
        means.astype(np.float32), rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-3, 0.5, (count, 3)).astype(np.float32), rng.normal(0, 2, count).astype(np.float32),
        rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )  # fmt: skip


def random_leaves(count: int, rng: np.random.Generator, degree: int = 0, extent: float = 10.0) -> Splats:
    """Return splats on a rolling ground, small compared to the distances between neighbours."""
    means = rng.uniform(-extent, extent, (count, 3))
    means[:, 2] = np.sin(means[:, 0]) * np.cos(means[:, 1]) + rng.normal(0, 0.05, count)
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.log(extent / count**0.5 * rng.uniform(0.3, 1, (count, 3))).astype(np.float32),
        opacity_logits=rng.normal(1, 1, count).astype(np.float32),
        sh=rng.normal(0, 0.5, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def tree_of(leaves: Splats) -> Bundle:
    """Return a tree over at least two splats, without their extra columns."""
    leaves = leaves.select(spatial_order(leaves.means))
    count = len(leaves)
    total = 2 * count - 1
    means, squares = np.empty((total, 3)), np.empty(total)
    sh = np.empty((total, *leaves.sh.shape[1:]), np.float32)
    means[:count], sh[:count] = leaves.means, leaves.sh
    squares[:count] = np.exp(2 * leaves.log_scales.astype(np.float64)).mean(axis=1)
    sizes, parents, opacity = np.zeros(total), np.full(total, -1), np.empty(total)
    opacity[:count] = 1 / (1 + np.exp(-leaves.opacity_logits.astype(np.float64)))
    row, first = np.arange(count), count
    while len(row) > 1:
        pairs = len(row) // 2
        two, new = row[: 2 * pairs].reshape(-1, 2), np.arange(first, first + pairs)
        weight = (opacity * squares)[two]
        weight /= weight.sum(axis=1, keepdims=True)
        means[new] = np.float32(np.einsum("nt,ntc->nc", weight, means[two]))  # as in files
        distance = np.linalg.norm(means[two] - means[new][:, None], axis=2)
        squares[new] = np.einsum("nt,nt->n", weight, squares[two] + distance**2 / 3)
        sh[new] = np.einsum("nt,ntkc->nkc", weight, sh[two])
        opacity[new] = np.einsum("nt,nt->n", weight, opacity[two])
        minimum = np.maximum(min_parent_size(sizes[two], distance).max(axis=1), np.sqrt(3 * squares[new]))
        sizes[new] = np.nextafter(np.float32(minimum), np.float32(np.inf))
        parents[two] = new[:, None]
        row, first = np.append(new, row[2 * pairs :]), first + pairs
    above = sizes[parents]
    above[-1] = ABOVE_ROOT
    columns = {"node_size": sizes, "parent_size": above}
    columns |= {f"parent_{axis}": means[parents, i] for i, axis in enumerate("xyz")}
    extras = {name: column.astype(np.float32) for name, column in columns.items()}
    clipped = opacity.clip(1e-4, 1 - 1e-4)
    nodes = Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (total, 1)),
        log_scales=np.tile(np.log(squares)[:, None] / 2, 3).astype(np.float32),
        opacity_logits=np.log(clipped / (1 - clipped)).astype(np.float32),
        sh=sh,
        extras=extras,
    )
    leaves.extras = {name: column[:count] for name, column in extras.items()}
    above = nodes.select(np.argsort(-sizes[count:], kind="stable") + count)
    return Bundle("tree", [Level(1, above), Level(2, leaves)], "cut")


def page_table(columns):
    """Return the table of blocks of a tree, from the columns of its levels by number."""
    return block_table(BLOCK_BOUNDS, columns.items())


def write_in_pages(path, tree):
    """Write a tree as a file sorted by space, with a page table."""
    levels = [Level(x.number, x.splats.select(streaming_order(x.splats.extras))) for x in tree.levels]
    table = page_table({level.number: level.splats.extras for level in levels})
    write_bundle(path, Bundle("tree", levels, "cut", tables={BLOCKS: table}))
