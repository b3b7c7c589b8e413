"""The node group "LODGS Octree Level": ``training.lod.rules.octree_weights`` in geometry nodes."""

from __future__ import annotations

import bpy

from ...training.lod.rules import FADE
from ...training.lod.selection import BIAS
from ..objects import WEIGHT
from .building import Builder, existing

NAME = "LODGS Octree Level"
LEVEL, LEVELS, FARTHEST, OFFSET = "Level", "Levels", "Farthest", "Level Offset"


def octree_level() -> bpy.types.GeometryNodeTree:
    """The group, made on first use: gives each point the weight of its level, and drops those of weight 0.

    "Farthest" is the distance from which on level 1 alone is wanted, for the eye's own focal length. The
    weight becomes the attribute WEIGHT, and a factor on the point's radius, so that points fade in and out.
    """
    if group := existing(NAME):
        return group
    build = Builder(
        NAME,
        {
            LEVEL: "NodeSocketInt", LEVELS: "NodeSocketInt",
            FARTHEST: "NodeSocketFloat", OFFSET: "NodeSocketFloat",
        },
    )  # fmt: skip
    bias = build.add("GeometryNodeInputNamedAttribute", data_type="FLOAT")
    bias.inputs["Name"].default_value = BIAS
    distance = build.math("MAXIMUM", build.distance(), 1e-20)
    wanted = build.math("LOGARITHM", build.math("DIVIDE", build.inputs[FARTHEST], distance), 2.0)
    wanted = build.math("ADD", wanted, bias.outputs["Attribute"])
    wanted = build.math("ADD", wanted, build.inputs[OFFSET])
    wanted = build.math("MINIMUM", wanted, build.math("SUBTRACT", build.inputs[LEVELS], 1.0))
    wanted = build.math("ADD", build.math("MAXIMUM", wanted, 0.0), 1.0)
    left = build.math("SUBTRACT", wanted, build.inputs[LEVEL])
    weight = build.math("MULTIPLY_ADD", left, 1 / FADE, 0.5 / FADE + 0.5)
    weight = build.math("MINIMUM", build.math("MAXIMUM", weight, 0.0), 1.0)

    store = build.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    store.inputs["Name"].default_value = WEIGHT
    build.link(build.inputs["Geometry"], store, "Geometry")
    build.link(weight, store, "Value")
    radius = build.add("GeometryNodeSetPointRadius")
    build.link(store.outputs["Geometry"], radius, "Points")
    faded = build.math("MULTIPLY", build.add("GeometryNodeInputRadius").outputs["Radius"], weight)
    build.link(faded, radius, "Radius")
    return build.finish(build.keep(radius.outputs["Points"], build.compare("GREATER_THAN", weight, 0.0)))
