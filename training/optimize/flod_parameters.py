"""Parameters and published values of FLoD, shared by splats and neural anchors. Does not import torch."""

from dataclasses import dataclass

from ..settings import setting
from ..splats.levels import MAX_LEVELS

STANDARD_STEPS = (2_000, 3_000, 4_000, 6_000, 15_000)
"""Steps of each level in presets *standard*."""
PAPER_STEPS = (10_000, 15_000, 20_000, 25_000, 30_000)
PAPER_UNTIL = (0.499, 0.399, 0.399, 0.399, 0.499)
"""Fraction of a level's steps with density control: the published program leaves out its last step."""
PAPER_INTERVALS = (2000, 1000, 500, 500, 200)
PAPER_FOOTPRINT = 40.0
"""Approximate size in pixels of the paper's lambda, 0.2 COLMAP units, at the median depth of its scenes."""


@dataclass(frozen=True)
class FlodLevels:
    """Parameters of levels with minimum splat sizes."""

    levels: int = setting(5, "Number of levels (FLoD: L_max).", low=1, high=MAX_LEVELS)
    rho: float = setting(
        4.0, "Ratio of the minimum splat sizes of two neighbouring levels (FLoD: rho).", above=1
    )
    s_min_1: float = setting(
        0.0,
        "Minimum splat size of level 1 in scene units (FLoD: lambda). 0 derives it from the coarsest detail.",
    )
    budget_ratio: float = setting(
        0.6,
        "Maximum splat count of a trained level, as a fraction of the next finer level's; below 1 every "
        "level adds splats. The levels of the paper have about this ratio.",
        above=0,
        high=1,
    )
