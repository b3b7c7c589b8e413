"""``training.lod.rules.decay`` in geometry nodes."""

from __future__ import annotations

from ....training.lod.rules.decay import CLEAR, EPSILON, NEWTON_STEPS, SIGMA
from ..building import Field
from . import Inputs

VERSION = 2
FADES = True


def weight(inputs: Inputs) -> Field:
    """The attenuation where opacity times attenuation is above tau times the virtual scale, else 0; of
    several levels the finest alone."""
    nodes, opacity = inputs.nodes, inputs.opacity()
    farthest = nodes.add("GeometryNodeAttributeStatistic", data_type="FLOAT", domain="POINT")
    nodes.link(inputs.points, farthest, "Geometry")
    nodes.link(inputs.distance.socket, farthest, "Attribute")
    farthest = nodes.field(next(s for s in farthest.outputs if s.name == "Max" and s.enabled))
    reference = (inputs["reference"] > 0.0).where(inputs["reference"], farthest)
    normalized = inputs.distance / reference.maximum(1e-20)
    sigma = inputs.column(SIGMA).maximum(0.0)
    variance = sigma * sigma * 2.0 + EPSILON

    s_v = (inputs["at_most"] > 0.5).where(_for_budget(inputs, opacity, normalized, variance), 0.0)
    s_v = s_v.maximum(inputs["s_v"])
    scaled = normalized * s_v
    attenuation = (scaled * scaled / variance * -1.0).exp()
    seen = (opacity * attenuation > inputs["tau"] * s_v) & (inputs["level"] >= inputs["levels"])
    return seen * attenuation


def _for_budget(inputs: Inputs, opacity: Field, normalized: Field, variance: Field) -> Field:
    """The virtual scale that leaves "at_most" splats: that of the first one too many, and a little more."""
    nodes, ratio = inputs.nodes, opacity / inputs["tau"]
    product = (normalized * normalized * 2.0 / variance * ratio * ratio).clip(1e-12, 1e30)
    w = (product + 1.0).log()
    for _ in range(NEWTON_STEPS):
        w = w / (w + 1.0) * ((product / w).log() + 1.0)
    limit = ratio * (w * -0.5).exp()
    ordered = nodes.sorted(inputs.points, (limit * -1.0).socket)
    return nodes.field(nodes.sampled(ordered, limit.socket, inputs["at_most"].socket)) * (1 + CLEAR)
