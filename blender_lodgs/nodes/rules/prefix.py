"""Rule ``training.lod.rules.prefix`` in geometry nodes."""

from __future__ import annotations

from ....training.lod.rules.prefix import RANK, VIEW_DISTANCE
from ..building import Field
from . import RuleInputs

VERSION = 1
FADES = False


def weight(inputs: RuleInputs) -> Field:
    """Return 1 for the splats before the limit of their distance and before the splat limit."""
    scale = inputs["share"].sqrt() * inputs.focal_px / inputs["share_focal"].maximum(1e-20)
    nearness = inputs.column(VIEW_DISTANCE) * scale / inputs["distance_scale"]
    nearness = (nearness / inputs.distance.maximum(1e-20)).minimum(1.0)
    rank = inputs.column(RANK)
    within = (inputs["at_most"] < 0.5).where(1.0, rank < inputs["at_most"])
    return within & (rank < nearness * nearness * inputs["splats"])
