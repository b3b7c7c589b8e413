"""Parameters of coarser levels merged from the finest, shared by methods. Does not import torch."""

from dataclasses import dataclass, replace
from typing import Self

from ..settings import setting

REFINE_RATIO = 0.7
"""Steps that refine a merged level relative to those of the next finer one."""
MAX_REPEATS = 100
"""Maximum number of times that each training photo refines the level before the finest. With more steps, the
levels of scenes with few photos overfit."""


@dataclass(frozen=True)
class MergedParameters:
    """Parameters of merged levels."""

    merge_ratio: float = setting(
        0.5,
        "Splat count of a merged level, as a fraction of the next finer level's. The level before the finest "
        "has at most the share that views by distance may draw ('drawn').",
        above=0,
        high=1,
    )
    refine_steps: int = setting(
        1000,
        f"Steps that refine the merged level before the finest, at most {MAX_REPEATS} per training photo. "
        "Each coarser level gets 70 % of the steps of "
        "the next finer one. In FLoD they are taken from those of all levels ('steps'), at most half; the "
        "finest level gets the others.",
        unit="steps",
    )
    drawn: float = setting(
        0.45,
        "Maximum number of splats drawn by distance in the training views, as a fraction of those of "
        "the finest level. Limits the size of merged levels, sets their distances, and the size of trained "
        "levels that FLoD's finishing steps restart. Not in the paper.",
        above=0,
        high=1,
    )

    @property
    def merges(self) -> bool:
        """True if coarser levels are merged from the finest."""
        raise NotImplementedError

    @property
    def stages(self) -> list[tuple[int, int]]:
        """Levels in the order of their training, with their numbers of steps."""
        raise NotImplementedError

    def for_photos(self, count: int) -> Self:
        """Return the parameters for a number of training photos."""
        return replace(self, refine_steps=min(self.refine_steps, MAX_REPEATS * count))

    def share_below(self, count: int) -> float:
        """Return the relative number of splats of a level, ``count`` levels below the finest."""
        return min(self.merge_ratio**count, self.drawn) if count else 1.0


def refining_steps(first: float, levels: int) -> list[int]:
    """Return the steps that refine each merged level, finest first.

    Args:
        first: steps of the level before the finest.
        levels: number of merged levels.
    """
    return [max(int(first * REFINE_RATIO**n), 1) for n in range(levels)]
