"""FLoD (Seo et al. 2025): independent levels, each limited to a smallest size of detail."""

from dataclasses import dataclass, replace

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, DensityParameters, parameter
from ...splats.levels import MAX_LEVELS

PAPER_FOOTPRINT = 40.0
"""Pixels that the paper's lambda, 0.2 COLMAP units, covers at the median depth of its scenes, about."""
TOGETHER = 3
"""So many levels are drawn together by default (``Bands.defaults``), and finished."""
CELL_LEVELS = 2
"""So many of the finest levels of a scene in cells are trained cell by cell."""
PAPER_REACH = PAPER_FOOTPRINT / 4**3
"""How far the paper's finest level of five reaches by distance (Eq. 8, gamma 1), in median depths: 5/8."""


@dataclass(frozen=True)
class FlodParameters(DensityParameters):
    """A tuple has one entry for each level, coarse to fine. ``max_splats`` is the last level's."""

    levels: int = parameter(5, "Number of levels (FLoD: L_max).", low=1, high=MAX_LEVELS)
    rho: float = parameter(
        4.0, "Factor between the smallest sizes of two neighbouring levels (FLoD: rho).", above=1
    )
    footprint: float = parameter(
        16.0,
        "Pixels that level 1's smallest size covers at the scene's median depth; sets lambda, and the screen "
        "size (gamma) that levels are chosen with by distance.",
        label="Coarsest Detail",
        above=0,
        unit="px",
    )
    s_min_1: float = parameter(
        0.0, "Level 1's smallest size in scene units (FLoD: lambda); 0 takes it from 'footprint'."
    )
    steps: tuple[int, ...] = parameter(
        (250, 400, 500, 750, 1250), "Training steps of each level.", above=0, unit="steps"
    )
    densify_until: tuple[float, ...] = parameter(
        (0.5,) * 5, "Share of a level's steps after which splats are no longer added or removed.", high=1
    )
    densify_interval: tuple[int, ...] = parameter(
        (50,) * 5, "Steps between two densifications.", above=0, unit="steps"
    )
    budget_ratio: float = parameter(
        0.6,
        "A level's share of the next finer level's budget of splats, so that every level adds some; about "
        "what the paper's levels have by themselves.",
        above=0,
        high=1,
    )
    overlap_interval: int = parameter(
        50,
        "Steps between two overlap prunings; the last level has none (FLoD, Sec. 4.3). 0 never prunes.",
        unit="steps",
    )
    rejoin_points: bool = parameter(
        True,
        "Whether structure-from-motion points that overlap pruning took join again at the level that has "
        "room for them, all or a random sample. Not in the paper; in short schedules it lets finer levels "
        "begin from exact positions.",
    )

    first_level: int = parameter(
        1, "Level that training begins with; above 1 from a base, which is the level before it.", low=1
    )
    last_level: int = parameter(0, "Level that training ends with; 0 for the finest.")
    finish_share: float = parameter(
        0.2,
        "Further steps at the end, as a share of all levels', that fit the three finest levels to how they "
        "are drawn together by distance; of the two coarser ones those of fine detail begin anew with the "
        "finest level's most important splats. Not in the paper.",
        high=1,
    )
    drawn: float = parameter(
        0.53,
        "By distance the training views draw at most this share of the splats that they draw of the finest "
        "level alone: so many splats do the levels have that finishing steps begin anew. Not in the paper.",
        above=0,
        high=1,
    )
    finish_alone: float = parameter(
        0.5,
        "Share of these steps that draw one of the three alone, so that it does not need the others.",
        high=1,
    )

    @property
    def end(self) -> int:
        """The level that training ends with."""
        return self.last_level or self.levels

    @property
    def total_steps(self) -> int:
        return sum(self.steps[self.first_level - 1 : self.end]) + self.finish_steps

    @property
    def all_steps(self) -> int:
        """Steps of a run of all levels, which schedules are shares of."""
        return sum(self.steps) + (round(self.finish_share * sum(self.steps)) if self.levels > 1 else 0)

    @property
    def finish_steps(self) -> int:
        """Steps that train the finest levels together, if the finest is trained and not the only one."""
        return self.all_steps - sum(self.steps) if self.end == self.levels else 0

    @property
    def continues_levels(self) -> bool:
        return self.first_level > 1

    @property
    def max_trained_splats(self) -> int:
        shares = (self.budget_ratio**n for n in range(min(TOGETHER, self.levels)))
        at_end = self.max_splats * self.budget_ratio ** (self.levels - self.end)
        return round(self.max_splats * sum(shares) if self.finish_steps else at_end)

    def check(self) -> None:
        if not self.first_level <= self.end <= self.levels:
            raise LodgsError(
                f"Levels {self.first_level} to {self.end} of {self.levels} cannot be trained.",
                "Correct first_level or last_level.",
            )


def divided(parameters: FlodParameters) -> tuple[FlodParameters, FlodParameters] | None:
    """For a scene in cells: all but the two finest levels of the whole, and these two of each cell."""
    coarse = parameters.levels - CELL_LEVELS
    if coarse < 1:
        return None
    return replace(parameters, last_level=coarse), replace(parameters, first_level=coarse + 1)


_DRAFT = FlodParameters()
_STANDARD = replace(
    _DRAFT,
    **STANDARD,
    steps=(2_000, 3_000, 4_000, 6_000, 15_000),
    densify_interval=(100,) * 5,
)
_PAPER = replace(
    _STANDARD,
    **PAPER,
    footprint=PAPER_FOOTPRINT,
    steps=(10_000, 15_000, 20_000, 25_000, 30_000),
    densify_until=(0.5, 0.4, 0.4, 0.4, 0.5),
    densify_interval=(2000, 1000, 500, 500, 200),
    overlap_interval=1000,
    rejoin_points=False,
    finish_share=0.0,
    budget_ratio=1.0,
)

METHOD = MethodInfo(
    name="flod",
    number=0,
    label="FLoD",
    about="independent levels, each limited to a smallest size of detail",
    parameters=FlodParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="bands",
    panel_parameters=("levels", "footprint", "max_splats"),
    cell_method="flod",
    split_parameters=divided,
)
