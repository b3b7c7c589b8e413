"""What the groups have in common: how they are built, and how far a point is from the eye."""

from __future__ import annotations

import bpy

EYE, EYE_OBJECT, EYE_POSITION = "Measured From", "Eye", "Eye Position"
MATERIAL = "Material"
EYES = ("CAMERA", "OBJECT", "TRAINING")
"""What the input "Measured From" counts: the first of ``SplatScene.eye``. "TRAINING" is any fixed place."""


class Nodes:
    """Nodes of a tree, each to the right of all others.

    Attributes:
        tree: a group's or a material's.
    """

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def add(self, kind: str, **settings) -> bpy.types.Node:
        """A node to the right of all others."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        node.location = (len(self.tree.nodes) * 180, 0)
        return node

    def link(self, source: bpy.types.NodeSocket, node: bpy.types.Node, name: str) -> None:
        """Links to the node's visible input of that name; several have the same in some node types."""
        self.tree.links.new(source, next(s for s in node.inputs if s.name == name and s.enabled))

    def math(self, operation: str, *values: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """The result of a Math node on sockets and numbers."""
        node = self.add("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs["Value"]


class Builder(Nodes):
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
        super().__init__(_group(name))
        shared = {
            EYE: "NodeSocketInt",
            EYE_OBJECT: "NodeSocketObject",
            EYE_POSITION: "NodeSocketVector",
            MATERIAL: "NodeSocketMaterial",
        }
        for socket, kind in (sockets | shared).items():
            self.tree.interface.new_socket(socket, in_out="INPUT", socket_type=kind)
        self.inputs = self.add("NodeGroupInput").outputs

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
        self.tree.links.new(position.outputs["Position"], distance.inputs[0])
        self.tree.links.new(eye.outputs["Output"], distance.inputs[1])
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
        return self.tree  # type: ignore[return-value]


def existing(name: str) -> bpy.types.GeometryNodeTree | None:
    """The group of that name that this file has already."""
    group = bpy.data.node_groups.get(name)
    return group if isinstance(group, bpy.types.GeometryNodeTree) else None


def plain_group(name: str) -> Nodes:
    """A new modifier group that has geometry in and out, and nothing else yet."""
    return Nodes(_group(name))


def _group(name: str) -> bpy.types.GeometryNodeTree:
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    assert isinstance(group, bpy.types.GeometryNodeTree)
    group.is_modifier = True
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    return group


def switched(thing: bpy.types.Object, group: bpy.types.GeometryNodeTree, where: str, by: str) -> None:
    """A new modifier with a group, which is on only in one place and where the active scene says so.

    Args:
        where: "show_viewport" or "show_render"; it is off in the other.
        by: data path of a property of scenes. Without this extension it is off.
    """
    modifier = thing.modifiers.new(group.name, "NODES")
    assert isinstance(modifier, bpy.types.NodesModifier)
    modifier.node_group, modifier.show_expanded = group, False
    modifier.show_viewport = modifier.show_render = False
    driver = thing.driver_add(f'modifiers["{modifier.name}"].{where}').driver
    driver.type, driver.expression = "SCRIPTED", "on"
    variable = driver.variables.new()
    variable.name, variable.type = "on", "CONTEXT_PROP"
    target = variable.targets[0]
    target.context_property, target.data_path = "ACTIVE_SCENE", by
    target.use_fallback_value, target.fallback_value = True, 0.0
