"""Level-of-detail rules: a weight for each splat of a level, depending on the camera.

Each module of ``lod.rules`` defines a rule and is discovered automatically. Other packages add rules as entry
points (``plugins.RULES_GROUP``). A rule declares its inputs (facts of the scene and of each level, columns of
the splats), its user controls, and the weights. The command line, Blender's panels and node groups,
evaluation and both renderers use these declarations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from math import inf
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from ..errors import LodgsError
from ..plugins import RULES_GROUP, load_plugins
from ..splats.levels import Bundle
from ..splats.ply import Columns
from ..splats.similarity import AxisNames, Similarity

STEP = 1.25
"""Factor of one step of :meth:`Rule.raise_control`."""

THINNING, MIN_SPLATS = 4, 500
"""Ratio of splats of two complete levels that replace a selection of single splats, and their minimum."""

NO_FINER = 1 << 30
"""Value of the fact ``finer`` for the finest level."""

OPACITY = "opacity"
"""Column of a splat's opacity, in [0, 1]; every splat has it."""

HIDDEN = "hidden"
"""Column that is not 0 for splats hidden by the user."""

Values = Mapping[str, float]
"""Values of a rule's controls, by name."""

Tables = Mapping[str, Mapping[str, np.ndarray]]
"""Tables of a bundle by name; each has columns (rows,) by name."""
NO_TABLES: Tables = {}
NO_COLUMNS: Mapping[str, np.ndarray] = {}

Region = tuple[int, ...]
"""Identifies a part of space; its meaning depends on the rule."""


@dataclass(frozen=True)
class Control:
    """A user control of a rule: a slider, a command-line option, a number in a bundle.

    Attributes:
        name: name in code, sockets, options and files.
        default: default value.
        low, high: minimum and maximum.
        soft: range of the slider; None shows a checkbox or a number field instead of a slider.
        label, about: label and tooltip.
        unit: "px", or "" for a pure number.
        integer: only whole numbers are valid; with the range 0 to 1 the control is a checkbox.
        step: step of the arrows of a whole number.
        follows: "coarsest" or "finest" if the value is the number of a level and follows the existing levels
            (``Rule.defaults``) until the user sets it.
    """

    name: str
    default: float
    low: float
    high: float
    label: str
    about: str
    soft: tuple[float, float] | None = None
    unit: str = ""
    integer: bool = False
    step: int = 1
    follows: str = ""

    @property
    def flag(self) -> bool:
        """True if the control is a checkbox."""
        return self.integer and (self.low, self.high) == (0, 1)

    def validate(self, value: float) -> float:
        """Return the value as int or float.

        Raises:
            LodgsError: wrong type, or out of range.
        """
        number = isinstance(value, int | float | np.number) and self.low <= value <= self.high
        if not number or (self.integer and value != int(value)):
            kind = "a whole number" if self.integer else "a number"
            raise LodgsError(
                f"{self.name} = {value!r} is invalid.",
                f"Use {kind} from {self.low:g} to {self.high:g}.",
            )
        return int(value) if self.integer else float(value)


Masks = Mapping[int, np.ndarray]
"""(N,) bool of each level, by level number."""


class Relations:
    """Relations among the splats of all levels, which edits preserve. By default there are none.

    Args:
        columns: (N,) float32 of each level, by level number; at least the class's ``columns``.

    Attributes:
        columns: names of the columns that determine the relations; x, y and z are those of the means.
    """

    columns: ClassVar[tuple[str, ...]] = ()

    def __init__(self, columns: Mapping[int, Columns]) -> None:
        return

    def testable(self, masks: Masks) -> Masks:
        """Return the masks without splats that depend on others, which clean-up does not test."""
        return masks

    def completed(self, masks: Masks) -> Masks:
        """Return masks of remaining splats with the dependent ones that remain with them."""
        return masks

    def pruned(self, masks: Masks) -> tuple[Masks, Mapping[int, Columns]]:
        """Return the masks of the splats to keep, and their changed columns (M,) by level number.

        Args:
            masks: masks of the remaining splats; those of dependent splats do not count.
        """
        return masks, {}

    def transformed(self, placement: Similarity) -> Mapping[int, Columns]:
        """Return the columns (N,), by level number, that a transform cannot compute splat by splat."""
        return {}


class Rule(ABC):
    """A rule that gives each splat of a level a weight, depending on the camera.

    Attributes:
        name: identifies the rule in bundles and .blend files.
        cumulative: levels add up; otherwise each replaces the coarser ones.
        controls: user controls.
        scene_facts: names of numbers that belong to the whole scene.
        level_facts: names of numbers that each level has.
        columns: names of per-splat columns, (N,) float32; a missing column counts as zeros. OPACITY is the
            splat's own.
        tables: names of tables of the bundle; the rule works without a missing one.
        lengths: the facts, columns and table columns that are lengths in scene units.
        places: the columns and table columns that are positions, as names of x, y and z.
        independent: weights do not depend on other splats, so that subsets can be evaluated.
        block_bounds: columns of the table of blocks (``blocks.BLOCKS``) besides ``level``, for partial reads
            of files: each is the reduction of a column over the rows of a block.
        relations: relations among splats that edits preserve.
        paged_file: class of partly loaded files (``query.PagedFile``); None means that files are read
            completely.
        plain_values: control values with which weights depend on distance alone.
        fade_factor: ratio of end to begin of the distances over which a level fades; 1 if it switches.
        sweep: a control and values of it that a report measures one by one; None for no such curve.
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
    independent: ClassVar[bool] = True
    block_bounds: ClassVar[Mapping[str, tuple[str, np.ufunc]]] = {}
    relations: ClassVar[type[Relations]] = Relations
    paged_file: ClassVar[type[Any] | None] = None
    plain_values: ClassVar[Values] = {}
    fade_factor: ClassVar[float] = 1.0
    sweep: ClassVar[tuple[str, tuple[float, ...]] | None] = None

    @abstractmethod
    def weights(
        self,
        means: np.ndarray,
        position: np.ndarray,
        focal_px: float,
        columns: Mapping[str, np.ndarray],
        facts: Mapping[str, float],
        values: Values,
        tables: Tables = NO_TABLES,
    ) -> np.ndarray:
        """Return weights (N,) in [0, 1] of the splats of one level; weight 0 means not drawn.

        Args:
            means: (N, 3) float32 in scene units.
            position: (3,) of the camera, in the same space.
            focal_px: the camera's focal length in pixels (``Camera.focal``: the smaller of fx and fy).
            columns: (N,) of each of the rule's columns.
            facts: facts of the scene and of the level, see :func:`collect_facts`.
            values: value of every control.
            tables: at least the rule's tables of the bundle; coordinates are in the same space.
        """

    def distance_band(
        self,
        focal_px: float,
        facts: Mapping[str, float],
        values: Values,
        highest: Mapping[str, np.ndarray] = NO_COLUMNS,
    ) -> tuple[float, float | np.ndarray]:
        """Return camera distances near and far; weights are 0 outside near <= d < far.

        Callers skip whole sets of splats with it. Inside a :meth:`region`, use that instead.

        Args:
            highest: maximum of each column in each of B sets of splats, (B,); ``far`` may then be (B,), too.
                Without it, the band covers all possible column values.
        """
        return 0.0, inf

    def fills_band(self, values: Values) -> bool:
        """Return whether every splat inside its level's :meth:`distance_band` has weight 1."""
        return False

    def check(self, tables: Tables) -> None:
        """Check the rule's tables.

        Raises:
            ValueError: a table is invalid; the message is a clause without a full stop.
        """
        return

    def region(self, position: np.ndarray, values: Values, tables: Tables) -> Region | None:
        """Return the region of a camera position; None if the rule has no regions, or none here.

        While the camera stays in the region, only splats of :meth:`visible_in_region` have a weight.
        """
        return None

    def visible_in_region(self, columns: Mapping[str, np.ndarray], region: Region) -> np.ndarray:
        """Return a mask (N,) of the splats of a level that may have a weight in a region."""
        raise NotImplementedError("this rule has no regions")

    def region_label(self, position: np.ndarray, values: Values, tables: Tables) -> str:
        """Return a short description of the camera's region for the user; "" if the rule has no regions."""
        return ""

    def inactive_controls(self, position: np.ndarray, values: Values, tables: Tables) -> Mapping[str, str]:
        """Return the controls without effect at a camera position, by name, each with a reason."""
        return {}

    def part_numbers(self, means: np.ndarray, tables: Tables) -> np.ndarray:
        """Return the number (N,), from 1 on, of the part of space at each position, for coloured overlays.

        0 if the rule has no such parts.
        """
        return np.zeros(len(means), np.float32)

    def standalone_levels(self, levels: Sequence[int]) -> Sequence[int]:
        """Return the numbers of the levels that are complete scenes, with the coarser ones if levels add up.

        Args:
            levels: numbers of the existing levels, ascending.
        """
        return levels

    @property
    def complete(self) -> bool:
        """True if every level is a complete scene, see :meth:`standalone_levels`."""
        return len(self.standalone_levels((1, 2))) == 2

    def complete_levels(self, bundle: Bundle) -> Bundle:
        """Return a bundle whose levels are complete scenes, for programs without this rule."""
        return bundle

    def nested_levels(self, bundle: Bundle) -> Bundle:
        """Return complete levels for programs that select one level by distance; may load all splats."""
        return self.complete_levels(bundle)

    def full_detail_values(self, levels: Sequence[int], recorded: Values | None = None) -> Values | None:
        """Return control values of the weights without which a single level is not as trained.

        Args:
            levels: numbers of the existing levels, ascending.
            recorded: values in the bundle.

        Returns:
            None: a single level needs no weights.
        """
        return None

    @property
    def weights_full_detail(self) -> bool:
        """True if single levels need weights, see :meth:`full_detail_values`."""
        return self.full_detail_values((1,)) is not None

    def exceeds_budget(self, finest: int, budget: int) -> bool:
        """Return whether a scene with ``finest`` splats in its finest level is paged for a memory budget."""
        return False

    @property
    def color_legend(self) -> str:
        """Explanation of the colours by level, as a sentence; "" if each level has its own colour."""
        return ""

    def splat_level(
        self, columns: Mapping[str, np.ndarray], facts: Mapping[str, float]
    ) -> np.ndarray | float:
        """Return the level (N,) of splats, or one for all, for overlays that colour splats by level."""
        return facts["level"]

    def target_level(
        self,
        means: np.ndarray,
        position: np.ndarray,
        focal_px: float,
        facts: Mapping[str, float],
        values: Values,
    ) -> np.ndarray:
        """Return the level (N,) that the rule aims at where splats are, for overlays."""
        return np.full(len(means), facts["level"], np.float32)

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        """Return control values for the next coarser detail, to stay within a budget; None if there are none.

        Args:
            levels: numbers of the existing levels, ascending.
        """
        return None

    def less_detail(self, values: Values, levels: Sequence[int]) -> Values | None:
        """Return control values that draw coarser levels from nearer on, as an artist would set them.

        Args:
            levels: see :meth:`coarser`.
        """
        return self.coarser(values, levels)

    def raise_control(self, values: Values, name: str) -> Values | None:
        """Return the values with one control multiplied by STEP; None if that exceeds its range."""
        value = values[name] * STEP
        high = next(control.high for control in self.controls if control.name == name)
        return {**values, name: value} if value <= high else None

    def defaults(self, levels: Sequence[int]) -> dict[str, float]:
        """Return the default value of every control.

        Args:
            levels: numbers of the existing levels, ascending.
        """
        return {control.name: control.default for control in self.controls}

    def resolve_controls(
        self, changes: Values, levels: Sequence[int], recorded: Values | None = None
    ) -> Values:
        """Return a value for every control: changed, else recorded in the bundle, else :meth:`defaults`.

        Raises:
            LodgsError: unknown control, invalid value, or no level in use.
        """
        controls = {control.name: control for control in self.controls}
        for name in changes:
            if name not in controls:
                raise LodgsError(
                    f"Cannot set '{name}': the rule '{self.name}' has no such control.",
                    f"Use one of: {', '.join(controls)}." if controls else "Omit it.",
                )
        values = self.defaults(levels) | dict(recorded or {}) | dict(changes)
        return {name: control.validate(values[name]) for name, control in controls.items()}


@cache
def rules() -> dict[str, Rule]:
    """Return every rule by name: ``RULE`` of each module of ``lod.rules`` and of plug-ins."""
    from . import rules as package

    modules = (import_module(f"{package.__name__}.{info.name}") for info in iter_modules(package.__path__))
    by_name: dict[str, Rule] = {module.RULE.name: module.RULE for module in modules}

    def add(module: ModuleType) -> None:
        if not isinstance(module.RULE, Rule):
            raise ValueError("RULE is not a Rule")
        if module.RULE.name in ("", *by_name):
            raise ValueError(f"another rule has the name {module.RULE.name!r}")
        by_name[module.RULE.name] = module.RULE

    load_plugins(RULES_GROUP, add)
    return by_name


def restrict_rules(names: Collection[str]) -> None:
    """Forget all other rules, which a host program cannot evaluate. They count as unknown afterwards."""
    for name in rules().keys() - set(names):
        del rules()[name]


class NoRule(Rule):
    """Substitute for a missing rule: draws all splats."""

    name = ""

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        return np.ones(len(means), np.float32)


NO_RULE = NoRule()


def find_rule(name: str) -> Rule | None:
    """Return the rule of that name; None if unknown."""
    return rules().get(name)


def resolve_rule(name: str) -> Rule:
    """Return the rule of that name; NO_RULE if there is none or it is unknown."""
    return rules().get(name, NO_RULE)


def all_controls() -> dict[str, Control]:
    """Return the controls of all rules by name; a name has the same meaning in all rules."""
    return {control.name: control for rule in rules().values() for control in rule.controls}


def all_rule_columns() -> set[str]:
    """Return the columns of all rules except OPACITY, and HIDDEN."""
    return {name for rule in rules().values() for name in rule.columns} - {OPACITY} | {HIDDEN}


def fact_names(rule: Rule) -> list[str]:
    """Return the names of the facts that :func:`collect_facts` returns."""
    coarser = [f"coarser_{name}" for name in rule.level_facts]
    return ["level", "finer", "coarser", "levels", *rule.scene_facts, *rule.level_facts, *coarser]


def collect_facts(
    rule: Rule,
    scene: Mapping[str, Any],
    levels: Sequence[tuple[int, Mapping[str, Any]]],
    number: int,
) -> dict[str, float]:
    """Return a rule's facts about one level.

    Args:
        scene: facts of the scene, by name.
        levels: number and facts of every level, coarse to fine.
        number: number of the level.

    Returns:
        The rule's facts of the scene and of the level by name; those of the next coarser level as
        ``coarser_NAME`` (0 without one); ``level``, ``finer`` and ``coarser``: the numbers of the level and
        of its neighbours (NO_FINER and 0 without); ``levels``: the number of the finest.

    Raises:
        LodgsError: a fact is missing, negative or not a number.
    """
    numbers = [level for level, _ in levels]
    index = numbers.index(number)
    coarser = levels[index - 1] if index else (0, dict.fromkeys(rule.level_facts, 0.0))
    facts = {
        "level": float(number),
        "finer": float(numbers[index + 1]) if index + 1 < len(levels) else float(NO_FINER),
        "coarser": float(coarser[0]),
        "levels": float(numbers[-1]),
    }
    try:
        facts |= {name: float(scene[name]) for name in rule.scene_facts}
        facts |= {name: float(levels[index][1][name]) for name in rule.level_facts}
        facts |= {f"coarser_{name}": float(coarser[1][name]) for name in rule.level_facts}
        if invalid := [name for name, value in facts.items() if not value >= 0]:
            raise ValueError(f"'{invalid[0]}' is not at least 0")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LodgsError(
            f"Cannot apply the rule '{rule.name}': facts are missing or invalid ({error}).",
            "Export or train the levels again.",
        ) from error
    return facts


def distances(means: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of means (N, 3) from a position (3,), in the dtype of the means."""
    return axis_distances([*means.T], position)


def axis_distances(axes: Sequence[np.ndarray], position: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of means from a position (3,). ``axes`` are their x, y and z, each (N,)."""
    squares = np.zeros(len(axes[0]), axes[0].dtype)
    for axis, coordinate in zip(axes, np.asarray(position, squares.dtype), strict=True):
        offset = axis - coordinate
        offset *= offset
        squares += offset
    return np.sqrt(squares, out=squares)
