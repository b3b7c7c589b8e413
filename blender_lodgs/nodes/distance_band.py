"""The node group "LODGS Distance Band": ``training.lod.rules.band_mask`` in geometry nodes."""

from __future__ import annotations

import bpy

from .building import Builder, existing

NAME = "LODGS Distance Band"
NEAR, FAR = "Near", "Far"


def distance_band() -> bpy.types.GeometryNodeTree:
    """The group, made on first use: keeps the points with near <= distance to the eye < far."""
    if group := existing(NAME):
        return group
    build = Builder(NAME, {NEAR: "NodeSocketFloat", FAR: "NodeSocketFloat"})
    distance = build.distance()
    within = build.add("FunctionNodeBooleanMath", operation="AND")
    for name, operation, socket in zip(
        (NEAR, FAR), ("GREATER_EQUAL", "LESS_THAN"), within.inputs, strict=False
    ):
        build.tree.links.new(build.compare(operation, distance, build.inputs[name]), socket)
    return build.finish(build.keep(build.inputs["Geometry"], within.outputs["Boolean"]))
