"""``training.lod.rules.bands`` in geometry nodes."""

from __future__ import annotations

from ..building import Field
from . import Inputs

VERSION = 1
FADES = False


def weight(inputs: Inputs) -> Field:
    """1 where near <= distance < far, for a level in use."""
    one, other = inputs["first"], inputs["last"]
    first, last = one.minimum(other).minimum(inputs["levels"]), one.maximum(other)
    in_use = (inputs["level"] >= first) & (inputs["level"] <= last)
    near = (inputs["finer"] <= last).where(inputs["s_min"] / inputs["gamma"] * inputs.focal_px, 0.0)
    far = inputs["coarser_s_min"] / inputs["gamma"] * inputs.focal_px
    not_beyond = (inputs["coarser"] >= first).where(inputs.distance < far, 1.0)
    return in_use & (inputs.distance >= near) & not_beyond
