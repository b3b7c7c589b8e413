"""What is clutter in a scene of splats, and its levels without it: the same tests for every level.

Splats are tested one by one, by where they are, how large and how opaque; floaters among all levels together.
In a tree of splats the leaves are tested, and nodes stand as long as something stands below them. numpy only.
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
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle
from ..splats.ply import BATCH_ROWS

MAX_FLOATER_SHARE = 0.001
"""Of all splats: clusters that have no larger share are floaters."""
GAPS_ACROSS = 48
"""Into so many gaps the middle 80 % of the splats are divided along a diagonal where no gap is given."""
_FARTHEST_CELL = (1 << 20) - 2

Masks = Mapping[int, np.ndarray]
"""(N,) bool of each level's splats, by the level's number."""


def find_large(scales: np.ndarray, most: float) -> np.ndarray:
    """(N,) bool, whose largest standard deviation, of (N, 3), is above a length."""
    return scales.max(axis=1, initial=0) > most


def find_faint(opacities: np.ndarray, least: float) -> np.ndarray:
    """(N,) bool, whose opacity (N,) is below the least one."""
    return opacities < least


def find_far(means: np.ndarray, eyes: np.ndarray, most: float) -> np.ndarray:
    """(N,) bool, which means (N, 3) are farther than that from the nearest of some eyes (C, 3)."""
    found = np.ones(len(means), bool)
    for eye in eyes:
        away = means[found] - np.asarray(eye, np.float32)
        found[found] = np.einsum("ij,ij->i", away, away) > most * most
    return found


def find_unseen(means: np.ndarray, cameras: Sequence[Camera], least: int, reach: float = inf) -> np.ndarray:
    """(N,) bool, which means (N, 3) stand in the images of fewer cameras than that.

    Whether something hides them does not count.

    Args:
        reach: how far cameras see.
    """
    count = np.zeros(len(means), np.int32)
    for camera in cameras:
        pose = camera.world_to_camera.astype(np.float32)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).T
        u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
        inside = (z > 0) & (u >= 0) & (u < camera.width * z) & (v >= 0) & (v < camera.height * z)
        count += inside & (z <= reach)
    return count < least


def find_floaters(means: np.ndarray, gap: float = 0.0, share: float = MAX_FLOATER_SHARE) -> np.ndarray:
    """(N,) bool, which splats at means (N, 3) are in clusters of at most a share of all splats.

    Space is divided into cells; splats are of one cluster where cells with splats touch, also across edges
    and corners, so that nothing nearer than a cell is apart, and nothing farther than two is together.

    Args:
        gap: the length of a cell; 0: :func:`default_gap`.
    """
    if not len(means):
        return np.zeros(0, bool)
    cell_of, cells = assign_cells(means, gap or default_gap(means))
    cluster = _clusters(cells)
    counts = np.bincount(cluster[cell_of], minlength=len(cells))
    return (counts <= share * len(means))[cluster][cell_of]


def default_gap(means: np.ndarray) -> float:
    """A distance (of means (N, 3)) beyond which splats look apart: a share of where most of them are."""
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.1, 0.9), axis=0)
    return float(np.linalg.norm(high - low)) / GAPS_ACROSS or 1.0


@dataclass(frozen=True)
class Cleaning:
    """What goes; lengths are in the splats' units.

    Attributes:
        crops: see ``crop.crop_mask``.
        max_size: see :func:`find_large`.
        min_opacity: see :func:`find_faint`.
        max_distance: see :func:`find_far`, from the cameras' eyes.
        min_views: see :func:`find_unseen`, of the cameras.
        cameras: in the splats' space.
        drop_floaters, gap, share: see :func:`find_floaters`, among what the other tests leave.
    """

    crops: tuple[Crop, ...] = ()
    max_size: float = inf
    min_opacity: float = 0.0
    max_distance: float = inf
    min_views: int = 0
    cameras: tuple[Camera, ...] = ()
    drop_floaters: bool = False
    gap: float = 0.0
    share: float = MAX_FLOATER_SHARE

    def keeps(self, splats: Splats) -> np.ndarray:
        """(N,) bool, which splats stay as far as each can be told by itself."""
        found = crop_mask(self.crops, splats.means)
        with np.errstate(over="ignore"):
            if self.max_size < inf:
                found &= ~find_large(np.exp(splats.log_scales), self.max_size)
            if self.min_opacity > 0:
                found &= ~find_faint(1 / (1 + np.exp(-splats.opacity_logits)), self.min_opacity)
        if self.max_distance < inf:
            eyes = np.array([camera.center for camera in self.cameras])
            found &= ~find_far(splats.means, eyes, self.max_distance)
        if self.min_views > 0:
            found &= ~find_unseen(splats.means, self.cameras, self.min_views)
        return found


def clean_bundle(bundle: Bundle, cleaning: Cleaning) -> Bundle:
    """The levels without what goes. All splats are read once; they are read again where they are written.

    Memory holds some dozens of bytes of each splat.

    Raises:
        LodgsError: as :func:`keep_splats`.
    """
    tree, masks, places, columns = is_tree(bundle), {}, {}, {}
    for level in bundle.levels:
        parts = [
            (cleaning.keeps(splats), splats.means, {name: splats.extras.get(name) for name in COLUMNS})
            for splats in read_batches(level.rows)
        ]
        masks[level.number] = np.concatenate([mask for mask, _, _ in parts])
        if cleaning.drop_floaters or tree:
            places[level.number] = np.concatenate([means for _, means, _ in parts])
        if tree:
            columns[level.number] = {
                name: np.concatenate([_or_zeros(part[name], len(means)) for _, means, part in parts])
                for name in COLUMNS
            }
    family = TreeRelations(columns, places) if tree else None
    if cleaning.drop_floaters:
        exclude_floaters(masks, places, cleaning.gap, cleaning.share, family)
    return keep_splats(bundle, masks, family)


def exclude_floaters(
    masks: dict[int, np.ndarray], means: Masks, gap: float, share: float, family: TreeRelations | None = None
) -> None:
    """Takes floaters out of what stays of each level, (N,) bool; of a tree those among the leaves.

    Args:
        means: (N, 3) of each level.
    """
    asked = family.leaves if family else {number: np.ones(len(mask), bool) for number, mask in masks.items()}
    rows = {number: np.flatnonzero(mask & asked[number]) for number, mask in masks.items()}
    found = find_floaters(np.concatenate([means[number][some] for number, some in rows.items()]), gap, share)
    begin = 0
    for number, some in rows.items():
        masks[number][some[found[begin : begin + len(some)]]] = False
        begin += len(some)


def keep_splats(bundle: Bundle, masks: Masks, family: TreeRelations | None = None) -> Bundle:
    """The levels with those splats that stay, (N,) bool each; tables follow.

    Of a tree only leaves are asked. A node of which one child is left gives way to it, which so is the other
    child of whoever was above: every node still has two children, or none, and every cut is complete.

    Args:
        family: of a tree, where it is known.

    Raises:
        LodgsError: nothing is left, or the levels have tables of a rule that is not known here.
    """
    rule = find_rule(bundle.rule)
    if bundle.rule and rule is None and bundle.tables.keys() - set(VIEW_TABLES):
        raise LodgsError(*unknown_rule_error(bundle.rule))
    changed: dict[int, dict[str, np.ndarray]] = {}
    if is_tree(bundle):
        masks, changed = (family or TreeRelations.of(bundle)).pruned(masks)
    levels = []
    for level in bundle.levels:
        rows, columns = np.flatnonzero(masks[level.number]), changed.get(level.number, {})
        if level.on_disk is None:
            splats = level.splats.select(rows)
            splats.extras |= columns
            levels.append(replace(level, splats=splats))
        else:
            levels.append(replace(level, on_disk=RowSubset(level.rows, rows, columns)))
    if not any(len(level.rows) for level in levels):
        raise LodgsError("Nothing is left of the splats.", "Look at the crops, and at the limits.")
    tables = dict(bundle.tables)
    if BLOCKS in tables and is_tree(bundle):
        tables[BLOCKS] = page_table({number: columns for number, columns in changed.items()})
    elif BLOCKS in tables and rule is not None:
        parts = [
            block_table(rule, {level.number: splats})
            for level in levels
            for splats in read_batches(level.rows)
        ]
        tables[BLOCKS] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return replace(bundle, levels=levels, tables=tables)


class TreeRelations:
    """Who stands for whom among the splats of a tree: its levels' rows one after the other.

    Args:
        columns: of the rule ``cut``, (N,) of each level.
        means: (N, 3) of each level.
    """

    def __init__(self, columns: Mapping[int, Mapping[str, np.ndarray]], means: Masks) -> None:
        self._numbers, counts = list(means), [len(each) for each in means.values()]
        self._ends = np.cumsum(counts)
        places = np.concatenate(list(means.values()))
        self._columns = {
            name: np.concatenate([columns[number][name] for number in self._numbers]) for name in COLUMNS
        }
        standing = ResidentTree(self._columns | dict(zip("xyz", places.T, strict=True)))
        standing.update(np.arange(len(places)))
        self._parents = standing.parents
        self._children = self._count(np.ones(len(places), bool))

    @classmethod
    def of(cls, bundle: Bundle) -> TreeRelations:
        """That of a bundle's levels."""
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
        """Which splats have none below them."""
        return self._by_level(self._children == 0)

    def standing(self, masks: Masks) -> dict[int, np.ndarray]:
        """What stays where some leaves do: these, and every node that stands for any of them."""
        return self._by_level(self._standing(masks))

    def pruned(self, masks: Masks) -> tuple[dict[int, np.ndarray], dict[int, dict[str, np.ndarray]]]:
        """What stays where some leaves do, and the rule's columns (M,) of what stays: see :func:`keep_splats`."""
        stays = self._standing(masks)
        one = stays & (self._count(stays) == 1)
        # whose place each takes: the highest of those right above it that give way, or its own
        own = np.arange(len(stays), dtype=np.int32)
        above = np.where((self._parents >= 0) & one[self._parents], self._parents, own)
        while not np.array_equal(higher := above[above], above):
            above = higher
        stays &= ~one
        columns = {name: self._columns[name] for name in COLUMNS}
        for name in (PARENT_SIZE, *PARENT):
            columns[name] = columns[name][above]
        masks = self._by_level(stays)
        by_level = {name: self._by_level(column) for name, column in columns.items()}
        return masks, {
            number: {name: by_level[name][number][mask] for name in COLUMNS} for number, mask in masks.items()
        }

    def _standing(self, masks: Masks) -> np.ndarray:
        stays = np.concatenate([masks[number] for number in self._numbers]) & (self._children == 0)
        come = np.flatnonzero(stays)
        while len(come):
            above = np.unique(self._parents[come])
            come = above[(above >= 0) & ~stays[above]]
            stays[come] = True
        return stays

    def _count(self, stays: np.ndarray) -> np.ndarray:
        """(N,) how many children of each stay."""
        parents = self._parents[stays]
        return np.bincount(parents[parents >= 0], minlength=len(stays))

    def _by_level(self, values: np.ndarray) -> dict[int, np.ndarray]:
        return dict(zip(self._numbers, np.split(values, self._ends[:-1]), strict=True))


@dataclass(frozen=True)
class RowSubset:
    """Some of the splats that are read a few at a time, with other columns of theirs.

    Attributes:
        rows: (M,) which.
        columns: (M,) by name.
    """

    of: SplatRows
    rows: np.ndarray
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, some: slice, /) -> Splats:
        """The splats of a range of these rows."""
        splats = self.of.select(self.rows[some])
        splats.extras |= {name: column[some] for name, column in self.columns.items()}
        return splats


def read_batches(rows: SplatRows) -> Iterator[Splats]:
    """All splats, BATCH_ROWS of them at a time; at least one part, which may be empty."""
    for begin in range(0, max(len(rows), 1), BATCH_ROWS):
        yield rows.select(slice(begin, begin + BATCH_ROWS))


def _or_zeros(column: np.ndarray | None, count: int) -> np.ndarray:
    return np.zeros(count, np.float32) if column is None else column


def assign_cells(means: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Which cubes of an edge ``gap`` splats at means (N, 3) are in.

    Returns:
        The number of each splat's cell (N,), and the cells (V,) int64 themselves, ascending, three numbers of
        21 bits each; none is at the border of what 21 bits can tell.
    """
    low = np.median(means[:: max(len(means) // 100_000, 1)], axis=0)
    keys = np.zeros(len(means), np.int64)
    for axis in range(3):
        place = np.floor((means[:, axis] - low[axis]) / np.float32(gap))
        place = np.clip(place, -(_FARTHEST_CELL // 2), _FARTHEST_CELL // 2)
        keys = (keys << 21) + (place.astype(np.int64) + (1 << 20))
    order = np.argsort(keys)
    ordered = keys[order]
    first = np.empty(len(keys), bool)
    first[0], first[1:] = True, ordered[1:] != ordered[:-1]
    numbers = np.empty(len(keys), np.int32)
    numbers[order] = np.cumsum(first, dtype=np.int32) - 1
    return numbers, ordered[first]


def _clusters(cells: np.ndarray) -> np.ndarray:
    """(V,) the number of each cell's cluster, which is that of one of its cells."""
    steps = [(x, y, z) for x in (0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    ahead = [(x << 42) + (y << 21) + z for x, y, z in steps if (x, y, z) > (0, 0, 0)]
    pairs = []
    for step in ahead:
        place = np.searchsorted(cells, cells + step).clip(max=len(cells) - 1)
        touch = np.flatnonzero(cells[place] == cells + step)
        pairs.append(np.stack([touch, place[touch]]).astype(np.int32))
    one, other = np.concatenate(pairs, axis=1)
    cluster = np.arange(len(cells), dtype=np.int32)
    while len(one):
        a, b = cluster[one], cluster[other]
        apart = a != b
        one, other, a, b = one[apart], other[apart], a[apart], b[apart]
        cluster[np.maximum(a, b)] = np.minimum(a, b)  # downwards, so that none leads in a circle
        while not np.array_equal(higher := cluster[cluster], cluster):
            cluster = higher
    return cluster
