"""What an eye is shown of levels of detail: splats, and a weight in [0, 1] on the opacity of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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


def select(
    bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail
) -> tuple[Splats, np.ndarray | None]:
    """The splats of a bundle that an eye is shown, and their weights (None: all 1), by the method's rule.

    Args:
        eye: (3,) world position that distances are measured from.
        focal_px: focal length in pixels of the image that is looked at.
    """
    eye = np.asarray(eye, np.float32)
    if bundle.cumulative and "d_max" in bundle.meta:
        return _select_octree(bundle, eye, focal_px, detail)
    return _select_flod(bundle, eye, focal_px, detail), None


def complete(bundle: Bundle, level: Level) -> Splats:
    """All that is drawn at a level: the level, and where levels add up the coarser ones with it."""
    if not bundle.cumulative:
        return level.splats
    return Splats.concatenated([x.splats for x in bundle.levels if x.number <= level.number])


def _select_flod(bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail) -> Splats:
    """FLoD's selective rendering as one set (FLoD, Eq. 7)."""
    end = detail.end or len(bundle.levels)
    start = detail.start or max(1, end - 2)
    bands = flod_bands([level.s_min or 0.0 for level in bundle.levels], focal_px, detail.gamma, start, end)
    chosen = []
    for level, (near, far) in zip(bundle.levels, bands, strict=True):
        if start <= level.number <= end:
            distances = np.linalg.norm(level.splats.means - eye, axis=1)
            chosen.append(level.splats.select(band_mask(distances, near, far)))
    return Splats.concatenated(chosen)


def _select_octree(
    bundle: Bundle, eye: np.ndarray, focal_px: float, detail: Detail
) -> tuple[Splats, np.ndarray]:
    chosen, weights = [], []
    levels = bundle.levels[-1].number
    for level in bundle.levels:
        distances = np.linalg.norm(level.splats.means - eye, axis=1) * (bundle.meta["focal_px"] / focal_px)
        bias = level.splats.extras.get(BIAS, np.zeros(1, np.float32)) + np.float32(detail.offset)
        wanted = octree_wanted(distances, bias, bundle.meta["d_max"], levels)
        weight = octree_weights(wanted, level.number).astype(np.float32)
        weight = weight if detail.fade else (weight >= 0.5).astype(np.float32)
        chosen.append(level.splats.select(weight > 0))
        weights.append(weight[weight > 0])
    return Splats.concatenated(chosen), np.concatenate(weights)
