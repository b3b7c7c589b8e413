"""Rule ``training.lod.rules.octree`` in geometry nodes."""

from __future__ import annotations

from ....training.lod.rules.octree import BIAS, FADE
from ..building import Field
from . import RuleInputs

VERSION = 1
FADES = True


def weight(inputs: RuleInputs) -> Field:
    """Return the weight of each splat for its distance and bias, as ``training.lod.rules.octree``."""
    d_max = inputs["d_max"] * inputs.focal_px / inputs["d_max_focal"]
    target = (d_max / inputs.distance.maximum(1e-20)).log2() + inputs.column(BIAS) + inputs["offset"]
    target = target.clip(0.0, inputs["levels"] - 1.0) + 1.0
    weight = ((target - inputs["level"] + 0.5) / FADE + 0.5).clip(0.0, 1.0)
    return (inputs["fade"] > 0.5).where(weight, weight >= 0.5)
