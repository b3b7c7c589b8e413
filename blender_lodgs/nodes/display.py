"""The node group "LODGS Display": what Blender itself draws of splats where viewports draw them as such."""

from __future__ import annotations

import bpy

from .. import compat
from .building import Nodes, add_switched_modifier, ensure_group

NAME = "LODGS Display"


def display() -> bpy.types.GeometryNodeTree:
    """The group: points of radius 0, so that Blender's own balls hide no splats."""

    def build(nodes: Nodes) -> None:
        source, radius = nodes.add("NodeGroupInput"), nodes.add("GeometryNodeSetPointRadius")
        radius.inputs["Radius"].default_value = 0.0
        nodes.link(source.outputs[0], radius, "Points")
        nodes.link(radius.outputs["Points"], nodes.add("NodeGroupOutput"), "Geometry")

    return ensure_group(NAME, 1, build)


def attach(obj: bpy.types.Object) -> None:
    """Gives an object of splats this modifier, which is on in viewports where splats are drawn as such.

    Where Blender draws them as such by itself, there is nothing to hide.
    """
    if not compat.make_native(obj.data):
        add_switched_modifier(obj, display(), show_viewport="lodgs_viewport.splats")
