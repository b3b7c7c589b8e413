"""Clean-up of splats: tests for unwanted splats, and removal of them from all levels.

Splats are tested one by one for position, size and opacity; floaters are found among all levels together. In
a tree, the leaves are tested; inner nodes remain while any leaf below them remains. numpy only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from ..errors import LodgsError
from ..lod.crop import Crop, crop_mask
from ..lod.partial_read import BLOCKS, block_table
from ..lod.rule import find_rule
from ..lod.rules.cut import PARENT, PARENT_SIZE
from ..lod.selection import unknown_rule_error
from ..lod.tree.pages import page_table
from ..lod.tree.paging import is_tree
from ..lod.tree.resident import COLUMNS, ResidentTree
from ..scenes.cameras import Camera
from ..scenes.view_tables import VIEW_TABLES
from ..settings import setting, settings_of
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
from ..splats.ply import BATCH_ROWS

MAX_FLOATER_SHARE = 0.001
"""Clusters with at most this fraction of all splats are floaters."""
GAPS_ACROSS = 48
"""The default gap is the diagonal of the middle 80 % of the splats divided by this number."""
_MAX_CELL = (1 << 20) - 2

Masks = Mapping[int, np.ndarray]
"""An array (N, ...) per level, by level number: usually (N,) bool."""


def find_large(scales: np.ndarray, limit: float) -> np.ndarray:
    """Return (N,) bool: splats whose largest standard deviation, of (N, 3), exceeds a limit."""
    return scales.max(axis=1, initial=0) > limit


def find_faint(opacities: np.ndarray, limit: float) -> np.ndarray:
    """Return (N,) bool: splats whose opacity (N,) is below a limit."""
    return opacities < limit


def find_far(means: np.ndarray, positions: np.ndarray, limit: float) -> np.ndarray:
    """Return (N,) bool: means (N, 3) farther than a limit from every camera position (C, 3)."""
    far = np.ones(len(means), bool)
    for position in positions:
        offset = means[far] - np.asarray(position, np.float32)
        far[far] = np.einsum("ij,ij->i", offset, offset) > limit * limit
    return far


def find_unseen(
    means: np.ndarray, cameras: Sequence[Camera], min_views: int, reach: float = inf
) -> np.ndarray:
    """Return (N,) bool: means (N, 3) inside the images of fewer than ``min_views`` cameras.

    Ignores occlusion.

    Args:
        reach: maximum depth.
    """
    count = np.zeros(len(means), np.int32)
    for camera in cameras:
        pose = camera.world_to_camera.astype(np.float32)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).T
        u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
        inside = (z > 0) & (u >= 0) & (u < camera.width * z) & (v >= 0) & (v < camera.height * z)
        count += inside & (z <= reach)
    return count < min_views


def find_floaters(means: np.ndarray, gap: float = 0.0, share: float = MAX_FLOATER_SHARE) -> np.ndarray:
    """Return (N,) bool: splats at means (N, 3) in clusters of at most a fraction ``share`` of all splats.

    Space is divided into cells. A cluster consists of occupied cells that touch, also at edges and corners.
    So splats closer than a cell size are in one cluster, and gaps of more than two cells separate clusters.

    Args:
        gap: cell size; 0: :func:`default_gap`.
    """
    if not len(means):
        return np.zeros(0, bool)
    cell_of, cells = assign_cells(means, gap or default_gap(means))
    cluster = _clusters(cells)
    counts = np.bincount(cluster[cell_of], minlength=len(cells))
    return (counts <= share * len(means))[cluster][cell_of]


def default_gap(means: np.ndarray) -> float:
    """Return a gap between clusters, relative to the extent of most means (N, 3)."""
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.1, 0.9), axis=0)
    return float(np.linalg.norm(high - low)) / GAPS_ACROSS or 1.0


@dataclass(frozen=True)
class Cleaning:
    """Tests for splats to remove; lengths are in the splats' units.

    Attributes:
        crops: see ``crop.crop_mask``.
        cameras: in the splats' space.
    """

    crops: tuple[Crop, ...] = ()
    cameras: tuple[Camera, ...] = ()
    max_size: float = setting(
        inf,
        "Match splats whose largest standard deviation exceeds this.",
        label="Size", unit="length", start=1.0,
    )  # fmt: skip
    min_opacity: float = setting(
        0.0, "Match splats less opaque than this.", label="Opacity", high=1, start=0.05
    )
    max_distance: float = setting(
        inf,
        "Match splats farther than this from every camera.",
        label="Distance", unit="length", start=10.0,
    )  # fmt: skip
    min_views: int = setting(
        0, "Match splats inside the frames of fewer cameras than this.", label="Views", start=3
    )
    drop_floaters: bool = setting(False, "Match small isolated clusters among the splats that remain.")
    gap: float = setting(
        0.0,
        "Merge clusters closer than this; clusters twice as far apart stay separate. 0 uses the density of "
        "the splats.",
        unit="length", start=0.0,
    )  # fmt: skip
    share: float = setting(
        MAX_FLOATER_SHARE,
        "Keep clusters with more than this share of all splats.",
        label="Largest Cluster", high=1, start=MAX_FLOATER_SHARE,
    )  # fmt: skip

    def keeps(self, splats: Splats) -> np.ndarray:
        """Return (N,) bool: splats that pass all tests except the one for floaters."""
        mask = crop_mask(self.crops, splats.means)
        with np.errstate(over="ignore"):
            if self.max_size < inf:
                mask &= ~find_large(np.exp(splats.log_scales), self.max_size)
            if self.min_opacity > 0:
                mask &= ~find_faint(1 / (1 + np.exp(-splats.opacity_logits)), self.min_opacity)
        if self.max_distance < inf:
            positions = np.array([camera.center for camera in self.cameras])
            mask &= ~find_far(splats.means, positions, self.max_distance)
        if self.min_views > 0:
            mask &= ~find_unseen(splats.means, self.cameras, self.min_views)
        return mask


LIMITS = settings_of(Cleaning)
"""The settings of the tests, by name. Blender's tools start with the values ``start``."""


def clean_bundle(bundle: Bundle, cleaning: Cleaning) -> Bundle:
    """Return a bundle without the unwanted splats.

    Reads all splats once, and again when they are written. Needs some dozens of bytes of memory per splat.

    Raises:
        LodgsError: as :func:`keep_splats`.
    """
    tree = is_tree(bundle)
    masks, means, columns = {}, {}, {}
    for level in bundle.levels:
        batches = [
            (cleaning.keeps(splats), splats.means, {name: splats.extras.get(name) for name in COLUMNS})
            for splats in read_batches(level.rows)
        ]
        masks[level.number] = np.concatenate([mask for mask, _, _ in batches])
        if cleaning.drop_floaters or tree:
            means[level.number] = np.concatenate([batch_means for _, batch_means, _ in batches])
        if tree:
            columns[level.number] = {
                name: np.concatenate([_or_zeros(batch[name], len(mask)) for mask, _, batch in batches])
                for name in COLUMNS
            }
    relations = TreeRelations(columns, means) if tree else None
    if cleaning.drop_floaters:
        exclude_floaters(masks, means, cleaning.gap, cleaning.share, relations)
    return keep_splats(bundle, masks, relations)


def exclude_floaters(
    masks: dict[int, np.ndarray],
    means: Masks,
    gap: float,
    share: float,
    relations: TreeRelations | None = None,
) -> None:
    """Remove floaters from the masks of remaining splats, (N,) bool; in a tree, only leaves are tested.

    Args:
        means: (N, 3) of each level.
    """
    if relations:
        tested = relations.leaves
    else:
        tested = {number: np.ones(len(mask), bool) for number, mask in masks.items()}
    rows = {number: np.flatnonzero(mask & tested[number]) for number, mask in masks.items()}
    tested_means = np.concatenate([means[number][level_rows] for number, level_rows in rows.items()])
    floating = find_floaters(tested_means, gap, share)
    begin = 0
    for number, level_rows in rows.items():
        masks[number][level_rows[floating[begin : begin + len(level_rows)]]] = False
        begin += len(level_rows)


def keep_splats(bundle: Bundle, masks: Masks, relations: TreeRelations | None = None) -> Bundle:
    """Return a bundle with only the splats of the masks, (N,) bool each, and updated tables.

    In a tree, only the masks of leaves count. A node with one remaining child is replaced by that child, so
    that every node still has two children or none, and every cut is complete.

    Args:
        relations: of a tree, if already computed.

    Raises:
        LodgsError: no splats remain, or the bundle has tables of an unknown rule.
    """
    rule = find_rule(bundle.rule)
    if bundle.rule and rule is None and bundle.tables.keys() - set(VIEW_TABLES):
        raise LodgsError(*unknown_rule_error(bundle.rule))
    changed: dict[int, dict[str, np.ndarray]] = {}
    if is_tree(bundle):
        masks, changed = (relations or TreeRelations.of(bundle)).pruned(masks)
    levels = []
    for level in bundle.levels:
        rows = np.flatnonzero(masks[level.number])
        columns = changed.get(level.number, {})
        if level.on_disk is None:
            splats = level.splats.select(rows)
            splats.extras |= columns
            levels.append(replace(level, splats=splats))
        else:
            levels.append(replace(level, on_disk=RowSubset(level.rows, rows, columns)))
    if not any(len(level.rows) for level in levels):
        raise LodgsError("No splats remain.", "Check the crops and limits.")
    tables = dict(bundle.tables)
    if BLOCKS in tables and is_tree(bundle):
        tables[BLOCKS] = page_table(changed)
    elif BLOCKS in tables and rule is not None:
        parts = [
            block_table(rule, {level.number: splats})
            for level in levels
            for splats in read_batches(level.rows)
        ]
        tables[BLOCKS] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return replace(bundle, levels=levels, tables=tables)


class TreeRelations:
    """Parents and children among the splats of a tree, whose levels are concatenated.

    Args:
        columns: of the rule ``cut``, (N,) of each level.
        means: (N, 3) of each level.
    """

    def __init__(self, columns: Mapping[int, Mapping[str, np.ndarray]], means: Masks) -> None:
        self._numbers = list(means)
        self._ends = np.cumsum([len(level_means) for level_means in means.values()])
        all_means = np.concatenate(list(means.values()))
        self._columns = {
            name: np.concatenate([columns[number][name] for number in self._numbers]) for name in COLUMNS
        }
        tree = ResidentTree(self._columns | dict(zip("xyz", all_means.T, strict=True)))
        tree.update(np.arange(len(all_means)))
        self._parents = tree.parents
        self._children = self._count_children(np.ones(len(all_means), bool))

    @classmethod
    def of(cls, bundle: Bundle) -> TreeRelations:
        """Return the relations of a bundle's levels."""
        columns, means = {}, {}
        for level in bundle.levels:
            parts = list(read_batches(level.rows))
            means[level.number] = np.concatenate([part.means for part in parts])
            columns[level.number] = {
                name: np.concatenate([_or_zeros(part.extras.get(name), len(part)) for part in parts])
                for name in COLUMNS
            }
        return cls(columns, means)

    @property
    def leaves(self) -> Masks:
        """Masks of the leaves."""
        return self._by_level(self._children == 0)

    def with_ancestors(self, masks: Masks) -> dict[int, np.ndarray]:
        """Return masks of the remaining leaves and all their ancestors."""
        return self._by_level(self._with_ancestors(masks))

    def pruned(self, masks: Masks) -> tuple[dict[int, np.ndarray], dict[int, dict[str, np.ndarray]]]:
        """Return masks of the remaining splats, and their new columns (M,), see :func:`keep_splats`."""
        remaining = self._with_ancestors(masks)
        single = remaining & (self._count_children(remaining) == 1)
        # each node takes the parent of its highest ancestor in a chain of nodes with one child
        own = np.arange(len(remaining), dtype=np.int32)
        replaced = np.where((self._parents >= 0) & single[self._parents], self._parents, own)
        while not np.array_equal(higher := replaced[replaced], replaced):
            replaced = higher
        remaining &= ~single
        columns = {name: self._columns[name] for name in COLUMNS}
        for name in (PARENT_SIZE, *PARENT):
            columns[name] = columns[name][replaced]
        masks = self._by_level(remaining)
        by_level = {name: self._by_level(column) for name, column in columns.items()}
        return masks, {
            number: {name: by_level[name][number][mask] for name in COLUMNS} for number, mask in masks.items()
        }

    def _with_ancestors(self, masks: Masks) -> np.ndarray:
        remaining = np.concatenate([masks[number] for number in self._numbers]) & (self._children == 0)
        added = np.flatnonzero(remaining)
        while len(added):
            parents = np.unique(self._parents[added])
            added = parents[(parents >= 0) & ~remaining[parents]]
            remaining[added] = True
        return remaining

    def _count_children(self, mask: np.ndarray) -> np.ndarray:
        """Return the number of each node's children (N,) in a mask."""
        parents = self._parents[mask]
        return np.bincount(parents[parents >= 0], minlength=len(mask))

    def _by_level(self, values: np.ndarray) -> dict[int, np.ndarray]:
        return dict(zip(self._numbers, np.split(values, self._ends[:-1]), strict=True))


@dataclass(frozen=True)
class RowSubset:
    """A subset of splats on disk, with replaced columns.

    Attributes:
        source: the splats.
        rows: (M,) rows of the subset.
        columns: (M,) by name.
    """

    source: SplatRows
    rows: np.ndarray
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, index: slice, /) -> Splats:
        """Read a range of the subset."""
        splats = self.source.select(self.rows[index])
        splats.extras |= {name: column[index] for name, column in self.columns.items()}
        return splats


def read_batches(rows: SplatRows) -> Iterator[Splats]:
    """Read all splats, BATCH_ROWS at a time; yields at least one batch, which may be empty."""
    for begin in range(0, max(len(rows), 1), BATCH_ROWS):
        yield rows.select(slice(begin, begin + BATCH_ROWS))


def _or_zeros(column: np.ndarray | None, count: int) -> np.ndarray:
    return np.zeros(count, np.float32) if column is None else column


def assign_cells(means: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Assign splats at means (N, 3) to cubic cells with edge length ``gap``.

    Returns:
        Cell index of each splat (N,), and the codes (V,) int64 of the occupied cells, ascending: three
        coordinates of 21 bits, which never reach the limits of 21 bits.
    """
    low = np.median(means[:: max(len(means) // 100_000, 1)], axis=0)
    codes = np.zeros(len(means), np.int64)
    for axis in range(3):
        coordinate = np.floor((means[:, axis] - low[axis]) / np.float32(gap))
        coordinate = np.clip(coordinate, -(_MAX_CELL // 2), _MAX_CELL // 2)
        codes = (codes << 21) + (coordinate.astype(np.int64) + (1 << 20))
    order = np.argsort(codes)
    ordered = codes[order]
    first = np.empty(len(codes), bool)
    first[0], first[1:] = True, ordered[1:] != ordered[:-1]
    cells = np.empty(len(codes), np.int32)
    cells[order] = np.cumsum(first, dtype=np.int32) - 1
    return cells, ordered[first]


def _clusters(cells: np.ndarray) -> np.ndarray:
    """Return the cluster (V,) of each cell: the index of one of the cluster's cells."""
    steps = [(x, y, z) for x in (0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    neighbours = [(x << 42) + (y << 21) + z for x, y, z in steps if (x, y, z) > (0, 0, 0)]
    pairs = []
    for step in neighbours:
        place = np.searchsorted(cells, cells + step).clip(max=len(cells) - 1)
        touching = np.flatnonzero(cells[place] == cells + step)
        pairs.append(np.stack([touching, place[touching]]).astype(np.int32))
    first, second = np.concatenate(pairs, axis=1)
    cluster = np.arange(len(cells), dtype=np.int32)
    while len(first):
        a, b = cluster[first], cluster[second]
        separate = a != b
        first, second, a, b = first[separate], second[separate], a[separate], b[separate]
        cluster[np.maximum(a, b)] = np.minimum(a, b)  # always towards lower indices, which avoids cycles
        while not np.array_equal(higher := cluster[cluster], cluster):
            cluster = higher
    return cluster
