"""Selection of splats of a bundle for a camera, with a weight in [0, 1] on each opacity."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import LodgsError
from ..splats.gaussians import Splats
from ..splats.levels import Bundle, Level
from .rule import OPACITY, Rule, Values, collect_facts, find_rule, resolve_rule


@dataclass
class SelectedLevel:
    """Selected splats of one level.

    Attributes:
        number: number of the level.
        splats: splats with a weight above 0.
        weights: (N,); None if all are 1.
    """

    number: int
    splats: Splats
    weights: np.ndarray | None = None


def check_rule(bundle: Bundle) -> Rule | None:
    """Return the rule of a bundle; None if it has none, or an unknown one.

    Raises:
        LodgsError: the bundle contradicts its rule.
    """
    rule = find_rule(bundle.rule)
    if rule is not None and rule.cumulative != bundle.cumulative:
        actual, expected = (
            "add up" if cumulative else "replace one another"
            for cumulative in (bundle.cumulative, rule.cumulative)
        )
        raise LodgsError(
            f"Cannot apply the rule '{rule.name}': levels {actual} in the file, but must {expected}.",
            "Another program may have changed the file; export it again.",
        )
    if rule is not None:
        try:
            rule.check(bundle.tables)
        except ValueError as error:
            raise LodgsError(
                f"Cannot apply the rule '{rule.name}': {error}.",
                "Export or train the levels again.",
            ) from error
    return rule


def require_rule(bundle: Bundle) -> Rule:
    """Return the rule of a bundle.

    Raises:
        LodgsError: no rule, an unknown one, or the bundle contradicts it.
    """
    rule = check_rule(bundle)
    if rule is None:
        raise LodgsError(*unknown_rule_error(bundle.rule))
    return rule


def unknown_rule_error(name: str) -> tuple[str, str]:
    """Return error and remedy for a missing or unknown rule."""
    if not name:
        return "These levels cannot be selected by distance.", "Omit the options for selection by distance."
    return (
        f"The rule '{name}' of these levels is unknown to this version.",
        "Update LODGS. Until then, the finest level is shown.",
    )


def resolve_controls(bundle: Bundle, changes: Values) -> Values:
    """Return a value for every control of a bundle's rule: changed, else the bundle's, else the default.

    Raises:
        LodgsError: see :func:`require_rule`; unknown control, invalid value, or no level in use.
    """
    numbers = [level.number for level in bundle.levels]
    return require_rule(bundle).resolve_controls(changes, numbers, bundle.controls)


def select(
    bundle: Bundle, position: np.ndarray, focal_px: float, values: Values
) -> tuple[Splats, np.ndarray | None]:
    """Return a copy of the splats that a bundle's rule selects for a camera, and their weights (None: all 1).

    For many cameras, use :class:`BundleSelector`.

    Args:
        position: (3,) world position of the camera.
        focal_px: focal length of the camera in pixels (``Camera.focal``).
        values: values of the rule's controls, see :func:`resolve_controls`.

    Raises:
        LodgsError: see :func:`require_rule`, or the rule's facts are incomplete.
    """
    levels = select_levels(bundle, position, focal_px, values)
    splats = Splats.concatenated([level.splats for level in levels])
    if all(level.weights is None for level in levels):
        return splats, None
    weights = [
        np.ones(len(level.splats), np.float32) if level.weights is None else level.weights for level in levels
    ]
    return splats, np.concatenate(weights)


def select_levels(
    bundle: Bundle, position: np.ndarray, focal_px: float, values: Values
) -> list[SelectedLevel]:
    """Return the selected splats level by level, coarse to fine, as :func:`select`; possibly empty levels."""
    selected = []
    level_weights = BundleSelector(bundle).level_weights(position, focal_px, values)
    for level, weights in zip(bundle.levels, level_weights, strict=True):
        positive = weights > 0
        splats = level.splats.select(positive)
        weights = weights[positive]
        selected.append(SelectedLevel(level.number, splats, None if (weights == 1).all() else weights))
    return selected


class BundleSelector:
    """Selector of a bundle's splats for many cameras, which copies no splats.

    Callers keep ``splats`` where they render, for example on a GPU; splats of weight 0 cost a rasterizer next
    to nothing.

    Raises:
        LodgsError: see :func:`require_rule`, or the rule's facts are incomplete.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._rule = require_rule(bundle)
        self._levels = bundle.levels
        self._tables = bundle.tables
        facts = [(level.number, level.facts) for level in bundle.levels]
        self._inputs = [
            (
                rule_columns(self._rule, level.splats),
                collect_facts(self._rule, bundle.facts, facts, level.number),
            )
            for level in bundle.levels
        ]

    @cached_property
    def splats(self) -> Splats:
        """Splats of all levels, coarse to fine."""
        return Splats.concatenated([level.splats for level in self._levels])

    def level_weights(self, position: np.ndarray, focal_px: float, values: Values) -> list[np.ndarray]:
        """Return the weights (N,) of each level's N splats; arguments as for :func:`select`."""
        position = np.asarray(position, np.float32)
        return [
            self._rule.weights(level.splats.means, position, focal_px, columns, facts, values, self._tables)
            for level, (columns, facts) in zip(self._levels, self._inputs, strict=True)
        ]

    def loaded(self, position: np.ndarray, values: Values) -> int:
        """Return the number of splats that a viewer loads at a camera position: those of the rule's region,
        or all without one.
        """
        region = self._rule.region(position, values, self._tables)
        if region is None:
            return sum(len(level.splats) for level in self._levels)
        return sum(int(self._rule.visible_in_region(columns, region).sum()) for columns, _ in self._inputs)

    def weights(self, position: np.ndarray, focal_px: float, values: Values) -> np.ndarray:
        """Return the weights (N,) of ``splats``; weight 0 means not drawn."""
        return np.concatenate(self.level_weights(position, focal_px, values))


def rule_columns(rule: Rule, splats: Splats) -> dict[str, np.ndarray]:
    """Return a rule's columns of splats, (N,) float32 by name; missing ones are zeros."""
    zeros = np.broadcast_to(np.float32(0), len(splats))
    columns = {name: splats.extras.get(name, zeros) for name in rule.columns}
    if OPACITY in columns:
        columns[OPACITY] = splats.opacities
    return columns


def full_detail_controls(bundle: Bundle) -> Values | None:
    """Return control values whose weights a single level needs; None if it needs none."""
    numbers = [level.number for level in bundle.levels]
    return resolve_rule(bundle.rule).full_detail_values(numbers, bundle.controls)


def standalone_levels(bundle: Bundle) -> list[Level]:
    """Return the levels that are complete scenes, coarse to fine, see ``Rule.standalone_levels``."""
    standalone = resolve_rule(bundle.rule).standalone_levels([level.number for level in bundle.levels])
    return [level for level in bundle.levels if level.number in standalone]


def standalone_error(number: int, finest: int) -> tuple[str, str]:
    """Return error and remedy for a level that is not a complete scene."""
    return (
        f"Cannot use level {number} on its own: its splats only replace groups of finer ones.",
        f"Choose level {finest}, or select by distance.",
    )


def complete_splats(bundle: Bundle, level: Level) -> Splats:
    """Return all splats that are drawn at a level, as one set."""
    return Splats.concatenated([drawn.splats for drawn in bundle.drawn_levels(level.number)])
