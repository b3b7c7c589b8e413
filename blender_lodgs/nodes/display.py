"""The node group "LODGS Display": what Blender itself draws of splats where viewports draw them as such."""

from __future__ import annotations

import bpy

from .. import compat
from .building import existing

NAME = "LODGS Display"


def display() -> bpy.types.GeometryNodeTree:
    """The group, made on first use: points of radius 0, so that Blender's own balls hide no splats."""
    if group := existing(NAME):
        return group
    group = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    assert isinstance(group, bpy.types.GeometryNodeTree)
    group.is_modifier = True
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    source, radius, end = (
        group.nodes.new(kind) for kind in ("NodeGroupInput", "GeometryNodeSetPointRadius", "NodeGroupOutput")
    )
    radius.inputs["Radius"].default_value = 0.0
    group.links.new(source.outputs[0], radius.inputs["Points"])
    group.links.new(radius.outputs["Points"], end.inputs[0])
    for x, node in enumerate((source, radius, end)):
        node.location = (x * 180, 0)
    return group


def attach(thing: bpy.types.Object) -> None:
    """Gives an object of splats this modifier, which is on in viewports where splats are drawn as such.

    Where Blender draws them as such by itself, there is nothing to hide.
    """
    if compat.make_native(thing.data):
        return
    modifier = thing.modifiers.new(NAME, "NODES")
    assert isinstance(modifier, bpy.types.NodesModifier)
    modifier.node_group, modifier.show_expanded, modifier.show_render = display(), False, False
    driver = thing.driver_add(f'modifiers["{NAME}"].show_viewport').driver
    driver.type, driver.expression = "SCRIPTED", "splats"
    variable = driver.variables.new()
    variable.name, variable.type = "splats", "CONTEXT_PROP"
    target = variable.targets[0]
    target.context_property, target.data_path = "ACTIVE_SCENE", "lodgs_viewport.splats"
    target.use_fallback_value, target.fallback_value = True, 0.0  # without this extension, points
