"""What an eye is shown of levels of detail: splats, and a weight in [0, 1] on the opacity of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import LodgsError
from ..splats.gaussians import Splats
from ..splats.levels import Bundle, Level
from .rule import OPACITY, Rule, Values, collect_facts, find_rule


@dataclass
class SelectedLevel:
    """What is shown of one level.

    Attributes:
        number: of the level.
        splats: those of its splats that have a weight.
        weights: (N,), or None where all are 1.
    """

    number: int
    splats: Splats
    weights: np.ndarray | None = None


def check_rule(bundle: Bundle) -> Rule | None:
    """The rule that a bundle's levels are chosen by; None where they have none, or it is not known here.

    Raises:
        LodgsError: the bundle contradicts it.
    """
    rule = find_rule(bundle.rule)
    if rule is not None and rule.cumulative != bundle.cumulative:
        says, knows = (
            "add up" if adds else "replace one another" for adds in (bundle.cumulative, rule.cumulative)
        )
        raise LodgsError(
            f"The levels are said to {says}, but by their rule '{rule.name}' they {knows}.",
            "Another program may have changed the file; export it again.",
        )
    if rule is not None:
        try:
            rule.check(bundle.tables)
        except ValueError as error:
            raise LodgsError(
                f"The levels are to be chosen by the rule '{rule.name}', but {error}.",
                "Export or train them again.",
            ) from error
    return rule


def require_rule(bundle: Bundle) -> Rule:
    """The rule that a bundle's levels are chosen by.

    Raises:
        LodgsError: they are not made for distances, this version does not know the rule, or they contradict
            it.
    """
    rule = check_rule(bundle)
    if rule is None:
        raise LodgsError(*unknown_rule_error(bundle.rule))
    return rule


def unknown_rule_error(name: str) -> tuple[str, str]:
    """What to say, and what to do about it, where there is no such rule."""
    if not name:
        return "These levels are not made for distances.", "Leave out the options that choose by distance."
    return (
        f"These levels are chosen by the rule '{name}', which this version does not know.",
        "Update LODGS; until then the finest level is shown.",
    )


def resolve_controls(bundle: Bundle, given: Values) -> Values:
    """A value for every control of a bundle's rule: those given, else the bundle's own, else the rule's.

    Raises:
        LodgsError: as :func:`require_rule`, the rule has no such control, a value is not possible, or no level is
            left in use.
    """
    return require_rule(bundle).resolve_controls(given, [level.number for level in bundle.levels], bundle.controls)


def select(
    bundle: Bundle, eye: np.ndarray, focal_px: float, values: Values
) -> tuple[Splats, np.ndarray | None]:
    """A copy of the splats of a bundle that an eye is shown by its rule, and their weights (None: all 1).

    For one eye after another see :class:`BundleSelector`.

    Args:
        eye: (3,) world position that distances are measured from.
        focal_px: focal length in pixels of the image that is looked at (``Camera.focal``).
        values: of the rule's controls, see :func:`resolve_controls`.

    Raises:
        LodgsError: as :func:`require_rule`, or the rule's facts are incomplete.
    """
    shown = select_levels(bundle, eye, focal_px, values)
    splats = Splats.concatenated([one.splats for one in shown])
    if all(one.weights is None for one in shown):
        return splats, None
    ones = [np.ones(len(one.splats), np.float32) if one.weights is None else one.weights for one in shown]
    return splats, np.concatenate(ones)


def select_levels(bundle: Bundle, eye: np.ndarray, focal_px: float, values: Values) -> list[SelectedLevel]:
    """The same level by level, coarse to fine; levels of which nothing is shown have no splats."""
    shown = []
    of_levels = BundleSelector(bundle).level_weights(eye, focal_px, values)
    for level, weights in zip(bundle.levels, of_levels, strict=True):
        some = weights > 0
        splats, weights = level.splats.select(some), weights[some]
        shown.append(SelectedLevel(level.number, splats, None if (weights == 1).all() else weights))
    return shown


class BundleSelector:
    """A bundle's levels, to choose from for one eye after another: weights alone, and no copy of a splat.

    What a rule needs to know is gathered once. Whoever draws keeps ``splats`` where they are drawn, on a GPU
    for example; splats of weight 0 cost a rasterizer next to nothing.

    Raises:
        LodgsError: as :func:`require_rule`, or the rule's facts are incomplete.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._rule, self._levels, self._tables = require_rule(bundle), bundle.levels, bundle.tables
        numbered = [(level.number, level.facts) for level in bundle.levels]
        self._known = [
            (
                rule_columns(self._rule, level.splats),
                collect_facts(self._rule, bundle.facts, numbered, level.number),
            )
            for level in bundle.levels
        ]

    @cached_property
    def splats(self) -> Splats:
        """The splats of all levels, coarse to fine."""
        return Splats.concatenated([level.splats for level in self._levels])

    def level_weights(self, eye: np.ndarray, focal_px: float, values: Values) -> list[np.ndarray]:
        """The weights of each level's splats; arguments as of :func:`select`."""
        eye = np.asarray(eye, np.float32)
        return [
            self._rule.weights(level.splats.means, eye, focal_px, columns, facts, values, self._tables)
            for level, (columns, facts) in zip(self._levels, self._known, strict=True)
        ]

    def weights(self, eye: np.ndarray, focal_px: float, values: Values) -> np.ndarray:
        """The weights (N,) of ``splats``; those of weight 0 are not to be drawn."""
        return np.concatenate(self.level_weights(eye, focal_px, values))


def rule_columns(rule: Rule, splats: Splats) -> dict[str, np.ndarray]:
    """What a rule needs to know of splats, (N,) float32 by name; zeros where they lack it."""
    nothing = np.broadcast_to(np.float32(0), len(splats))
    columns = {name: splats.extras.get(name, nothing) for name in rule.columns}
    if OPACITY in columns:
        with np.errstate(over="ignore"):
            columns[OPACITY] = 1 / (1 + np.exp(-splats.opacity_logits))
    return columns


def standalone_levels(bundle: Bundle) -> list[Level]:
    """The levels that can be shown one at a time, coarse to fine: see ``Rule.standalone_levels``."""
    rule, numbers = find_rule(bundle.rule), [level.number for level in bundle.levels]
    alone = numbers if rule is None else rule.standalone_levels(numbers)
    return [level for level in bundle.levels if level.number in alone]


def standalone_error(number: int, finest: int) -> tuple[str, str]:
    """What to say, and what to do about it, where a level is wanted that is no scene by itself."""
    return (
        f"Level {number} is no scene by itself: its splats stand for groups of finer ones, where those are "
        "not needed.",
        f"Take level {finest}, or choose by distance.",
    )


def complete_splats(bundle: Bundle, level: Level) -> Splats:
    """All that is drawn at a level, as one set of splats."""
    return Splats.concatenated([each.splats for each in bundle.drawn_levels(level.number)])
