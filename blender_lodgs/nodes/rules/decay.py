"""Rule ``training.lod.rules.decay`` in geometry nodes."""

from __future__ import annotations

from ....training.lod.rules.decay import EPSILON, LIMIT_MARGIN, NEWTON_STEPS, SIGMA
from ..building import Field
from . import RuleInputs

VERSION = 2
FADES = True


def weight(inputs: RuleInputs) -> Field:
    """Return the attenuation if opacity * attenuation > tau * virtual scale, else 0.

    Only the finest of several levels is used.
    """
    nodes = inputs.nodes
    opacity = inputs.opacity()
    statistic = nodes.add("GeometryNodeAttributeStatistic", data_type="FLOAT", domain="POINT")
    nodes.link(inputs.points, statistic, "Geometry")
    nodes.link(inputs.distance.socket, statistic, "Attribute")
    farthest = nodes.field(next(s for s in statistic.outputs if s.name == "Max" and s.enabled))
    reference = (inputs["reference"] > 0.0).where(inputs["reference"], farthest)
    normalized = inputs.distance / reference.maximum(1e-20)
    sigma = inputs.column(SIGMA).maximum(0.0)
    variance = sigma * sigma * 2.0 + EPSILON

    s_v = (inputs["at_most"] > 0.5).where(_for_budget(inputs, opacity, normalized, variance), 0.0)
    s_v = s_v.maximum(inputs["s_v"])
    scaled = normalized * s_v
    attenuation = (scaled * scaled / variance * -1.0).exp()
    visible = (opacity * attenuation > inputs["tau"] * s_v) & (inputs["level"] >= inputs["levels"])
    return visible * attenuation


def _for_budget(inputs: RuleInputs, opacity: Field, normalized: Field, variance: Field) -> Field:
    """Return the virtual scale that keeps "at_most" splats: just above the limit of the next splat."""
    nodes = inputs.nodes
    ratio = opacity / inputs["tau"]
    product = (normalized * normalized * 2.0 / variance * ratio * ratio).clip(1e-12, 1e30)
    w = (product + 1.0).log()
    for _ in range(NEWTON_STEPS):
        w = w / (w + 1.0) * ((product / w).log() + 1.0)
    limit = ratio * (w * -0.5).exp()
    ordered = nodes.sort_points(inputs.points, (limit * -1.0).socket)
    return nodes.field(nodes.sample(ordered, limit.socket, inputs["at_most"].socket)) * (1 + LIMIT_MARGIN)
