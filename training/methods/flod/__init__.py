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
from ...optimize.merged_parameters import REFINE_RATIO, MergedParameters, refining_steps
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, DensityParameters
from ...settings import setting

BLENDED_LEVELS = 3
"""Number of finest levels that are blended by default (``Bands.defaults``) and that finishing steps train."""
CELL_LEVELS = 2
"""Number of finest trained levels that are trained cell by cell in a divided scene."""


@dataclass(frozen=True)
class FlodParameters(MergedParameters, FlodLevels, DensityParameters):
    """Parameters of FLoD.

    Tuples have one entry per level, coarse to fine. ``max_splats`` limits the last level.
    """

    footprint: float = setting(
        16.0,
        "Detail of level 1, in pixels at the scene's median depth: its minimum splat size (FLoD: lambda). "
        "Sets the distances of trained levels, and in regions those of merged levels.",
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
        "splat sizes, as in the paper, and is always used in cells and in runs of only some levels.",
        choices=("merged", "trained"),
    )
    first_level: int = setting(
        1, "First level to train. Above 1 it needs a base: the level before it.", low=1
    )
    last_level: int = setting(0, "Last level to train. 0 means the finest.")
    finish_share: float = setting(
        0.2,
        "Additional steps at the end that train the three finest levels together, as selected by distance, "
        "as a fraction of all levels' steps. Merged levels have at most a fifth of 'refine_steps'. Trained "
        "levels with fine detail restart from the most important splats of the finest level. Not in the "
        "paper.",
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
        merged = self.levels - 1
        most = sum(self.steps) / (2 * sum(REFINE_RATIO**n for n in range(merged)))
        refining = refining_steps(min(self.refine_steps, most), merged)
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
        """Number of finishing steps, which train the finest levels together.

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
            self.share_below(self.levels - number)
            if self.merges
            else self.budget_ratio ** (self.levels - number)
            for number in blended
        )
        at_end = self.max_splats * self.budget_ratio ** (self.levels - self.end)
        return round(self.max_splats * sum(shares) if self.finish_steps else at_end)

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
    coarse = parameters.end - CELL_LEVELS
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
    cell_values={"levels_from": "trained"},  # cells agree on the distances of these levels
    trains_on_device=lambda parameters: True,
)
