"""LODGE (2025): coarser levels from a finished model, smoothed for a distance, pruned and tuned."""

from dataclasses import dataclass, replace
from itertools import pairwise

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, parameter
from ...splats.levels import MAX_LEVELS
from ..threedgs import ThreedgsParameters

ROUNDS = (0.2, 0.6, 1.0)
"""A level is pruned and tuned so often, with these shares of the pruning threshold (LODGE, A.2)."""


@dataclass(frozen=True)
class LodgeParameters(ThreedgsParameters):
    """Those of LODGE; ``steps`` are the finest level's, which is 3DGS where there is no base.

    A tuple has one entry for each level, coarse to fine.
    """

    levels: int = parameter(3, "Number of levels, the finest among them.", low=1, high=MAX_LEVELS)
    distances: tuple[float, ...] = parameter(
        (0.0,) * 3,
        "Distance from which on each level is shown, in median depths of the scene, falling to 0 for the "
        "finest (LODGE: d_l). 0 finds the one that leaves least to draw.",
    )
    prune_weight: float = parameter(
        0.1,
        "Splats of a coarser level that are nowhere more than this share of a pixel are removed (LODGE: γ, "
        "without a number).",
        high=1,
    )
    drawn: float = parameter(
        0.59,
        "By distance the training views draw at most this share of the splats that they draw of the finest "
        "level alone; where it is more, prune_weight is raised for a level. 1 does not raise it. Not in the "
        "paper.",
        above=0,
        high=1,
    )
    keep: float = parameter(
        1.0,
        "At most about this share of the next finer level's splats stays, of those that stand together; "
        "what stays takes over the room of what goes. For scenes of many small splats, of which each has a "
        "fair share of some pixel: 0.3 to 0.4 there. Not in the paper.",
        above=0,
        high=1,
    )
    tune_steps: int = parameter(
        400, "Steps after each of the three prunings of a level.", above=0, unit="steps"
    )
    tune_range: float = parameter(
        0.3, "While a level is tuned, distances are random by this share of them, up or down.", high=0.9
    )
    tune_alone: float = parameter(
        0.25,
        "Share of these steps that draw the level alone, on photographs as small as they are from its "
        "distance, so that it stands where no training view is as far away. Not in the paper.",
        high=1,
    )
    chunks: int = parameter(
        0,
        "Number of chunks, whose fixed sets of splats fade into each other as the eye moves. 0: as many as "
        "LODGE's Eq. 5 asks for, and none where that would be fewer than 8; 1: none.",
        high=96,
    )
    visible_weight: float = parameter(
        0.01,
        "Splats that no view in a chunk, turned anywhere, shows by so large a share of a pixel are not in "
        "its set (LODGE: a fixed threshold, without a number). 0 keeps all.",
        high=1,
    )
    filter_variance: float = parameter(
        0.2,
        "Variance of the filter that smooths a level, in squared pixels at its distance (LODGE: s, without a "
        "number; Mip-Splatting's).",
    )

    @property
    def total_steps(self) -> int:
        return self.steps + self.base_steps

    @property
    def base_steps(self) -> int:
        return self.level_steps * (self.levels - 1)

    @property
    def level_steps(self) -> int:
        """Steps that tune one level."""
        return len(ROUNDS) * self.tune_steps

    def check(self) -> None:
        given = [distance for distance in self.distances[:-1] if distance]
        if self.distances[-1] or any(a <= b for a, b in pairwise(given)):
            raise LodgsError(
                f"distances = {list(self.distances)} is not possible.",
                "Give falling numbers, coarse to fine, the last one 0.",
            )


_DRAFT = LodgeParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100, tune_steps=1000)
_PAPER = replace(
    _STANDARD,
    **PAPER | {"antialias": True},
    densify_interval=300,
    densify_from=600,
    densify_by="max",
    least_weight=0.02,
    tune_alone=0.0,
    prune_weight=0.02,
    drawn=1.0,
)

METHOD = MethodInfo(
    name="lodge",
    number=5,
    label="LODGE",
    about="coarser levels from a finished model, each for what is farther away",
    parameters=LodgeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="chunks",
    panel_parameters=("levels", "max_splats", "drawn", "keep", "chunks"),
    from_base=True,
    suggested_for_base=True,
    cell_method="3dgs",
)
