"""Clean-up of splats: tests for unwanted splats, and removal of them from all levels.

Splats are tested one by one for position, size and opacity; floaters are found among all levels together.
Splats that depend on others follow them (``lod.rule.Relations``). numpy only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np

from ..errors import LodgsError
from ..lod.blocks import BLOCKS, block_table
from ..lod.crop import Crop, crop_mask
from ..lod.rule import Masks, Relations, Rule, find_rule, resolve_rule
from ..lod.selection import rule_columns, unknown_rule_error
from ..scenes.cameras import Camera
from ..scenes.view_tables import VIEW_TABLES
from ..settings import setting, settings_of
from ..splats.batches import read_batches
from ..splats.gaussians import SplatRows, Splats
from ..splats.levels import Bundle, Level
from ..splats.ply import Columns
from .clutter import HALO_OPACITY, SceneSubject, subject_of

MAX_FLOATER_SHARE = 0.001
"""Clusters with at most this fraction of all splats are floaters."""
GAPS_ACROSS = 48
"""The default gap is the diagonal of the middle 80 % of the splats divided by this number."""
MAX_SHIFT = 0.01
"""Maximum median distance between two versions of the same splats, as a fraction of the scene's size."""
_MAX_CELL = (1 << 20) - 2


def find_large(scales: np.ndarray, limit: float) -> np.ndarray:
    """Return a mask (N,) of splats whose largest standard deviation, of (N, 3), exceeds a limit."""
    return scales.max(axis=1, initial=0) > limit


def find_faint(opacities: np.ndarray, limit: float) -> np.ndarray:
    """Return a mask (N,) of splats whose opacity (N,) is below a limit."""
    return opacities < limit


def find_far(means: np.ndarray, positions: np.ndarray, limit: float) -> np.ndarray:
    """Return a mask (N,) of means (N, 3) farther than a limit from every camera position (C, 3)."""
    far = np.ones(len(means), bool)
    for position in positions:
        offset = means[far] - np.asarray(position, np.float32)
        far[far] = np.einsum("ij,ij->i", offset, offset) > limit * limit
    return far


def find_unseen(
    means: np.ndarray, cameras: Sequence[Camera], min_views: int, reach: float = inf
) -> np.ndarray:
    """Return a mask (N,) of means (N, 3) inside the images of fewer than ``min_views`` cameras.

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
    """Return a mask (N,) of means (N, 3) in clusters of at most a fraction ``share`` of all splats.

    Space is divided into cells. A cluster consists of occupied cells that touch, also at edges and corners.
    So splats closer than a cell size are in one cluster, and gaps of more than two cells separate clusters.

    Args:
        gap: cell size; 0 means :func:`default_gap`.
    """
    if not len(means):
        return np.zeros(0, bool)
    cell_of, cells = assign_cells(means, gap or default_gap(means))
    cluster = _clusters(cells)
    counts = np.bincount(cluster[cell_of], minlength=len(cells))
    return (counts <= share * len(means))[cluster][cell_of]


def same_rows(previous: np.ndarray, current: np.ndarray) -> bool:
    """Return whether two sets of means (N, 3) are versions of the same splats in the same order.

    Their numbers are equal, and half of the splats moved by at most MAX_SHIFT of the scene's size: the
    diagonal of the box around the central nine tenths of the splats.
    """
    if len(previous) != len(current) or not len(previous):
        return False
    low, high = np.quantile(previous.astype(np.float64), (0.05, 0.95), axis=0)
    shift = float(np.median(np.linalg.norm(current - previous, axis=1)))
    return shift <= MAX_SHIFT * float(np.linalg.norm(high - low))


def default_gap(means: np.ndarray) -> float:
    """Return a gap between clusters, relative to the extent of most means (N, 3)."""
    low, high = np.quantile(means[:: max(len(means) // 100_000, 1)], (0.1, 0.9), axis=0)
    return float(np.linalg.norm(high - low)) / GAPS_ACROSS or 1.0


@dataclass(frozen=True)
class Cleaning:
    """Tests for splats to remove; lengths are in the splats' units.

    Attributes:
        crops: see ``crop.crop_mask``.
        cameras: cameras in the splats' space.
        subject: subject of the scene; None means :func:`.clutter.subject_of` the bundle.
    """

    crops: tuple[Crop, ...] = ()
    cameras: tuple[Camera, ...] = ()
    subject: SceneSubject | None = None
    clutter: bool = setting(
        False,
        "Match all kinds of clutter around the subject, with limits that suit its size: large splats, halos, "
        "floaters, distant splats. A distant background and the ground's underside stay.",
    )
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
    max_reach: float = setting(
        inf,
        "Match splats farther than this from the centre of the subject.",
        label="Distance", unit="length", start=10.0,
    )  # fmt: skip
    halo_opacity: float = setting(
        0.0, "Match large splats near the subject that are less opaque than this.",
        label="Opacity", high=1, start=HALO_OPACITY,
    )  # fmt: skip
    min_depth: float = setting(
        inf,
        "Match splats deeper than this below the detected ground.",
        label="Depth", unit="length", start=1.0,
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

    def matches(self, splats: Splats) -> dict[str, np.ndarray]:
        """Return a mask (N,) of the splats to remove for each enabled test except the one for floaters.

        Names are those of the limits, and ``crops``.
        """
        masks = {}
        if self.crops:
            masks["crops"] = ~crop_mask(self.crops, splats.means)
        with np.errstate(over="ignore"):
            if self.max_size < inf:
                masks["max_size"] = find_large(np.exp(splats.log_scales), self.max_size)
                if self.clutter and self.subject is not None:
                    masks["max_size"] &= self.subject.near(splats.means)
            if self.min_opacity > 0:
                masks["min_opacity"] = find_faint(splats.opacities, self.min_opacity)
            if self.halo_opacity > 0 and self.subject is not None:
                masks["halo_opacity"] = self.subject.find_halos(
                    splats.means, np.exp(splats.log_scales), splats.opacities, self.halo_opacity
                )
        if self.max_reach < inf and self.subject is not None:
            masks["max_reach"] = self.subject.distances(splats.means) > self.max_reach
        if self.min_depth < inf and self.subject is not None:
            masks["min_depth"] = self.subject.find_below(splats.means, self.min_depth)
        if self.max_distance < inf:
            positions = np.array([camera.center for camera in self.cameras])
            masks["max_distance"] = find_far(splats.means, positions, self.max_distance)
        if self.min_views > 0:
            masks["min_views"] = find_unseen(splats.means, self.cameras, self.min_views)
        return masks

    def for_bundle(self, bundle: Bundle) -> Cleaning:
        """Return the tests with the bundle's subject, and its limits for clutter, where they need them."""
        needs = self.clutter or self.halo_opacity > 0 or min(self.max_reach, self.min_depth) < inf
        if self.subject is not None or not needs:
            return self
        subject = subject_of(bundle)
        values: dict[str, Any] = {}
        if self.clutter:
            limits = subject.limits() | {"min_depth": inf, "drop_floaters": True}
            values = {
                name: value for name, value in limits.items() if getattr(self, name) == LIMITS[name].default
            }
        return replace(self, subject=subject, **values)


NO_CLEANING = Cleaning()
LIMITS = settings_of(Cleaning)
"""The settings of the tests, by name. Blender's tools start with the values ``start``."""


@dataclass(frozen=True)
class Unwanted:
    """Splats of a bundle to remove.

    Attributes:
        matches: the splats that each test matches, by its name; without dependent splats.
        remaining: the splats that no test matches.
        relations: of the bundle's splats.
    """

    matches: Mapping[str, Masks]
    remaining: Masks
    relations: Relations


def clean_bundle(bundle: Bundle, cleaning: Cleaning) -> Bundle:
    """Return a bundle without the unwanted splats.

    Reads all splats once, and again when they are written. Needs some dozens of bytes of memory per splat.

    Raises:
        LodgsError: see :func:`keep_splats`.
    """
    unwanted = find_unwanted(bundle, cleaning)
    return keep_splats(bundle, unwanted.remaining, unwanted.relations)


def find_unwanted(bundle: Bundle, cleaning: Cleaning) -> Unwanted:
    """Apply all tests to a bundle's splats. Reads each level once, those of the subject twice."""
    cleaning = cleaning.for_bundle(bundle)
    related = resolve_rule(bundle.rule).relations
    matches: dict[str, dict[int, np.ndarray]] = {}
    remaining, means, columns = {}, {}, {}
    for level in bundle.levels:
        batches = [
            (cleaning.matches(splats), splats.means, relation_columns(splats, related))
            for splats in read_batches(level.rows)
        ]
        remaining[level.number] = np.ones(len(level.rows), bool)
        for name in batches[0][0]:
            mask = np.concatenate([matching[name] for matching, _, _ in batches])
            matches.setdefault(name, {})[level.number] = mask
            remaining[level.number] &= ~mask
        if cleaning.drop_floaters:
            means[level.number] = np.concatenate([batch_means for _, batch_means, _ in batches])
        columns[level.number] = {
            name: np.concatenate([batch[name] for _, _, batch in batches]) for name in related.columns
        }
    relations = related(columns)
    if cleaning.drop_floaters:
        tested = {number: mask.copy() for number, mask in remaining.items()}
        exclude_floaters(remaining, means, relations, cleaning.gap, cleaning.share)
        if cleaning.clutter and cleaning.subject is not None:
            for number, mask in remaining.items():
                mask |= tested[number] & ~cleaning.subject.near(means[number])
        matches["drop_floaters"] = {number: mask & ~remaining[number] for number, mask in tested.items()}
    testable = {name: relations.testable(masks) for name, masks in matches.items()}
    return Unwanted(testable, remaining, relations)


def exclude_floaters(
    masks: dict[int, np.ndarray],
    means: Mapping[int, np.ndarray],
    relations: Relations,
    gap: float,
    share: float,
) -> None:
    """Remove floaters among the testable splats from the masks of remaining splats, (N,) bool.

    Args:
        means: (N, 3) of each level.
    """
    rows = {number: np.flatnonzero(mask) for number, mask in relations.testable(masks).items()}
    tested_means = np.concatenate([means[number][level_rows] for number, level_rows in rows.items()])
    floating = find_floaters(tested_means, gap, share)
    begin = 0
    for number, level_rows in rows.items():
        masks[number][level_rows[floating[begin : begin + len(level_rows)]]] = False
        begin += len(level_rows)


def keep_splats(bundle: Bundle, masks: Masks, relations: Relations | None = None) -> Bundle:
    """Return a bundle with only the splats of the masks, (N,) bool each, and updated tables.

    Dependent splats follow the others, see ``rule.Relations.pruned``.

    Args:
        relations: of the splats, if already computed.

    Raises:
        LodgsError: no splats remain, or the bundle has tables of an unknown rule.
    """
    rule = find_rule(bundle.rule)
    if bundle.rule and rule is None and bundle.tables.keys() - set(VIEW_TABLES):
        raise LodgsError(*unknown_rule_error(bundle.rule))
    masks, changed = (relations or read_relations(bundle)).pruned(masks)
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
        raise LodgsError("Cannot edit the splats: none remain.", "Check the crops and limits.")
    tables = dict(bundle.tables)
    if BLOCKS in tables and rule is not None:
        tables[BLOCKS] = block_table(rule.block_bounds, _rule_columns(rule, levels, changed))
    return replace(bundle, levels=levels, tables=tables)


def _rule_columns(
    rule: Rule, levels: Sequence[Level], changed: Mapping[int, Columns]
) -> Iterator[tuple[int, Columns]]:
    """Yield level numbers with the rule's columns of consecutive rows, changed or as in their source."""
    for level in levels:
        if level.number in changed:
            yield level.number, changed[level.number]
            continue
        for splats in read_batches(level.rows):
            yield level.number, rule_columns(rule, splats)


def read_relations(bundle: Bundle) -> Relations:
    """Return the relations of a bundle's splats."""
    related = resolve_rule(bundle.rule).relations
    columns: dict[int, Columns] = {}
    for level in bundle.levels if related.columns else ():
        batches = [relation_columns(splats, related) for splats in read_batches(level.rows)]
        columns[level.number] = {
            name: np.concatenate([batch[name] for batch in batches]) for name in related.columns
        }
    return related(columns)


def relation_columns(splats: Splats, related: type[Relations]) -> Columns:
    """Return the columns (N,) that determine relations; missing ones are zeros."""
    available = splats.extras | dict(zip("xyz", splats.means.T, strict=True))
    zeros = np.zeros(len(splats), np.float32)
    return {name: available.get(name, zeros) for name in related.columns}


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

    def select(self, index: slice | np.ndarray, /) -> Splats:
        """Read rows of the subset."""
        splats = self.source.select(self.rows[index])
        splats.extras |= {name: column[index] for name, column in self.columns.items()}
        return splats


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
    neighbors = [(x << 42) + (y << 21) + z for x, y, z in steps if (x, y, z) > (0, 0, 0)]
    pairs = []
    for step in neighbors:
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
