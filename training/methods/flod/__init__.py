"""FLoD (Seo et al. 2025): independent levels, one for each band of camera distances."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.flod_parameters import (
    PAPER_FOOTPRINT,
    PAPER_INTERVALS,
    PAPER_STEPS,
    PAPER_UNTIL,
    STANDARD_STEPS,
    FlodLevels,
)
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, DensityParameters
from ...settings import setting

BLENDED_LEVELS = 3
"""Number of finest levels that are blended by default (``Bands.defaults``) and that finishing steps train."""
REFINE_RATIO = 0.7
"""Steps that refine a merged level relative to those of the next finer one."""
CELL_LEVELS = 2
"""Number of finest levels that are trained cell by cell in a divided scene."""


@dataclass(frozen=True)
class FlodParameters(FlodLevels, DensityParameters):
    """Parameters of FLoD.

    Tuples have one entry per level, coarse to fine. ``max_splats`` limits the last level.
    """

    footprint: float = setting(
        16.0,
        "Detail of level 1, in pixels at the scene's median depth: its minimum splat size (FLoD: lambda). "
        "Sets the distances of trained levels, and in regions and cells those of merged levels, which "
        "otherwise follow from 'drawn'.",
        label="Coarsest Detail",
        above=0,
        unit="px",
    )
    steps: tuple[int, ...] = setting(
        (250, 400, 500, 750, 3561), "Training steps of each level.", above=0, unit="steps"
    )
    densify_until: tuple[float, ...] = setting(
        (0.5,) * 5, "Fraction of a level's steps in which splats are added and removed.", high=1
    )
    densify_interval: tuple[int, ...] = setting(
        (50,) * 5, "Steps between two densifications.", above=0, unit="steps"
    )
    overlap_interval: int = setting(
        50,
        "Steps between two overlap prunings, in all levels but the finest (FLoD, Sec. 4.3). 0 disables.",
        unit="steps",
    )
    rejoin_points: bool = setting(
        True,
        "Add points of the initial point cloud that overlap pruning removed again at the first level "
        "with room for them. Gives finer levels exact start positions in short schedules. Not in the "
        "paper.",
    )

    levels_from: str = setting(
        "merged",
        "Source of the coarser levels. 'merged' trains the finest level first, then merges each coarser "
        "level from the next finer one and refines it. 'trained' trains from coarse to fine with minimum "
        "splat sizes, as in the paper, and is always used in runs of only some levels.",
        choices=("merged", "trained"),
    )
    merge_ratio: float = setting(
        0.5,
        "Splat count of a merged level, as a fraction of the next finer level's. The level before the finest "
        "has at most the share that views by distance may draw ('drawn').",
        above=0,
        high=1,
    )
    refine_steps: int = setting(
        1000,
        "Steps that refine the merged level before the finest. Each coarser level gets 70 % of the steps of "
        "the next finer one. They are taken from those of all levels ('steps'), at most half; the finest "
        "level gets the others.",
        unit="steps",
    )
    first_level: int = setting(
        1, "First level to train. Above 1 it needs a base: the level before it.", low=1
    )
    last_level: int = setting(0, "Last level to train. 0 means the finest.")
    finish_share: float = setting(
        0.2,
        "Additional steps at the end that train the three finest levels as blended by distance, as a "
        "fraction of all levels' steps. Merged levels need at most a fifth of 'refine_steps'. Trained "
        "levels with fine detail restart from the most important splats of the finest level. Not in the "
        "paper.",
        high=1,
    )
    drawn: float = setting(
        0.45,
        "Maximum number of splats drawn by distance in the training views, as a fraction of those of "
        "the finest level. Limits the size of merged levels, sets their distances, and the size of trained "
        "levels that the finishing steps restart. Not in the paper.",
        above=0,
        high=1,
    )
    finish_alone: float = setting(
        0.5,
        "Fraction of the finishing steps that render a single level, so that each level also works "
        "without the others.",
        high=1,
    )

    @property
    def end(self) -> int:
        """The last level to train."""
        return self.last_level or self.levels

    @property
    def merges(self) -> bool:
        """True if coarser levels are merged from the finest."""
        complete = (self.first_level, self.end) == (1, self.levels)
        return complete and self.levels > 1 and self.levels_from == "merged"

    @property
    def stages(self) -> list[tuple[int, int]]:
        """Levels in the order of their training, with their numbers of steps."""
        if not self.merges:
            numbers = range(self.first_level, self.end + 1)
            return [(number, self.steps[number - 1]) for number in numbers]
        shares = [REFINE_RATIO**n for n in range(self.levels - 1)]
        steps = min(self.refine_steps, sum(self.steps) / (2 * sum(shares)))
        refining = [max(int(steps * share), 1) for share in shares]
        coarser = list(zip(range(self.levels - 1, 0, -1), refining, strict=True))
        return [(self.levels, sum(self.steps) - sum(refining)), *coarser]

    @property
    def total_steps(self) -> int:
        return sum(steps for _, steps in self.stages) + self.finish_steps

    @property
    def all_steps(self) -> int:
        """Steps of a run of all levels; schedules are fractions of them."""
        finishing = round(self.finish_share * sum(self.steps)) if self.levels > 1 else 0
        return sum(self.steps) + (min(finishing, self.stages[1][1] // 5) if self.merges else finishing)

    @property
    def finish_steps(self) -> int:
        """Number of finishing steps, which train the finest levels blended.

        Zero if the finest level is not trained, or is the only one.
        """
        return self.all_steps - sum(self.steps) if self.end == self.levels else 0

    @property
    def continues_levels(self) -> bool:
        return self.first_level > 1

    @property
    def max_trained_splats(self) -> int:
        blended = range(self.levels, max(self.levels - BLENDED_LEVELS, 0), -1)
        shares = (
            self.merged_share(number) if self.merges else self.budget_ratio ** (self.levels - number)
            for number in blended
        )
        at_end = self.max_splats * self.budget_ratio ** (self.levels - self.end)
        return round(self.max_splats * sum(shares) if self.finish_steps else at_end)

    def merged_share(self, number: int) -> float:
        """Return the splat count of a merged level, as a fraction of the finest level's; 1 for the finest."""
        if number == self.levels:
            return 1.0
        return min(self.merge_ratio ** (self.levels - number), self.drawn)

    @property
    def growth_rounds(self) -> float | None:
        growing = self.stages[:1] if self.merges else self.stages
        return sum(
            self.densify_until[number - 1] * steps / self.densify_interval[number - 1]
            for number, steps in growing
        )

    def check(self) -> None:
        if not self.first_level <= self.end <= self.levels:
            raise LodgsError(
                f"Cannot train levels {self.first_level} to {self.end} of {self.levels}.",
                "Correct first_level or last_level.",
            )


def divide(parameters: FlodParameters) -> tuple[FlodParameters, FlodParameters] | None:
    """Return the parameters of a divided scene: coarse levels of the whole scene, fine levels of each cell.

    None if there are not enough levels to divide.
    """
    coarse = parameters.levels - CELL_LEVELS
    if coarse < 1:
        return None
    return replace(parameters, last_level=coarse), replace(parameters, first_level=coarse + 1)


_DRAFT = FlodParameters(grad_threshold=7e-5)  # reaches max_splats in few steps
_STANDARD = replace(
    FlodParameters(),
    **STANDARD,
    steps=STANDARD_STEPS,
    refine_steps=2_000,
    densify_interval=(100,) * 5,
)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    footprint=PAPER_FOOTPRINT,
    steps=PAPER_STEPS,
    densify_until=PAPER_UNTIL,
    densify_interval=PAPER_INTERVALS,
    levels_from="trained",
    overlap_interval=1000,
    rejoin_points=False,
    finish_share=0.0,
    budget_ratio=1.0,
)

METHOD = MethodInfo(
    name="flod",
    number=0,
    label="FLoD",
    about="complete levels, one for each band of distances",
    parameters=FlodParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="bands",
    panel_parameters=("levels", "footprint", "max_splats"),
    cell_method="flod",
    split_parameters=divide,
    trains_on_device=lambda parameters: True,
)
