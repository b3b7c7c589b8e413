"""What the groups have in common: how they are built, and how far a point is from the eye."""

from __future__ import annotations

import bpy

EYE, EYE_OBJECT, EYE_POSITION = "Measured From", "Eye", "Eye Position"
MATERIAL = "Material"
EYES = ("CAMERA", "OBJECT", "TRAINING")
"""What the input "Measured From" counts: the first of ``SplatScene.eye``. "TRAINING" is any fixed place."""


class Builder:
    """A new modifier group, built node by node from left to right.

    Its inputs are the geometry, those given, and whom distances are measured from. Distances are taken in the
    local space of the modifier's object, that is in the splats' own world, whatever the transforms of the
    object and its parents. "Measured From" is an index into EYES: the scene's active camera, the object
    "Eye", or the point "Eye Position" in local space. Blender drops a point cloud's material when points go;
    "Material" gives it back.

    Args:
        name: of the group.
        sockets: names and types of further inputs.
    """

    def __init__(self, name: str, sockets: dict[str, str]) -> None:
        group = bpy.data.node_groups.new(name, "GeometryNodeTree")
        assert isinstance(group, bpy.types.GeometryNodeTree)
        group.is_modifier = True
        shared = {
            EYE: "NodeSocketInt",
            EYE_OBJECT: "NodeSocketObject",
            EYE_POSITION: "NodeSocketVector",
            MATERIAL: "NodeSocketMaterial",
        }
        for socket, kind in ({"Geometry": "NodeSocketGeometry"} | sockets | shared).items():
            group.interface.new_socket(socket, in_out="INPUT", socket_type=kind)
        group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
        self.group = group
        self.inputs = self.add("NodeGroupInput").outputs

    def add(self, kind: str, **settings) -> bpy.types.Node:
        """A node to the right of all others."""
        node = self.group.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        node.location = (len(self.group.nodes) * 180, 0)
        return node

    def link(self, source: bpy.types.NodeSocket, node: bpy.types.Node, name: str) -> None:
        """Links to the node's visible input of that name; several have the same in some node types."""
        self.group.links.new(source, next(s for s in node.inputs if s.name == name and s.enabled))

    def math(self, operation: str, *values: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """The result of a Math node on sockets and numbers."""
        node = self.add("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.group.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs["Value"]

    def distance(self) -> bpy.types.NodeSocket:
        """How far each point is from the eye."""
        camera = self.add("GeometryNodeInputActiveCamera")
        seen_from = []
        for thing in (camera.outputs["Active Camera"], self.inputs[EYE_OBJECT]):
            info = self.add("GeometryNodeObjectInfo", transform_space="RELATIVE")
            self.link(thing, info, "Object")
            seen_from.append(info.outputs["Location"])
        eye = self.add("GeometryNodeIndexSwitch", data_type="VECTOR")
        eye.index_switch_items.new()
        self.link(self.inputs[EYE], eye, "Index")
        for index, source in enumerate((*seen_from, self.inputs[EYE_POSITION])):
            self.link(source, eye, str(index))
        position = self.add("GeometryNodeInputPosition")
        distance = self.add("ShaderNodeVectorMath", operation="DISTANCE")
        self.group.links.new(position.outputs["Position"], distance.inputs[0])
        self.group.links.new(eye.outputs["Output"], distance.inputs[1])
        return distance.outputs["Value"]

    def compare(
        self, operation: str, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket | float
    ) -> bpy.types.NodeSocket:
        """Where a number compares so with another."""
        node = self.add("FunctionNodeCompare", data_type="FLOAT", operation=operation)
        self.link(a, node, "A")
        if isinstance(b, bpy.types.NodeSocket):
            self.link(b, node, "B")
        else:
            next(s for s in node.inputs if s.name == "B" and s.enabled).default_value = b
        return node.outputs["Result"]

    def keep(self, geometry: bpy.types.NodeSocket, where: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """The points where a field is true."""
        node = self.add("GeometryNodeSeparateGeometry", domain="POINT")
        self.link(geometry, node, "Geometry")
        self.link(where, node, "Selection")
        return node.outputs["Selection"]

    def finish(self, geometry: bpy.types.NodeSocket) -> bpy.types.GeometryNodeTree:
        """Give the geometry its material back, and out."""
        material = self.add("GeometryNodeSetMaterial")
        self.link(geometry, material, "Geometry")
        self.link(self.inputs[MATERIAL], material, "Material")
        self.link(material.outputs["Geometry"], self.add("NodeGroupOutput"), "Geometry")
        return self.group


def existing(name: str) -> bpy.types.GeometryNodeTree | None:
    """The group of that name that this file has already."""
    group = bpy.data.node_groups.get(name)
    return group if isinstance(group, bpy.types.GeometryNodeTree) else None
