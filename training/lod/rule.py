"""What decides the detail that an eye sees: one object a rule, which everything else asks.

A rule is a module of ``lod.rules``, found by itself: it names what it needs to know (facts of the scene and
of each level, columns of the splats) and what an eye may turn (controls), and gives every splat a weight. The
command line, Blender's panel and node groups, evaluation and both renderers take all of that from here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from math import inf
from pkgutil import iter_modules
from typing import Any, ClassVar

import numpy as np

from ..errors import LodgsError
from ..splats.ply import Columns
from ..splats.similarity import AxisNames

STEP = 1.25
"""Factor by which a viewer's budget raises a control at a time."""

NO_FINER = 1 << 30
"""What the fact ``finer`` of the finest level is."""

OPACITY = "opacity"
"""The column that every splat has: its own opacity, in [0, 1]."""

HIDDEN = "hidden"
"""The column of splats that somebody has hidden: not 0 where they are."""

Values = Mapping[str, float]
"""A number for each control of a rule, by name."""

Tables = Mapping[str, Mapping[str, np.ndarray]]
"""Tables of a bundle, of columns (rows,) by name."""
NO_TABLES: Tables = {}
NO_COLUMNS: Mapping[str, np.ndarray] = {}

Region = tuple[int, ...]
"""Names a part of space; what it is made of is the rule's."""


@dataclass(frozen=True)
class Control:
    """What an eye may turn: a slider, an option of the command line, a number in a bundle.

    Attributes:
        name: in code, sockets, options and files.
        default: where nothing else is said.
        low, high: the smallest and the largest possible value.
        soft: the range of a slider; None: it is no slider, but a box to tick or a number to type.
        label, about: for people, a word or two and a sentence.
        unit: Blender's subtype of such a property: "NONE", "PIXEL", "FACTOR".
        whole: whether only whole numbers are possible; from 0 to 1 it is a box to tick.
        step: what the arrows of a whole number add.
        follows: "coarsest" or "finest" where the value is the number of such a level in use, which follows
            the levels that there are (``Rule.defaults``), as long as nobody sets it.
    """

    name: str
    default: float
    low: float
    high: float
    label: str
    about: str
    soft: tuple[float, float] | None = None
    unit: str = "NONE"
    whole: bool = False
    step: int = 1
    follows: str = ""

    @property
    def flag(self) -> bool:
        """Whether it is a box to tick."""
        return self.whole and (self.low, self.high) == (0, 1)

    def validate(self, value: float) -> float:
        """The value as this control takes it.

        Raises:
            LodgsError: it is no such number, or out of range.
        """
        number = isinstance(value, int | float | np.number) and self.low <= value <= self.high
        if not number or (self.whole and value != int(value)):
            kind = "a whole number" if self.whole else "a number"
            raise LodgsError(
                f"{self.name} = {value!r} is not possible.",
                f"Give {kind} from {self.low:g} to {self.high:g}.",
            )
        return int(value) if self.whole else float(value)


class Rule(ABC):
    """How splats are weighted for an eye.

    Attributes:
        name: stands in the head of bundles and in .blend files.
        cumulative: whether levels add up; otherwise each replaces the coarser ones.
        controls: what an eye may turn.
        scene_facts: names of numbers that belong to the whole scene.
        level_facts: names of numbers that each level has.
        columns: names of per-splat columns, (N,) float32; zeros where splats lack one. OPACITY is each
            splat's own.
        tables: names of tables of the bundle; where one is missing, the rule does without it.
        lengths: which of its facts, its columns and the columns of its tables are lengths in scene units.
        places: names, as x, y and z, of those of its columns, or of its tables', that are places.
        linked_columns: whether columns of one splat have to agree with those of others: see :meth:`reconcile`.
        always_active: whether its weights belong to the picture at full detail, too: without them a level is not
            what was trained.
        apart: whether the weight of a splat does not depend on other splats, so that a few can be asked for.
        binary: whether every splat within its level's :meth:`distance_band` has the weight 1.
        complete: whether each level, with the coarser ones where levels add up, is a scene by itself;
            otherwise only the finest is, and coarser ones are there to choose from.
        sweep: a control, and values of it that a report measures one by one; None: it needs no such curve.
    """

    name: ClassVar[str]
    cumulative: ClassVar[bool] = False
    controls: ClassVar[tuple[Control, ...]] = ()
    scene_facts: ClassVar[tuple[str, ...]] = ()
    level_facts: ClassVar[tuple[str, ...]] = ()
    columns: ClassVar[tuple[str, ...]] = ()
    tables: ClassVar[tuple[str, ...]] = ()
    lengths: ClassVar[tuple[str, ...]] = ()
    places: ClassVar[tuple[AxisNames, ...]] = ()
    linked_columns: ClassVar[bool] = False
    always_active: ClassVar[bool] = False
    apart: ClassVar[bool] = True
    binary: ClassVar[bool] = False
    complete: ClassVar[bool] = True
    sweep: ClassVar[tuple[str, tuple[float, ...]] | None] = None

    @abstractmethod
    def weights(
        self,
        means: np.ndarray,
        eye: np.ndarray,
        focal_px: float,
        columns: Mapping[str, np.ndarray],
        facts: Mapping[str, float],
        values: Values,
        tables: Tables = NO_TABLES,
    ) -> np.ndarray:
        """Weights (N,) in [0, 1] of the splats of one level; those of weight 0 are not drawn at all.

        Args:
            means: (N, 3) float32 in scene units.
            eye: (3,) from where distances are measured, in the same space.
            focal_px: the eye's focal length in pixels (``Camera.focal``: the smaller of fx and fy).
            columns: (N,) of each of the rule's columns.
            facts: of the scene and of the level, see :func:`collect_facts`.
            values: of every control.
            tables: of the bundle, those of the rule at least; coordinates are in the same space.
        """

    def distance_band(
        self,
        focal_px: float,
        facts: Mapping[str, float],
        values: Values,
        highest: Mapping[str, np.ndarray] = NO_COLUMNS,
    ) -> tuple[float, float | np.ndarray]:
        """The distances near <= d < far from the eye outside which no splat of a level has a weight.

        For whoever can leave out many splats at once. Where a region counts (:meth:`region`), that does
        instead.

        Args:
            highest: the greatest value of each column among splats of the level, (B,) of B sets of them;
                ``far`` may then be (B,), too. Without it what depends on columns is taken for possible.
        """
        return 0.0, inf

    def check(self, tables: Tables) -> None:
        """Raises ValueError, with half a sentence, where tables are there but not what the rule reads."""
        return

    def reconcile(self, before: Columns, after: Columns) -> Columns:
        """Where the rule is ``linked_columns``: those columns (N,) that rounding has put out of step, made anew.

        Args:
            before: the rule's columns and x, y and z of the means, of the splats of all levels.
            after: the same where these splats have been placed elsewhere.
        """
        return {}

    def region(self, eye: np.ndarray, values: Values, tables: Tables) -> Region | None:
        """Where an eye is, for rules whose splats can be told beforehand for a whole region; else None.

        As long as the eye stays in the region, no splat has a weight that :meth:`visible_in_region` leaves out.
        """
        return None

    def visible_in_region(self, columns: Mapping[str, np.ndarray], region: Region) -> np.ndarray:
        """(N,) bool, which splats of a level an eye in a region may be shown."""
        raise NotImplementedError("this rule has no regions")

    def region_label(self, eye: np.ndarray, values: Values, tables: Tables) -> str:
        """Where an eye is, in a few words for people; empty where the rule tells no regions apart."""
        return ""

    def inactive_controls(self, eye: np.ndarray, values: Values, tables: Tables) -> Mapping[str, str]:
        """The controls that change nothing for an eye, by name, each with the reason in a sentence."""
        return {}

    def parts(self, means: np.ndarray, tables: Tables) -> np.ndarray:
        """The number (N,), from 1 on, of that part of space where each place is, for pictures that tell
        them apart; 0 where the rule has no such parts."""
        return np.zeros(len(means), np.float32)

    def standalone_levels(self, levels: Sequence[int]) -> Sequence[int]:
        """The numbers of those levels that can be shown one at a time: all of them, or where levels are not
        ``complete`` the finest.

        Args:
            levels: numbers of the levels that there are, ascending.
        """
        return levels if self.complete else levels[-1:]

    def told_level(self, columns: Mapping[str, np.ndarray], facts: Mapping[str, float]) -> np.ndarray | float:
        """The level (N,) of splats, or one for all, for pictures that tell which level is where."""
        return facts["level"]

    def wanted_level(
        self,
        means: np.ndarray,
        eye: np.ndarray,
        focal_px: float,
        facts: Mapping[str, float],
        values: Values,
    ) -> np.ndarray:
        """The level (N,) that is wanted where splats are, for pictures that tell which level is where."""
        return np.full(len(means), facts["level"], np.float32)

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        """The next coarser choice, for a viewer that can draw no more; None where there is none.

        Args:
            levels: numbers of the levels that there are, ascending.
        """
        return None

    def raise_control(self, values: Values, name: str) -> Values | None:
        """The values with one control STEP times as large; None where that is beyond its range."""
        value = values[name] * STEP
        high = next(control.high for control in self.controls if control.name == name)
        return {**values, name: value} if value <= high else None

    def defaults(self, levels: Sequence[int]) -> dict[str, float]:
        """The value of every control that pictures and figures are made with where nothing else is said.

        Args:
            levels: numbers of the levels that there are, ascending.
        """
        return {control.name: control.default for control in self.controls}

    def resolve_controls(
        self, given: Values, levels: Sequence[int], recorded: Values | None = None
    ) -> Values:
        """A value for every control: those given, then those that a bundle recorded, then :meth:`defaults`.

        Raises:
            LodgsError: the rule has no such control, a value is not possible, or no level is left in use.
        """
        controls = {control.name: control for control in self.controls}
        for name in given:
            if name not in controls:
                raise LodgsError(
                    f"The rule '{self.name}' has no option '{name}'.",
                    f"It has: {', '.join(controls) or 'none'}.",
                )
        found = self.defaults(levels) | dict(recorded or {}) | dict(given)
        return {name: control.validate(found[name]) for name, control in controls.items()}


@cache
def rules() -> dict[str, Rule]:
    """Every rule by its name: the modules of ``lod.rules`` each have one as ``RULE``."""
    from . import rules as package

    modules = (import_module(f"{package.__name__}.{found.name}") for found in iter_modules(package.__path__))
    return {module.RULE.name: module.RULE for module in modules}


class NoRule(Rule):
    """What stands for a rule where there is none: all splats are drawn."""

    name = ""

    def weights(self, means, eye, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        return np.ones(len(means), np.float32)


NO_RULE = NoRule()


def find_rule(name: str) -> Rule | None:
    """The rule of that name; None where there is none, or this version does not know it."""
    return rules().get(name)


def all_controls() -> dict[str, Control]:
    """The controls of all rules by name; two rules that share a name share its meaning."""
    return {control.name: control for rule in rules().values() for control in rule.controls}


def all_rule_columns() -> set[str]:
    """The columns of all rules, but the opacity; and HIDDEN, which choices ask for beside them."""
    return {name for rule in rules().values() for name in rule.columns} - {OPACITY} | {HIDDEN}


def fact_names(rule: Rule) -> list[str]:
    """The names of all that :func:`collect_facts` says of a level."""
    coarser = [f"coarser_{name}" for name in rule.level_facts]
    return ["level", "finer", "coarser", "levels", *rule.scene_facts, *rule.level_facts, *coarser]


def collect_facts(
    rule: Rule,
    scene: Mapping[str, Any],
    levels: Sequence[tuple[int, Mapping[str, Any]]],
    number: int,
) -> dict[str, float]:
    """All that a rule knows of one level.

    Args:
        scene: facts of the scene, by name.
        levels: number and facts of every level that there is, coarse to fine.
        number: of the level that is meant.

    Returns:
        The rule's facts of the scene and of the level by name; of the next coarser level as ``coarser_NAME``
        (0 where there is none); ``level``, ``finer`` and ``coarser``: the level's number and those of its
        neighbours (NO_FINER and 0 where there are none); ``levels``: the number of the finest.

    Raises:
        LodgsError: a fact is missing, or is no number of at least 0.
    """
    numbers = [each for each, _ in levels]
    place = numbers.index(number)
    coarser = levels[place - 1] if place else (0, dict.fromkeys(rule.level_facts, 0.0))
    found = {
        "level": float(number),
        "finer": float(numbers[place + 1]) if place + 1 < len(levels) else float(NO_FINER),
        "coarser": float(coarser[0]),
        "levels": float(numbers[-1]),
    }
    try:
        found |= {name: float(scene[name]) for name in rule.scene_facts}
        found |= {name: float(levels[place][1][name]) for name in rule.level_facts}
        found |= {f"coarser_{name}": float(coarser[1][name]) for name in rule.level_facts}
        if below := [name for name, value in found.items() if not value >= 0]:
            raise ValueError(f"'{below[0]}' is not at least 0")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LodgsError(
            f"The levels are to be chosen by the rule '{rule.name}', but its facts are incomplete ({error}).",
            "Export or train them again.",
        ) from error
    return found


def distances(means: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Distances (N,) of means (N, 3) from an eye (3,), in the type of the means.

    Axis by axis, which numpy does four times as fast as rows of three.
    """
    return axis_distances([*means.T], eye)


def axis_distances(axes: Sequence[np.ndarray], eye: np.ndarray) -> np.ndarray:
    """The same of means whose x, y and z are (N,) each."""
    squares = np.zeros(len(axes[0]), axes[0].dtype)
    for axis, place in zip(axes, np.asarray(eye, squares.dtype), strict=True):
        away = axis - place
        away *= away
        squares += away
    return np.sqrt(squares, out=squares)
