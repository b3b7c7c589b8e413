"""LODGE's rule (2025, Sec. 3): each level serves distances from one on, up to the next coarser level's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from ..rule import NO_FINER, Control, Rule, Values, distances

STEP = 1.25
"""Factor by which a viewer's budget raises the distance scale at a time."""


class Chunks(Rule):
    """Level l is drawn where d_l <= d < d_(l of the next coarser level) (Eq. 2).

    The finest level that there is begins at 0, the coarsest has no end.
    """

    name = "chunks"
    level_facts = ("d_l",)
    controls = (
        Control(
            "distance_scale", 1.0, 0.01, 100.0, "Distance Scale",
            "As if everything were so many times farther away. Smaller is finer", soft=(0.1, 10.0),
        ),
    )  # fmt: skip

    def band(self, facts: Mapping[str, float]) -> tuple[float, float]:
        """The nearest distance of a level, in scene units, and the distance from which on it is not shown."""
        near = 0.0 if facts["finer"] == NO_FINER else facts["d_l"]
        return near, facts["coarser_d_l"] if facts["coarser"] else inf

    def weights(self, means, eye, focal_px, columns, facts, values) -> np.ndarray:
        near, far = self.band(facts)
        away = distances(means, eye) * np.float32(values["distance_scale"])
        return ((away >= np.float32(near)) & (away < np.float32(far))).astype(np.float32)

    def coarser(self, values: Values, levels: Sequence[int]) -> Values | None:
        scale = values["distance_scale"] * STEP
        return {**values, "distance_scale": scale} if scale <= self.controls[0].high else None


RULE = Chunks()
