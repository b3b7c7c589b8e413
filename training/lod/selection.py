"""What an eye is shown of levels of detail: splats, and a weight in [0, 1] on the opacity of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import LodgsError
from ..splats.bundle import Bundle, Level
from ..splats.gaussians import Splats
from .rules import band_mask, flod_bands, octree_wanted, octree_weights

BIAS = "lod_bias"
"""Column of each splat's bias, in levels (Octree-GS)."""


@dataclass(frozen=True)
class Detail:
    """How much detail is wanted.

    Attributes:
        gamma: pixels that the smallest detail of a level may cover before a finer one is due (FLoD).
        start, end: coarsest and finest level in use; 0 for the third finest and the finest (FLoD).
        offset: levels finer, or below 0 coarser, than the distance asks for (Octree-GS).
        fade: whether levels fade in, or are there at once from the middle on (Octree-GS).
    """

    gamma: float = 1.0
    start: int = 0
    end: int = 0
    offset: float = 0.0
    fade: bool = True

    def of(self, bundle: Bundle) -> Detail:
        """The same with the levels in use named.

        Raises:
            LodgsError: the bundle has no such levels, or gamma is not above 0.
        """
        finest = len(bundle.levels)
        end = self.end or finest
        start = self.start or max(1, end - 2)
        if not 1 <= start <= end <= finest or not self.gamma > 0:
            raise LodgsError(
                f"Levels {start} to {end} with gamma {self.gamma:g} cannot be shown.",
                f"Choose levels from 1 to {finest}, coarse to fine, and a gamma above 0.",
            )
        return replace(self, start=start, end=end)


@dataclass
class Shown:
    """What is shown of one level.

    Attributes:
        number: of the level.
        splats: those of its splats that have a weight.
        weights: (N,), or None where all are 1.
    """

    number: int
    splats: Splats
    weights: np.ndarray | None = None


def select(
    bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail
) -> tuple[Splats, np.ndarray | None]:
    """The splats of a bundle that an eye is shown, and their weights (None: all 1), by the method's rule.

    Args:
        eye: (3,) world position that distances are measured from.
        focal_px: focal length in pixels of the image that is looked at.
    """
    shown = select_levels(bundle, eye, focal_px, detail)
    weights = [one.weights for one in shown if one.weights is not None]
    return Splats.concatenated([one.splats for one in shown]), np.concatenate(weights) if weights else None


def select_levels(bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail) -> list[Shown]:
    """The same level by level, coarse to fine."""
    eye = np.asarray(eye, np.float32)
    if bundle.cumulative and "d_max" in bundle.meta:
        return _select_octree(bundle, eye, focal_px, detail)
    return _select_flod(bundle, eye, focal_px, detail)


def complete_levels(bundle: Bundle, number: int) -> list[Shown]:
    """All that is drawn at a level: the level, and where levels add up the coarser ones before it.

    Raises:
        LodgsError: there is no such level.
    """
    numbers = [level.number for level in bundle.levels]
    if number not in numbers:
        raise LodgsError(
            f"There is no level {number}.", f"Choose from {numbers[0]} (coarsest) to {numbers[-1]}."
        )
    return [
        Shown(level.number, level.splats)
        for level in bundle.levels
        if level.number == number or (bundle.cumulative and level.number < number)
    ]


def complete(bundle: Bundle, level: Level) -> Splats:
    """All that is drawn at a level: the level, and where levels add up the coarser ones with it."""
    if not bundle.cumulative:
        return level.splats
    return Splats.concatenated([x.splats for x in bundle.levels if x.number <= level.number])


def _select_flod(bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail) -> list[Shown]:
    """FLoD's selective rendering (FLoD, Eq. 7)."""
    end = detail.end or len(bundle.levels)
    start = detail.start or max(1, end - 2)
    bands = flod_bands([level.s_min or 0.0 for level in bundle.levels], focal_px, detail.gamma, start, end)
    chosen = []
    for level, (near, far) in zip(bundle.levels, bands, strict=True):
        if start <= level.number <= end:
            distances = np.linalg.norm(level.splats.means - eye, axis=1)
            chosen.append(Shown(level.number, level.splats.select(band_mask(distances, near, far))))
    return chosen


def _select_octree(bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail) -> list[Shown]:
    chosen = []
    levels = bundle.levels[-1].number
    for level in bundle.levels:
        distances = np.linalg.norm(level.splats.means - eye, axis=1) * (bundle.meta["focal_px"] / focal_px)
        bias = level.splats.extras.get(BIAS, np.zeros(1, np.float32)) + np.float32(detail.offset)
        wanted = octree_wanted(distances, bias, bundle.meta["d_max"], levels)
        weight = octree_weights(wanted, level.number).astype(np.float32)
        weight = weight if detail.fade else (weight >= 0.5).astype(np.float32)
        some = weight > 0
        chosen.append(Shown(level.number, level.splats.select(some), weight[some]))
    return chosen
