"""``training.lod.rules.chunks`` in geometry nodes."""

from __future__ import annotations

from ....training.lod.rule import NO_FINER
from ..building import Field
from . import Inputs

VERSION = 1
FADES = False


def weight(inputs: Inputs) -> Field:
    """1 where d_l <= distance < d_l of the next coarser level."""
    away = inputs.distance * inputs["distance_scale"]
    from_near = (inputs["finer"] >= float(NO_FINER)).where(1.0, away >= inputs["d_l"])
    not_beyond = (inputs["coarser"] > 0.5).where(away < inputs["coarser_d_l"], 1.0)
    return from_near & not_beyond
