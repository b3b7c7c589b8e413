"""By what one eye's splats of a level are chosen, as plain values: they compare, and travel as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .rule import OPACITY, Region, Tables, every_column, rules

Column = tuple[str, str, bytes]
"""A column of a table: its name, its type, its rows."""


@dataclass(frozen=True)
class Choice:
    """By what a level's splats are chosen: a rule with all its arguments but the splats. Choices compare.

    Attributes:
        rule: its name.
        eye: in the splats' own space.
        focal_px: the eye's focal length in pixels.
        facts, values: see ``rule.Rule.weights``, as pairs.
        tables: those that the rule reads: name, columns by name, each as its type and its bytes.
    """

    rule: str
    eye: tuple[float, float, float]
    focal_px: float
    facts: tuple[tuple[str, float], ...]
    values: tuple[tuple[str, float], ...]
    tables: tuple[tuple[str, tuple[Column, ...]], ...] = ()

    def weights(self, means: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) weights of splats at means (N, 3) with the rule's columns (N,) by name."""
        rule = rules()[self.rule]
        eye, facts, values = np.array(self.eye, np.float32), dict(self.facts), dict(self.values)
        return rule.weights(means, eye, self.focal_px, columns, facts, values, self._tables())

    def region(self) -> Region | None:
        """See ``Rule.region``."""
        return rules()[self.rule].region(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def loaded(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N,) bool: see ``Rule.loaded``, of the region that there must be."""
        region = self.region()
        assert region is not None
        return rules()[self.rule].loaded(columns, region)

    def where(self) -> str:
        """See ``Rule.where``."""
        return rules()[self.rule].where(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def idle(self) -> Mapping[str, str]:
        """See ``Rule.idle``."""
        return rules()[self.rule].idle(np.array(self.eye, np.float32), dict(self.values), self._tables())

    def parts(self, means: np.ndarray) -> np.ndarray:
        """(N,) numbers of the parts of space where places are: see ``Rule.parts``."""
        return rules()[self.rule].parts(means, self._tables())

    def told_level(self, columns: Mapping[str, np.ndarray]) -> np.ndarray | float:
        """(N,) the level of splats with the rule's columns (N,): see ``Rule.told_level``."""
        return rules()[self.rule].told_level(columns, dict(self.facts))

    def wanted_level(self, means: np.ndarray) -> np.ndarray:
        """(N,) the level that is wanted at each place."""
        eye, facts, values = np.array(self.eye, np.float32), dict(self.facts), dict(self.values)
        return rules()[self.rule].wanted_level(means, eye, self.focal_px, facts, values)

    def coarser(self, levels: Sequence[int]) -> Choice | None:
        """The next coarser choice, where there is one."""
        values = rules()[self.rule].coarser(dict(self.values), levels)
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
        }  # fmt: skip


class Chooser:
    """The splats of one set, from which one choice after the other is made.

    While the eye stays in a region (``Rule.region``), only what may be shown there is looked at.

    Args:
        means: (N, 3).
        columns: (N,) by name, OPACITY among them; those that are missing are zeros.
    """

    def __init__(self, means: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        nothing = np.broadcast_to(np.float32(0), len(means))
        self._means, self._columns = means, dict.fromkeys([*every_column(), OPACITY], nothing) | dict(columns)
        self._near: tuple[str, Region, np.ndarray, np.ndarray, dict[str, np.ndarray]] | None = None
        self._last: tuple[Choice, tuple[np.ndarray, np.ndarray]] | None = None

    def chosen(self, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
        """The splats that have a weight, (M,) ascending, and their weights (M,) float32.

        Those of one choice are found once.
        """
        if self._last is None or self._last[0] != choice:
            self._last = choice, self._choose(choice)
        return self._last[1]

    def _choose(self, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
        region = choice.region()
        if region is None:
            weights = choice.weights(self._means, self._columns)
            some = np.flatnonzero(weights > 0)
            return some, weights[some].astype(np.float32)
        if self._near is None or self._near[:2] != (choice.rule, region):
            rows = np.flatnonzero(choice.loaded(self._columns))
            columns = {name: self._columns[name][rows] for name in rules()[choice.rule].columns}
            self._near = choice.rule, region, rows, self._means[rows], columns
        _, _, rows, means, columns = self._near
        weights = choice.weights(means, columns)
        some = np.flatnonzero(weights > 0)
        return rows[some], weights[some].astype(np.float32)
