"""LODGE (2025): coarser levels of a trained model, smoothed for a distance, pruned and tuned."""

from dataclasses import dataclass, replace
from itertools import pairwise

from ...errors import LodgsError
from ...optimize.method_info import MethodInfo
from ...optimize.parameters import PAPER, STANDARD, SplatParameters
from ...settings import setting
from ...splats.levels import MAX_LEVELS

ROUNDS = (0.2, 0.6, 1.0)
"""Fractions of the pruning threshold in the rounds that prune and tune a level (LODGE, A.2)."""
MERGED_ROUNDS = 2
"""Number of rounds that refine a merged level."""


@dataclass(frozen=True)
class LodgeParameters(SplatParameters):
    """Parameters of LODGE.

    Without a base, ``steps`` train the finest level by 3DGS. Tuples have one entry per level, coarse to fine.
    """

    levels: int = setting(3, "Number of levels, including the finest.", low=1, high=MAX_LEVELS)
    distances: tuple[float, ...] = setting(
        (0.0,) * 3,
        "Distance from which each level is drawn, in median depths of the scene, falling to 0 for the "
        "finest (LODGE: d_l). 0 for another level chooses the distance that draws the fewest splats.",
    )
    levels_from: str = setting(
        "merged",
        "Start of a coarser level. 'merged' merges the next finer level to the number of splats that pruning "
        "would keep, and refines it for all image sizes. 'pruned' smooths and prunes a copy of the finest "
        "level, as in the paper.",
        choices=("merged", "pruned"),
    )
    min_ratio: float = setting(
        2.0,
        "Minimum ratio between the chosen distances of neighbouring levels. Those of LODGE's Table 3 have "
        "ratios down to 1.3.",
        above=1,
    )
    prune_weight: float = setting(
        0.1,
        "Minimum blending weight of a splat in any pixel; a coarser level drops splats below it "
        "(LODGE: γ, value not published).",
        high=1,
    )
    drawn: float = setting(
        0.59,
        "Maximum number of splats drawn by distance in the training views, as a fraction of those of "
        "the finest level; above it, more of the level is pruned. 1 disables. Not in the paper.",
        above=0,
        high=1,
    )
    keep: float = setting(
        0.5,
        "Maximum splat count of a level, as a fraction of the next finer level's; the remaining splats "
        "of a pruned level grow to fill the gaps. Not in the paper.",
        above=0,
        high=1,
    )
    tune_steps: int = setting(
        300,
        "Steps after each of the three prunings of a level; a merged level is refined for twice as many.",
        above=0,
        unit="steps",
    )
    tune_range: float = setting(
        0.3, "Random variation of distances while a level is tuned, as a fraction of the distance.", high=0.9
    )
    tune_each: bool = setting(
        False,
        "Vary the distance of each level by its own random factor while a level is tuned, as in LODGE. "
        "Otherwise all distances have the same factor.",
    )
    tune_alone: float = setting(
        0.5,
        "Fraction of the tuning steps that render a level alone, a pruned one on images downscaled for its "
        "distance, as far as training views are too near to show it. Not in the paper.",
        high=1,
    )
    chunks: int = setting(
        0,
        "Number of chunks: fixed splat sets that blend into each other as the camera moves. 0 uses "
        "LODGE's Eq. 5, and no chunks where it gives few; 1 disables chunks.",
        high=96,
    )
    min_chunks: int = setting(
        8,
        "Minimum number of chunks from Eq. 5. Fewer are as large as the scene, and distances select better.",
        low=2,
    )
    visible_weight: float = setting(
        0.01,
        "Minimum blending weight in any view from inside a chunk; its set omits splats below it "
        "(LODGE: a fixed threshold, value not published). 0 keeps all.",
        high=1,
    )
    filter_variance: float = setting(
        0.2,
        "Variance of the filter that smooths a level, in square pixels at its distance (LODGE: s, "
        "value not published; this is Mip-Splatting's).",
    )

    @property
    def total_steps(self) -> int:
        return self.steps + self.base_steps

    @property
    def base_steps(self) -> int:
        return self.level_steps * (self.levels - 1)

    @property
    def level_steps(self) -> int:
        """Number of steps that tune one level."""
        return (MERGED_ROUNDS if self.merges else len(ROUNDS)) * self.tune_steps

    @property
    def merges(self) -> bool:
        """True if coarser levels are merged."""
        return self.levels_from == "merged"

    def check(self) -> None:
        fixed = [distance for distance in self.distances[:-1] if distance]
        if self.distances[-1] or any(a <= b for a, b in pairwise(fixed)):
            raise LodgsError(
                f"Invalid distances: {list(self.distances)}.",
                "Give decreasing numbers, coarse to fine, the last one 0.",
            )


_DRAFT = LodgeParameters()
_STANDARD = replace(_DRAFT, **STANDARD, steps=30_000, densify_interval=100, tune_steps=1000)
_PAPER = replace(
    _STANDARD,
    **PAPER | {"antialias": True, "densify_from": 600},
    densify_interval=300,
    prune_interval=300,
    densify_by="max",
    least_weight=0.02,
    levels_from="pruned",
    keep=1.0,
    tune_each=True,
    tune_alone=0.0,
    min_ratio=1.3,
    min_chunks=2,
    prune_weight=0.02,
    drawn=1.0,
)

METHOD = MethodInfo(
    name="lodge",
    number=5,
    label="LODGE",
    about="coarser levels of a trained model, each for a greater distance",
    parameters=LodgeParameters,
    presets={"draft": _DRAFT, "standard": _STANDARD, "paper": _PAPER},
    rule="chunks",
    panel_parameters=("levels", "max_splats", "drawn", "keep", "chunks"),
    from_base=True,
    suggested_for_base=True,
    cell_method="3dgs",
)
