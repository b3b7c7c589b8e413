"""The node group "LODGS Display": what Blender itself draws of splats where viewports draw them as such."""

from __future__ import annotations

import bpy

from .. import compat
from .building import existing, plain_group, switched

NAME = "LODGS Display"


def display() -> bpy.types.GeometryNodeTree:
    """The group, made on first use: points of radius 0, so that Blender's own balls hide no splats."""
    if group := existing(NAME):
        return group
    build = plain_group(NAME)
    source, radius = build.add("NodeGroupInput"), build.add("GeometryNodeSetPointRadius")
    radius.inputs["Radius"].default_value = 0.0
    build.link(source.outputs[0], radius, "Points")
    build.link(radius.outputs["Points"], build.add("NodeGroupOutput"), "Geometry")
    return build.tree  # type: ignore[return-value]


def attach(thing: bpy.types.Object) -> None:
    """Gives an object of splats this modifier, which is on in viewports where splats are drawn as such.

    Where Blender draws them as such by itself, there is nothing to hide.
    """
    if not compat.make_native(thing.data):
        switched(thing, display(), "show_viewport", "lodgs_viewport.splats")
