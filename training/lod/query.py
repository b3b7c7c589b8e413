"""Arguments of a level-of-detail rule for one camera, and selection of splats with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..scenes.cameras import Camera
from ..splats.gaussians import Splats
from ..splats.levels import Bundle
from .blocks import SIZE, BlockIndex
from .crop import Crop, crop_mask
from .rule import HIDDEN, NO_RULE, OPACITY, Region, Rule, Tables, all_rule_columns, rules

Column = tuple[str, str, bytes]
"""A column of a table: name, dtype, bytes of the rows."""


@dataclass(frozen=True)
class LodQuery:
    """Arguments of a level-of-detail rule for one camera and level. Hashable and JSON-serialisable.

    Attributes:
        rule: name of the rule.
        position: camera position in the splats' space.
        focal_px: focal length of the camera in pixels.
        facts, values: see ``rule.Rule.weights``, as pairs.
        tables: the rule's tables: name, columns by name, each as its dtype and bytes.
        crops: the rule sees only splats that are inside these crops and not HIDDEN; None means all splats.
    """

    rule: str
    position: tuple[float, float, float]
    focal_px: float
    facts: tuple[tuple[str, float], ...]
    values: tuple[tuple[str, float], ...]
    tables: tuple[tuple[str, tuple[Column, ...]], ...] = ()
    crops: tuple[Crop, ...] | None = None

    @classmethod
    def from_crops(cls, crops: tuple[Crop, ...]) -> LodQuery:
        """Return a query without a rule, for all splats inside crops."""
        return cls(NO_RULE.name, (0.0, 0.0, 0.0), 1.0, (), (), crops=crops)

    @property
    def resolved_rule(self) -> Rule:
        """The rule."""
        return rules()[self.rule] if self.rule else NO_RULE

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that :meth:`weights` needs."""
        return self.resolved_rule.columns if self.crops is None else (*self.resolved_rule.columns, HIDDEN)

    def weights(self, means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return weights (N,) of splats at means (N, 3) with columns (N,) by name.

        Cropped and hidden splats have weight 0 and do not affect the others.
        """
        facts = dict(self.facts)
        values = dict(self.values)

        def weigh(means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
            return self.resolved_rule.weights(
                means, self._position, self.focal_px, columns, facts, values, self._tables()
            )

        if self.crops is None:
            return weigh(means, columns)
        visible = crop_mask(self.crops, means)
        if HIDDEN in columns:
            visible &= columns[HIDDEN] == 0
        if visible.all():
            return weigh(means, columns)
        weights = np.zeros(len(means), np.float32)
        rows = np.flatnonzero(visible)
        weights[rows] = weigh(means[rows], {name: columns[name][rows] for name in self.resolved_rule.columns})
        return weights

    def distance_band(self, highest: Mapping[str, np.ndarray]) -> tuple[float, float | np.ndarray]:
        """Return the distance band, see ``Rule.distance_band``."""
        return self.resolved_rule.distance_band(self.focal_px, dict(self.facts), dict(self.values), highest)

    def region(self) -> Region | None:
        """Return the camera's region, see ``Rule.region``."""
        return self.resolved_rule.region(self._position, dict(self.values), self._tables())

    def visible_in_region(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return (N,) bool, see ``Rule.visible_in_region``; the camera must be in a region."""
        region = self.region()
        assert region is not None
        return self.resolved_rule.visible_in_region(columns, region)

    def region_label(self) -> str:
        """Return a description of the region, see ``Rule.region_label``."""
        return self.resolved_rule.region_label(self._position, dict(self.values), self._tables())

    def inactive_controls(self) -> Mapping[str, str]:
        """Return controls without effect, see ``Rule.inactive_controls``."""
        return self.resolved_rule.inactive_controls(self._position, dict(self.values), self._tables())

    def part_numbers(self, means: np.ndarray) -> np.ndarray:
        """Return (N,) numbers of parts of space, see ``Rule.part_numbers``."""
        return self.resolved_rule.part_numbers(means, self._tables())

    def splat_level(self, columns: Mapping[str, np.ndarray]) -> np.ndarray | float:
        """Return the level (N,) of splats with columns (N,), see ``Rule.splat_level``."""
        return self.resolved_rule.splat_level(columns, dict(self.facts))

    def target_level(self, means: np.ndarray) -> np.ndarray:
        """Return the level (N,) that the rule aims at, see ``Rule.target_level``."""
        facts = dict(self.facts)
        return self.resolved_rule.target_level(means, self._position, self.focal_px, facts, dict(self.values))

    def coarser(self, levels: Sequence[int]) -> LodQuery | None:
        """Return the query for the next coarser detail; None if there is none."""
        values = self.resolved_rule.coarser(dict(self.values), levels)
        return None if values is None else replace(self, values=tuple(values.items()))

    @property
    def _position(self) -> np.ndarray:
        return np.array(self.position, np.float32)

    def _tables(self) -> Tables:
        return {
            name: {column: np.frombuffer(rows, kind) for column, kind, rows in columns}
            for name, columns in self.tables
        }

    def as_dict(self) -> dict:
        """Return the query as a JSON-serialisable dict."""
        tables = {
            name: {column: rows.tolist() for column, rows in columns.items()}
            for name, columns in self._tables().items()
        }
        return {
            "rule": self.rule, "position": list(self.position), "focal_px": self.focal_px,
            "facts": dict(self.facts), "values": dict(self.values), "tables": tables,
            "crops": None if self.crops is None else [crop.as_dict() for crop in self.crops],
        }  # fmt: skip


@dataclass(frozen=True)
class PageUpdate:
    """Pages to copy into memory.

    Attributes:
        pages: first row in memory, and splats, of each page.
        columns: new values of all rows in memory, (rows,) each, for the rule; its other columns are those of
            the splats.
    """

    pages: list[tuple[int, Splats]]
    columns: dict[str, np.ndarray]


class Pager(Protocol):
    """Reader of the pages of a file that a camera needs, in a thread.

    The caller owns the memory of ``rows`` splats and copies updates into it (:meth:`take`), where new pages
    replace old ones. Then the weights of the rule give a complete selection of the splats in memory.

    Attributes:
        rows: number of rows in memory; initially all are empty, and have weight 0.
        sh_degree: degree of the splats.
        arrived: number of updates so far.
        short: whether the camera needs more than the budget.
        problem: error that ended the thread, else "".
    """

    rows: int
    sh_degree: int
    arrived: int
    short: bool
    problem: str

    @property
    def splats(self) -> int:
        """Number of splats in memory or being read."""
        ...

    @property
    def idle(self) -> bool:
        """True if the caller has taken all pages that fit the budget, or the thread has ended."""
        ...

    def start(self) -> None:
        """Start the thread, which reads the first pages of the file, then requested ones."""

    def stop(self) -> None:
        """Stop the thread, without waiting for reads from a slow disk."""

    def ask(self, query: LodQuery, direction: Sequence[float] | None = None) -> None:
        """Request the pages that a query selects. Returns immediately.

        Args:
            direction: (3,) of length 1, the view direction: pages outside the view come later; None means the
                camera looks in all directions.
        """

    def take(self) -> PageUpdate | None:
        """Return the next update, if there is one; the caller must apply it before the next call."""


class PagedFile(Protocol):
    """A partly loaded bundle: only the splats that a camera needs are in memory, see ``Rule.paged_file``.

    Attributes:
        bundle: the bundle without splats.
        total: number of splats in the file.
    """

    bundle: Bundle
    total: int

    def visible(self, query: LodQuery, camera: Camera | None = None, near: float = 0.0) -> dict[int, Splats]:
        """Return by level number the drawable splats that a query selects.

        Args:
            camera: camera in the splats' space; skip blocks outside its image.
            near: depth where its image begins, in the splats' units.
        """
        ...

    def top(self, budget: int) -> Bundle:
        """Read the coarsest splats as a smaller, complete bundle.

        Args:
            budget: maximum number of splats.

        Raises:
            LodgsError: the file cannot be read, or the budget is too small.
        """
        ...

    def pager(self, budget: int) -> Pager:
        """Return a pager, not started yet, for a maximum number of splats in memory.

        Raises:
            LodgsError: the budget is too small.
        """
        ...


class SplatSelector:
    """Selection of splats from one set, for one query after another.

    While the camera stays in a region (``Rule.region``), only splats of that region are evaluated. If rows
    are sorted by space (``blocks.spatial_order``), blocks outside the rule's distance band
    (``Rule.distance_band``) or outside the image are skipped.

    Args:
        means: (N, 3).
        columns: (N,) by name, with OPACITY; missing ones count as zeros.
        log_scales: (N, 3), to skip blocks; None evaluates all splats.
    """

    def __init__(
        self, means: np.ndarray, columns: Mapping[str, np.ndarray], log_scales: np.ndarray | None = None
    ) -> None:
        zeros = np.broadcast_to(np.float32(0), len(means))
        all_columns = dict.fromkeys([*all_rule_columns(), OPACITY], zeros) | dict(columns)
        self._all = _Subset.of(None, means, all_columns, log_scales)
        self._log_scales = log_scales
        self._region: tuple[str, Region, _Subset] | None = None
        self._last: tuple[LodQuery | None, tuple[np.ndarray, np.ndarray]] | None = None

    def select(
        self, query: LodQuery | None, camera: Camera | None = None, near: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of splats with a weight, (M,) int32 ascending, and their weights (M,) float32.

        Without a camera, the result of the last query is cached.

        Args:
            query: None: all splats have weight 1.
            camera: skip blocks outside its image; None keeps them.
            near: depth where the camera's image begins.
        """
        if camera is not None:
            return self._select(query, camera, near)
        if self._last is None or self._last[0] != query:
            self._last = query, self._select(query, None, 0.0)
        return self._last[1]

    def _subset(self, query: LodQuery) -> tuple[_Subset, bool]:
        """Return the splats to evaluate, and whether they are those of a region."""
        region = query.region()
        subset = self._all
        if region is None:
            return subset, False
        if self._region is None or self._region[:2] != (query.rule, region):
            rows = np.flatnonzero(query.visible_in_region(subset.columns)).astype(np.int32)
            if len(rows) < len(subset.means):
                columns = {
                    name: subset.columns[name][rows] for name in (*query.resolved_rule.columns, HIDDEN)
                }
                log_scales = None if self._log_scales is None else self._log_scales[rows]
                subset = _Subset.of(rows, subset.means[rows], columns, log_scales)
            self._region = query.rule, region, subset
        return self._region[2], True

    def _select(
        self, query: LodQuery | None, camera: Camera | None, near: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (M,) int32 and weights (M,) float32 of splats with a weight above 0.

        Args:
            query: rule and arguments; None gives all splats the weight 1.
            camera: skip blocks outside of its image; None skips none.
            near: depth of the near plane.
        """
        subset, in_region = (self._all, False) if query is None else self._subset(query)
        columns = {} if query is None else {name: subset.columns[name] for name in query.columns}
        if subset.blocks is None:
            weights = _weigh(query, subset.means, columns)
            return _with_weight(subset.rows, weights)
        blocks = subset.blocks
        visible, full = self._blocks_to_evaluate(query, subset, in_region)
        if camera is not None and visible.any():
            visible = visible & blocks.in_view(camera, near)
        if not visible.any():
            return np.zeros(0, np.int32), np.zeros(0, np.float32)
        rows = blocks.rows(visible) if subset.rows is None else blocks.of_rows(visible, subset.rows)
        if query is not None and not query.resolved_rule.independent:
            return _with_weight(rows, blocks.of_rows(visible, _weigh(query, subset.means, columns)))
        evaluated = visible & ~full
        if not evaluated.any():
            return rows, np.ones(len(rows), np.float32)
        columns = {name: blocks.of_rows(evaluated, column) for name, column in columns.items()}
        weights = _weigh(query, blocks.of_rows(evaluated, subset.means), columns)
        if (visible & full).any():  # inside the band, weights are 0 or 1
            selected = np.ones(len(rows), bool)
            selected[np.repeat(evaluated[visible], SIZE)[: len(rows)]] = weights > 0
            rows = rows[selected]
            return rows, np.ones(len(rows), np.float32)
        return _with_weight(rows, weights)

    def _blocks_to_evaluate(
        self, query: LodQuery | None, subset: _Subset, in_region: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (B,) bool: blocks in the distance band, and blocks where all splats have weight 1."""
        assert subset.blocks is not None
        count = len(subset.blocks)
        visible = np.ones(count, bool)
        full = np.full(count, query is None)
        if query is not None and not in_region:
            band = query.distance_band(subset.maxima(query.resolved_rule))
            visible, inside = subset.blocks.in_band(np.array(query.position, np.float32), *band)
            if query.resolved_rule.fills_band(dict(query.values)) and query.crops is None:
                full = inside
        return visible, full


def _weigh(query: LodQuery | None, means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.ones(len(means), np.float32) if query is None else query.weights(means, columns)


def _with_weight(rows: np.ndarray | None, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (None: all) and weights of splats whose weight is above 0."""
    positive = np.flatnonzero(weights > 0)
    selected = positive.astype(np.int32) if rows is None else rows[positive]
    return selected, weights[positive].astype(np.float32)


@dataclass
class _Subset:
    """Splats to select from: their rows (None: all), means, columns and blocks."""

    rows: np.ndarray | None
    means: np.ndarray
    columns: Mapping[str, np.ndarray]
    blocks: BlockIndex | None

    @classmethod
    def of(
        cls,
        rows: np.ndarray | None,
        means: np.ndarray,
        columns: Mapping[str, np.ndarray],
        log_scales: np.ndarray | None,
    ) -> _Subset:
        return cls(rows, means, columns, None if log_scales is None else BlockIndex.of(means, log_scales))

    def maxima(self, rule: Rule) -> Mapping[str, np.ndarray]:
        """Return the columns of the blocks, (B,), with the maximum of each of a rule's columns."""
        assert self.blocks is not None
        self.blocks.add_maxima({name: self.columns[name] for name in rule.columns})
        return self.blocks.columns
