"""By what one eye's splats of a level are chosen, as plain values: they compare, and travel as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..scenes.cameras import Camera
from .blocks import SIZE, Blocks
from .crop import Crop, crop_mask
from .rule import HIDDEN, NO_RULE, OPACITY, Region, Rule, Tables, all_rule_columns, rules

Column = tuple[str, str, bytes]
"""A column of a table: its name, its type, its rows."""


@dataclass(frozen=True)
class LodQuery:
    """By what a level's splats are chosen: a rule with all its arguments but the splats. Choices compare.

    Attributes:
        rule: its name.
        eye: in the splats' own space.
        focal_px: the eye's focal length in pixels.
        facts, values: see ``rule.Rule.weights``, as pairs.
        tables: those that the rule reads: name, columns by name, each as its type and its bytes.
        crops: what is left of the splats before the rule chooses: those that are not HIDDEN, and that these
            keep; None: all of them, hidden or not.
    """

    rule: str
    eye: tuple[float, float, float]
    focal_px: float
    facts: tuple[tuple[str, float], ...]
    values: tuple[tuple[str, float], ...]
    tables: tuple[tuple[str, tuple[Column, ...]], ...] = ()
    crops: tuple[Crop, ...] | None = None

    @classmethod
    def from_crops(cls, crops: tuple[Crop, ...]) -> LodQuery:
        """All that crops leave, without a rule."""
        return cls(NO_RULE.name, (0.0, 0.0, 0.0), 1.0, (), (), crops=crops)

    @property
    def how(self) -> Rule:
        """The rule itself."""
        return rules()[self.rule] if self.rule else NO_RULE

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that :meth:`weights` asks for."""
        return self.how.columns if self.crops is None else (*self.how.columns, HIDDEN)

    def weights(self, means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) weights of splats at means (N, 3) with columns (N,) by name; those that crops leave out, and
        hidden ones, have none, and are not there for the rule."""
        eye, facts, values = np.array(self.eye, np.float32), dict(self.facts), dict(self.values)

        def weigh(means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
            return self.how.weights(means, eye, self.focal_px, columns, facts, values, self._tables())

        if self.crops is None:
            return weigh(means, columns)
        there = crop_mask(self.crops, means)
        if HIDDEN in columns:
            there &= columns[HIDDEN] == 0
        if there.all():
            return weigh(means, columns)
        weights, some = np.zeros(len(means), np.float32), np.flatnonzero(there)
        own = {name: columns[name][some] for name in self.how.columns}
        weights[some] = weigh(means[some], own)
        return weights

    def distance_band(self, highest: Mapping[str, np.ndarray]) -> tuple[float, float | np.ndarray]:
        """See ``Rule.distance_band``."""
        return self.how.distance_band(self.focal_px, dict(self.facts), dict(self.values), highest)

    def region(self) -> Region | None:
        """See ``Rule.region``."""
        return self.how.region(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def visible_in_region(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) bool: see ``Rule.visible_in_region``, of the region that there must be."""
        region = self.region()
        assert region is not None
        return self.how.visible_in_region(columns, region)

    def region_label(self) -> str:
        """See ``Rule.region_label``."""
        return self.how.region_label(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def inactive_controls(self) -> Mapping[str, str]:
        """See ``Rule.inactive_controls``."""
        return self.how.inactive_controls(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def parts(self, means: np.ndarray) -> np.ndarray:
        """(N,) numbers of the parts of space where places are: see ``Rule.parts``."""
        return self.how.parts(means, self._tables())

    def told_level(self, columns: Mapping[str, np.ndarray]) -> np.ndarray | float:
        """(N,) the level of splats with the rule's columns (N,): see ``Rule.told_level``."""
        return self.how.told_level(columns, dict(self.facts))

    def wanted_level(self, means: np.ndarray) -> np.ndarray:
        """(N,) the level that is wanted at each place."""
        eye, facts, values = np.array(self.eye, np.float32), dict(self.facts), dict(self.values)
        return self.how.wanted_level(means, eye, self.focal_px, facts, values)

    def coarser(self, levels: Sequence[int]) -> LodQuery | None:
        """The next coarser choice, where there is one."""
        values = self.how.coarser(dict(self.values), levels)
        return None if values is None else replace(self, values=tuple(values.items()))

    def _tables(self) -> Tables:
        return {
            name: {column: np.frombuffer(rows, kind) for column, kind, rows in columns}
            for name, columns in self.tables
        }

    def as_dict(self) -> dict:
        """The same as JSON has it."""
        tables = {
            name: {column: rows.tolist() for column, rows in columns.items()}
            for name, columns in self._tables().items()
        }
        return {
            "rule": self.rule, "eye": list(self.eye), "focal_px": self.focal_px,
            "facts": dict(self.facts), "values": dict(self.values), "tables": tables,
            "crops": None if self.crops is None else [crop.as_dict() for crop in self.crops],
        }  # fmt: skip


class SplatSelector:
    """The splats of one set, from which one choice after the other is made.

    While the eye stays in a region (``Rule.region``), only what may be shown there is looked at. Of splats
    that stand together in rows (``blocks.spatial_order``) those blocks are passed over that are out of the
    rule's reach (``Rule.distance_band``), or out of sight.

    Args:
        means: (N, 3).
        columns: (N,) by name, OPACITY among them; those that are missing are zeros.
        log_scales: (N, 3), where blocks are to be passed over.
    """

    def __init__(
        self, means: np.ndarray, columns: Mapping[str, np.ndarray], log_scales: np.ndarray | None = None
    ) -> None:
        nothing = np.broadcast_to(np.float32(0), len(means))
        known = dict.fromkeys([*all_rule_columns(), OPACITY], nothing) | dict(columns)
        self._all, self._log_scales = _Part.of(None, means, known, log_scales), log_scales
        self._near: tuple[str, Region, _Part] | None = None
        self._last: tuple[LodQuery | None, tuple[np.ndarray, np.ndarray]] | None = None

    def chosen(
        self, choice: LodQuery | None, camera: Camera | None = None, near: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """The splats that have a weight, (M,) int32 ascending, and their weights (M,) float32.

        Those of one choice are found once, but for a camera: then blocks that are not in its image are left
        out.

        Args:
            choice: None: all have the weight 1.
            near: depth at which the camera's drawing begins.
        """
        if camera is not None:
            return self._choose(choice, camera, near)
        if self._last is None or self._last[0] != choice:
            self._last = choice, self._choose(choice, None, 0.0)
        return self._last[1]

    def _part(self, choice: LodQuery) -> tuple[_Part, bool]:
        """What is to be looked at, and whether that is of a region."""
        region, every = choice.region(), self._all
        if region is None:
            return every, False
        if self._near is None or self._near[:2] != (choice.rule, region):
            rows = np.flatnonzero(choice.visible_in_region(every.columns)).astype(np.int32)
            if len(rows) < len(every.means):
                columns = {name: every.columns[name][rows] for name in (*choice.how.columns, HIDDEN)}
                log_scales = None if self._log_scales is None else self._log_scales[rows]
                every = _Part.of(rows, every.means[rows], columns, log_scales)
            self._near = choice.rule, region, every
        return self._near[2], True

    def _choose(
        self, choice: LodQuery | None, camera: Camera | None, near: float
    ) -> tuple[np.ndarray, np.ndarray]:
        part, in_region = (self._all, False) if choice is None else self._part(choice)
        blocks, means, rows = part.blocks, part.means, part.rows
        rule = None if choice is None else choice.how
        columns = {} if choice is None else {name: part.columns[name] for name in choice.columns}

        def weigh(means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
            return np.ones(len(means), np.float32) if choice is None else choice.weights(means, columns)

        if blocks is None:
            weights = weigh(means, columns)
        else:
            seen, whole = np.ones(len(blocks.low), bool), np.full(len(blocks.low), choice is None)
            if choice is not None and rule is not None and rule.apart and not in_region:
                eye, band = np.array(choice.eye, np.float32), choice.distance_band(part.highest(rule))
                seen, inside = blocks.between(eye, *band)
                if rule.binary and choice.crops is None:
                    whole = inside
            if camera is not None and seen.any():
                seen = seen & blocks.in_view(camera, near)
            if not seen.any():
                return np.zeros(0, np.int32), np.zeros(0, np.float32)
            rows = blocks.rows(seen) if rows is None else blocks.of_rows(seen, rows)
            if rule is not None and not rule.apart:
                weights = blocks.of_rows(seen, weigh(means, columns))
            else:
                asked = seen & ~whole
                if not asked.any():
                    return rows, np.ones(len(rows), np.float32)
                columns = {name: blocks.of_rows(asked, column) for name, column in columns.items()}
                weights = weigh(blocks.of_rows(asked, means), columns)
                if (seen & whole).any():  # which is of flat rules: their weights are 0 or 1
                    crop_mask = np.ones(len(rows), bool)
                    crop_mask[np.repeat(asked[seen], SIZE)[: len(rows)]] = weights > 0
                    rows = rows[crop_mask]
                    return rows, np.ones(len(rows), np.float32)
        some = np.flatnonzero(weights > 0)
        found = some.astype(np.int32) if rows is None else rows[some]
        return found, weights[some].astype(np.float32)


@dataclass
class _Part:
    """Splats to choose from: which they are (None: all), and what is known of them."""

    rows: np.ndarray | None
    means: np.ndarray
    columns: Mapping[str, np.ndarray]
    blocks: Blocks | None
    _highest: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, rows, means: np.ndarray, columns: Mapping[str, np.ndarray], log_scales) -> _Part:
        return cls(rows, means, columns, None if log_scales is None else Blocks.of(means, log_scales))

    def highest(self, rule: Rule) -> Mapping[str, np.ndarray]:
        """(B,) the greatest value in each block of each of a rule's columns."""
        assert self.blocks is not None
        for name in rule.columns:
            if name not in self._highest:
                self._highest[name] = self.blocks.highest(self.columns[name])
        return self._highest
