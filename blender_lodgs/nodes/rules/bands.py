"""Rule ``training.lod.rules.bands`` in geometry nodes."""

from __future__ import annotations

from ..building import Field
from . import RuleInputs

VERSION = 1
FADES = False


def weight(inputs: RuleInputs) -> Field:
    """Return 1 if near <= distance < far and the level is in use."""
    first = inputs["first"].minimum(inputs["last"]).minimum(inputs["levels"])
    last = inputs["first"].maximum(inputs["last"])
    in_use = (inputs["level"] >= first) & (inputs["level"] <= last)
    near = (inputs["finer"] <= last).where(inputs["s_min"] / inputs["gamma"] * inputs.focal_px, 0.0)
    far = inputs["coarser_s_min"] / inputs["gamma"] * inputs.focal_px
    before_far = (inputs["coarser"] >= first).where(inputs.distance < far, 1.0)
    return in_use & (inputs.distance >= near) & before_far
