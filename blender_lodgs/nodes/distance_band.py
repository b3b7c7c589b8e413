"""The node group "LODGS Distance Band": ``training.lod.rules.band_mask`` in geometry nodes."""

from __future__ import annotations

import bpy

NAME = "LODGS Distance Band"
NEAR, FAR, EYE, EYE_OBJECT, EYE_POSITION = "Near", "Far", "Measured From", "Eye", "Eye Position"
MATERIAL = "Material"
EYES = ("CAMERA", "OBJECT", "TRAINING")
"""What the input "Measured From" counts; the order of ``SplatScene.eye``."""


def distance_band() -> bpy.types.GeometryNodeTree:
    """The group, made on first use: keeps the points with near <= distance to the eye < far.

    Distances are taken in the local space of the modifier's object, that is in the splats' own world,
    whatever the transforms of the object and its parents. "Measured From" is an index into EYES: the scene's
    active camera, the object "Eye", or the point "Eye Position" in local space.
    Blender drops a point cloud's material when points go; "Material" gives it back.
    """
    group = bpy.data.node_groups.get(NAME)
    if isinstance(group, bpy.types.GeometryNodeTree):
        return group
    group = bpy.data.node_groups.new(NAME, "GeometryNodeTree")
    assert isinstance(group, bpy.types.GeometryNodeTree)
    group.is_modifier = True
    for name, kind in (
        ("Geometry", "NodeSocketGeometry"),
        (NEAR, "NodeSocketFloat"),
        (FAR, "NodeSocketFloat"),
        (EYE, "NodeSocketInt"),
        (EYE_OBJECT, "NodeSocketObject"),
        (EYE_POSITION, "NodeSocketVector"),
        (MATERIAL, "NodeSocketMaterial"),
    ):
        group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    column = 0

    def add(kind: str, **settings) -> bpy.types.Node:
        nonlocal column
        node = group.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        node.location = (column * 180, 0)
        column += 1
        return node

    def link(source: bpy.types.NodeSocket, node: bpy.types.Node, *names: str) -> None:
        """Links to the node's visible input of that name; several have the same in some node types."""
        for name in names:
            group.links.new(source, next(s for s in node.inputs if s.name == name and s.enabled))

    inputs = add("NodeGroupInput")
    camera = add("GeometryNodeInputActiveCamera")
    seen_from = []
    for thing in (camera.outputs["Active Camera"], inputs.outputs[EYE_OBJECT]):
        info = add("GeometryNodeObjectInfo", transform_space="RELATIVE")
        link(thing, info, "Object")
        seen_from.append(info.outputs["Location"])

    eye = add("GeometryNodeIndexSwitch", data_type="VECTOR")
    eye.index_switch_items.new()
    link(inputs.outputs[EYE], eye, "Index")
    for index, source in enumerate((*seen_from, inputs.outputs[EYE_POSITION])):
        link(source, eye, str(index))

    position = add("GeometryNodeInputPosition")
    distance = add("ShaderNodeVectorMath", operation="DISTANCE")
    group.links.new(position.outputs["Position"], distance.inputs[0])
    group.links.new(eye.outputs["Output"], distance.inputs[1])

    tests = []
    for name, operation in ((NEAR, "GREATER_EQUAL"), (FAR, "LESS_THAN")):
        test = add("FunctionNodeCompare", data_type="FLOAT", operation=operation)
        link(distance.outputs["Value"], test, "A")
        link(inputs.outputs[name], test, "B")
        tests.append(test.outputs["Result"])
    within = add("FunctionNodeBooleanMath", operation="AND")
    for result, socket in zip(tests, within.inputs, strict=False):
        group.links.new(result, socket)

    keep = add("GeometryNodeSeparateGeometry", domain="POINT")
    link(inputs.outputs["Geometry"], keep, "Geometry")
    link(within.outputs["Boolean"], keep, "Selection")
    material = add("GeometryNodeSetMaterial")
    link(keep.outputs["Selection"], material, "Geometry")
    link(inputs.outputs[MATERIAL], material, "Material")
    output = add("NodeGroupOutput")
    link(material.outputs["Geometry"], output, "Geometry")
    return group
