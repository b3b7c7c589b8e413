"""Octree-GS's rule (Ren et al. 2024, Sec. 4.1): levels add up, and fade in as the eye comes nearer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ..rule import NO_COLUMNS, NO_TABLES, Control, Rule, Values, distances

BIAS = "lod_bias"
"""Column of each splat's bias, in levels."""
FADE = 0.5
"""Over how many levels of what is wanted a level fades in."""
STEP = 0.25
"""Levels that a budget goes without at a time."""
BAND_MARGIN = 1e-4
"""Levels by which a band is taken too far, against rounding."""


def target_level(distances, bias, d_max: float, levels: float):
    """The level that is wanted at a distance, 1 to ``levels``, not rounded (Eq. 5 with the bias).

    Args:
        distances: (N,) numpy or torch, from the eye, times the focal length that d_max belongs to over the
            eye's own.
        bias: (N,) each splat's bias, in levels, to which a global offset may be added.
        d_max: the distance from which on level 1 alone is wanted where the bias is 0.
    """
    ratio = d_max / distances.clip(1e-20)
    log2 = ratio.log2() if hasattr(ratio, "log2") else np.log2(ratio)
    return (log2 + bias).clip(0, levels - 1) + 1


def fade_weights(wanted, level):
    """Weights (N,) of splats of a level: 1 below the wanted level, part of it near that, 0 above.

    Level 1 is always there. Sec. 4.1: piecewise linear in the wanted level. The paper rounds it in training,
    which is where this is at least one half; a level fades in over FADE levels around that place (1 in the
    paper: then up to half a level more is drawn than training knew).

    Args:
        wanted: (N,) of :func:`target_level`, numpy or torch.
        level: (N,) or a number, 1 is the coarsest.
    """
    return ((wanted - level + 0.5) / FADE + 0.5).clip(0, 1)


class Octree(Rule):
    """``faded(wanted_at(...), level)``: of the wanted level part, all coarser ones, no finer one."""

    name = "octree"
    cumulative = True
    scene_facts = ("d_max", "d_max_focal")
    lengths = ("d_max",)
    columns = (BIAS,)
    controls = (
        Control(
            "offset", 0.0, -16.0, 16.0, "Level Offset",
            "Levels finer (above 0) or coarser (below 0) than the distance asks for", soft=(-4.0, 4.0),
        ),
        Control(
            "fade", 1, 0, 1, "Fade",
            "Levels fade in as the eye comes nearer; without it (0) they are there at once", whole=True,
        ),
    )  # fmt: skip

    def distance_band(
        self, focal_px: float, facts: Mapping[str, float], values: Values, highest=NO_COLUMNS
    ) -> tuple[float, float | np.ndarray]:
        """0, and where the splat with the highest bias is no longer wanted; level 1 is wanted everywhere."""
        if facts["level"] <= 1 or BIAS not in highest:
            return 0.0, inf
        # faded(wanted, level) > 0, or >= 0.5 without fading, of wanted = log2(d_max / d) + bias + offset + 1
        short = facts["level"] - 1.5 - (FADE / 2 if values["fade"] else 0) - BAND_MARGIN
        levels = highest[BIAS].astype(np.float64) + (values["offset"] - short)
        with np.errstate(over="ignore", invalid="ignore"):  # of a bias that is no number
            return 0.0, _own_d_max(focal_px, facts) * np.exp2(levels)

    def weights(self, means, eye, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        found = self._wanted(means, eye, focal_px, columns[BIAS], facts, values)
        weight = fade_weights(found, np.float32(facts["level"])).astype(np.float32)
        return weight if values["fade"] else (weight >= 0.5).astype(np.float32)

    def wanted_level(self, means, eye, focal_px, facts, values) -> np.ndarray:
        return np.floor(self._wanted(means, eye, focal_px, np.float32(0), facts, values))

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        offset = values["offset"] - STEP
        return {**values, "offset": offset} if offset > -levels[-1] else None

    def _wanted(
        self, means, eye, focal_px: float, bias, facts: Mapping[str, float], values: Values
    ) -> np.ndarray:
        """The level wanted where each splat is; the focal length counts as in Sec. 5.2."""
        d_max = _own_d_max(focal_px, facts)
        return target_level(
            distances(means, eye), bias + np.float32(values["offset"]), d_max, facts["levels"]
        )


def _own_d_max(focal_px: float, facts: Mapping[str, float]) -> float:
    """``d_max`` for an eye of another focal length than it was found for."""
    return float(np.float32(facts["d_max"] * (focal_px / max(facts["d_max_focal"], 1e-20))))


RULE = Octree()
