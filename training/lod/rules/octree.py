"""Octree-GS's rule (Ren et al. 2024, Sec. 4.1): levels add up, and fade in as the camera approaches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ..rule import NO_COLUMNS, NO_TABLES, Control, Rule, Values, distances

BIAS = "lod_bias"
"""Column of each splat's level bias."""
FADE = 0.5
"""Range of the target level over which a level fades in."""
STEP = 0.25
"""Change of the level offset per budget step."""
BAND_MARGIN = 1e-4
"""Safety margin of a distance band, in levels, against rounding."""


def target_level(distances, bias, d_max: float, levels: float):
    """Return the target level at a distance, 1 to ``levels``, not rounded (Eq. 5 with the bias).

    Args:
        distances: (N,) numpy or torch, camera distances, times the focal length of d_max divided by the
            camera's.
        bias: (N,) level bias of each splat, with the global offset added if there is one.
        d_max: distance from which on only level 1 is drawn if the bias is 0.
    """
    ratio = d_max / distances.clip(1e-20)
    log2 = ratio.log2() if hasattr(ratio, "log2") else np.log2(ratio)
    return (log2 + bias).clip(0, levels - 1) + 1


def fade_weights(target, level):
    """Return weights (N,) of splats of a level: 1 below the target level, a fraction near it, 0 above.

    Level 1 always has weight 1. Weights are piecewise linear in the target level (Sec. 4.1). Training rounds
    the target level, which draws a level where its weight here is at least 1/2. A level fades in over FADE
    levels around that threshold (1 in the paper, which draws up to half a level more than training).

    Args:
        target: (N,) of :func:`target_level`, numpy or torch.
        level: (N,) or a number; 1 is the coarsest.
    """
    return ((target - level + 0.5) / FADE + 0.5).clip(0, 1)


class Octree(Rule):
    """``fade_weights(target_level(...), level)``: all coarser levels, and part of the target level."""

    name = "octree"
    cumulative = True
    scene_facts = ("d_max", "d_max_focal")
    lengths = ("d_max",)
    columns = (BIAS,)
    fade_factor = 2.0**FADE
    controls = (
        Control(
            "offset", 0.0, -16.0, 16.0, "Level Offset",
            "Offset on the level for each distance: positive is finer, negative is coarser", soft=(-4.0, 4.0),
        ),
        Control(
            "fade", 1, 0, 1, "Fade",
            "Fade levels in as the camera approaches. If disabled, they appear at once", integer=True,
        ),
    )  # fmt: skip

    def distance_band(
        self, focal_px: float, facts: Mapping[str, float], values: Values, highest=NO_COLUMNS
    ) -> tuple[float, float | np.ndarray]:
        """Return 0 and the distance beyond which even the splat with the highest bias has weight 0."""
        if facts["level"] <= 1 or BIAS not in highest:
            return 0.0, inf
        # weights are > 0 (>= 0.5 without fading) for target levels log2(d_max / d) + bias + offset + 1
        short = facts["level"] - 1.5 - (FADE / 2 if values["fade"] else 0) - BAND_MARGIN
        levels = highest[BIAS].astype(np.float64) + (values["offset"] - short)
        with np.errstate(over="ignore", invalid="ignore"):  # a bias that is not a number
            return 0.0, _scaled_d_max(focal_px, facts) * np.exp2(levels)

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        target = self._target(means, position, focal_px, columns[BIAS], facts, values)
        weight = fade_weights(target, np.float32(facts["level"])).astype(np.float32)
        return weight if values["fade"] else (weight >= 0.5).astype(np.float32)

    def target_level(self, means, position, focal_px, facts, values) -> np.ndarray:
        return np.floor(self._target(means, position, focal_px, np.float32(0), facts, values))

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        offset = values["offset"] - STEP
        return {**values, "offset": offset} if offset > -levels[-1] else None

    def _target(
        self, means, position, focal_px: float, bias, facts: Mapping[str, float], values: Values
    ) -> np.ndarray:
        """Return the target level of each splat; the focal length scales distances as in Sec. 5.2."""
        d_max = _scaled_d_max(focal_px, facts)
        return target_level(
            distances(means, position), bias + np.float32(values["offset"]), d_max, facts["levels"]
        )


def _scaled_d_max(focal_px: float, facts: Mapping[str, float]) -> float:
    """Return ``d_max`` scaled to the camera's focal length."""
    return float(np.float32(facts["d_max"] * (focal_px / max(facts["d_max_focal"], 1e-20))))


RULE = Octree()
