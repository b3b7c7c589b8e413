"""FLoD's rule (Seo et al. 2025, Sec. 5.2): one level for each band of camera distances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ...errors import LodgsError
from ..rule import NO_COLUMNS, NO_TABLES, Control, Rule, Values, distances

MAX_LEVEL = 64
"""Maximum level number of the controls; more than any scene has."""
PAPER_REACH = 40.0 / 4**3
"""Reach of the paper's finest of five levels by distance (Eq. 8, gamma 1), in median depths: 5/8. Its lambda
is about 40 pixels there."""


def min_scales(s_min_1: float, rho: float, levels: int) -> list[float]:
    """Return FLoD's 3D scale constraint of each level (Eq. 3): s_min_1 * rho**(1 - l), and 0 for the last.

    Args:
        s_min_1: constraint of level 1, in scene units (the paper's lambda).
        rho: factor between two levels.
        levels: number of levels; one level has no constraint, which is plain 3DGS.
    """
    return [s_min_1 * rho ** (1 - level) for level in range(1, levels)] + [0.0]


class Bands(Rule):
    """Level l is drawn where d_proj(l) <= d < d_proj(l - 1) (Eq. 7).

    At the distance d_proj(l) = s_min(l) / gamma * focal_px (Eq. 8), the smallest detail of level l covers
    gamma pixels. The finest level in use begins at 0, the coarsest has no end.
    """

    name = "bands"
    level_facts = ("s_min",)
    lengths = level_facts
    controls = (
        Control(
            "gamma", 1.0, 0.01, 1000.0, "Screen Size",
            "Switch to a finer level where the smallest detail of the coarser one covers this many pixels "
            "(FLoD: γ). Smaller is finer",
            soft=(0.1, 10.0), unit="px",
        ),
        Control(
            "first", 1, 1, MAX_LEVEL, "Coarsest", "Coarsest level in use, shown at the largest distances",
            integer=True, follows="coarsest",
        ),
        Control(
            "last", MAX_LEVEL, 1, MAX_LEVEL, "Finest", "Finest level in use, shown nearest to the camera",
            integer=True, follows="finest",
        ),
    )  # fmt: skip

    def distance_band(
        self, focal_px: float, facts: Mapping[str, float], values: Values, highest=NO_COLUMNS
    ) -> tuple[float, float]:
        """Return near and far end of a level's band, in scene units; (inf, inf) for a level not in use."""
        first = min(values["first"], values["last"], facts["levels"])  # crossed sliders still leave a level
        last = max(values["first"], values["last"])
        if not first <= facts["level"] <= last:
            return inf, inf
        near = facts["s_min"] / values["gamma"] * focal_px if facts["finer"] <= last else 0.0
        far = facts["coarser_s_min"] / values["gamma"] * focal_px if facts["coarser"] >= first else inf
        return near, far

    def fills_band(self, values: Values) -> bool:
        return True

    def weights(self, means, position, focal_px, columns, facts, values, tables=NO_TABLES) -> np.ndarray:
        near, far = self.distance_band(focal_px, facts, values)
        if near == inf:
            return np.zeros(len(means), np.float32)
        distance = distances(means, position)
        return ((distance >= np.float32(near)) & (distance < np.float32(far))).astype(np.float32)

    def defaults(self, levels: Sequence[int]) -> dict[str, float]:
        """Use the three finest levels, like the published figures (Sec. 5)."""
        return super().defaults(levels) | {"first": levels[-3:][0], "last": levels[-1]}

    def resolve_controls(
        self, changes: Values, levels: Sequence[int], recorded: Values | None = None
    ) -> Values:
        values = super().resolve_controls(changes, levels, recorded)
        first, last = (int(values[name]) for name in ("first", "last"))
        if not levels[0] <= first <= last <= levels[-1]:
            raise LodgsError(
                f"Cannot show levels {first} to {last}.",
                f"Choose levels from {levels[0]} to {levels[-1]}, coarse to fine.",
            )
        return values

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        in_use = [number for number in levels if values["first"] <= number <= values["last"]]
        return {**values, "last": in_use[-2]} if len(in_use) > 1 else None

    def less_detail(self, values: Values, levels: Sequence[int]) -> Values | None:
        return self.raise_control(values, "gamma")


RULE = Bands()


def initial_gamma(pixels: float) -> float:
    """Return the gamma at which the finest level reaches as far as the paper's, in median depths.

    d_proj(l) = s_min(l) / gamma * f (Eq. 8) falls with s_min. With a fixed gamma, the finest level of a
    smaller footprint, or of more levels, would never be drawn. The maximum is the paper's value, one pixel,
    so that coarse levels do not appear at distances where their lack of detail is visible.

    Args:
        pixels: minimum size of the level before the finest, in pixels at the median depth.
    """
    value = max(min(pixels / PAPER_REACH, 1.0), RULE.controls[0].low)
    return float(f"{value:.6g}")  # Blender stores as many digits
