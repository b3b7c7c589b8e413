"""Node groups of the level-of-detail rules: ``training.lod.rules`` in geometry nodes.

Each rule has a module of the same name in this package, which is imported automatically. Rules without one,
of third-party packages, count as unknown in Blender: levels are shown one at a time. A module defines:

- ``VERSION``: integer that must be raised whenever the nodes change.
- ``FADES``: whether weights between 0 and 1 occur.
- ``weight(inputs)``: formula of the weight.

This file builds the parts that all groups share. Sockets have the names of the rule's facts and controls:
drivers refer to properties of these names, and the arguments of the rule can be read back from the sockets.
Each table of a rule has an object socket (``data.tables``). Distances are measured in the local space of the
modifier's object, so transforms of its parents have no effect.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

import bpy

from ....training.lod.rule import Rule, fact_names, restrict_rules, rules
from ...attributes import COLUMN, OPACITY_LOGIT, WEIGHT
from ..building import VERSION, Field, Nodes, ensure_group, is_edited
from ..camera_choices import CHOICES

CAMERA_SOURCE = "camera_choice"
"""Socket and property with the index of the camera choice in ``camera_choices.CHOICES``."""
FREEZE = "freeze"
CAMERA_POSITION = "camera_position"
FOCAL = "focal_px"
STORED_FOCAL = "stored_focal"
MATERIAL = "material"
RULE = "lodgs_rule"
"""Custom property of these groups: the name of the rule."""

_SHARED = {
    CAMERA_SOURCE: "NodeSocketInt",
    FREEZE: "NodeSocketBool",
    **{choice.object: "NodeSocketObject" for choice in CHOICES if choice.object},
    CAMERA_POSITION: "NodeSocketVector",
    FOCAL: "NodeSocketFloat",
    STORED_FOCAL: "NodeSocketFloat",
    MATERIAL: "NodeSocketMaterial",
}
_SHARED_VERSION = 31 + len(CHOICES)  # groups are rebuilt for a new choice

restrict_rules([module.name for module in iter_modules(__path__)])


class RuleInputs:
    """Inputs of a rule's formula.

    Attributes:
        camera: position of the camera.
        distance: distance of each point from the camera.
        focal_px: focal length of the camera in pixels.
        points: the geometry, for formulas that need all points at once.
        nodes: builder of the group.
    """

    def __init__(self, nodes: Nodes) -> None:
        self.nodes = nodes
        self._sockets = nodes.add("NodeGroupInput").outputs
        self.points = self._sockets["Geometry"]
        self.focal_px = self._is_stored().where(self[STORED_FOCAL], self[FOCAL])
        self.camera = self._camera()
        self.distance = nodes.field(nodes.vector("DISTANCE", self.position(), self.camera))

    def __getitem__(self, name: str) -> Field:
        """Return a fact or a control of the rule."""
        return self.nodes.field(self._sockets[name])

    def column(self, name: str) -> Field:
        """Return a column of the splats, or 0 if it is missing."""
        return self.nodes.field(self.nodes.attribute(name))

    def position(self) -> bpy.types.NodeSocket:
        """Return the position of each point."""
        return self.nodes.add("GeometryNodeInputPosition").outputs["Position"]

    def table(self, name: str) -> bpy.types.NodeSocket:
        """Return a table as geometry with one point per row. A missing table is empty.

        The transform of the table's object has no effect.
        """
        info = self.nodes.add("GeometryNodeObjectInfo", transform_space="ORIGINAL")
        self.nodes.link(self._sockets[table_socket(name)], info, "Object")
        return info.outputs["Geometry"]

    def table_column(self, name: str) -> Field:
        """Return a column of a table."""
        return self.nodes.field(self.nodes.attribute(COLUMN.format(name)))

    def table_position(self) -> bpy.types.NodeSocket:
        """Return the columns ``x``, ``y``, ``z`` of a table as positions."""
        node = self.nodes.add("ShaderNodeCombineXYZ")
        for name in "xyz":
            self.nodes.link(self.table_column(name).socket, node, name.upper())
        return node.outputs["Vector"]

    def opacity(self) -> Field:
        """Return the opacity of each splat before weighting."""
        return 1.0 / ((self.column(OPACITY_LOGIT) * -1.0).exp() + 1.0)

    def _is_stored(self) -> Field:
        """Return 1 if the camera is frozen or a viewport's: its focal length is then a stored value."""
        is_stored = self[FREEZE]
        for number, choice in enumerate(CHOICES):
            if choice.viewport:
                source = self._source()
                is_stored = is_stored.maximum((source > number - 0.5) & (source < number + 0.5))
        return is_stored

    def _source(self) -> Field:
        """Return the index of the camera choice."""
        return self[CAMERA_SOURCE].minimum(len(CHOICES) - 1.0)

    def _camera(self) -> bpy.types.NodeSocket:
        """Select the camera position by CAMERA_SOURCE and FREEZE."""
        nodes = self.nodes
        active_camera = nodes.add("GeometryNodeInputActiveCamera").outputs["Active Camera"]
        stored = self._sockets[CAMERA_POSITION]
        positions = []
        for choice in CHOICES:
            if choice.position:
                positions.append(stored)
                continue
            info = nodes.add("GeometryNodeObjectInfo", transform_space="RELATIVE")
            nodes.link(self._sockets[choice.object] if choice.object else active_camera, info, "Object")
            positions.append(info.outputs["Location"])
        index = self[FREEZE].where(float(len(CHOICES)), self._source())
        return nodes.index_switch(index, *positions, stored, kind="VECTOR")


@cache
def _modules() -> dict[str, ModuleType]:
    names = [module.name for module in iter_modules(__path__)]
    return {name: import_module(f"{__name__}.{name}") for name in names}


def rule_group(rule: Rule) -> bpy.types.GeometryNodeTree:
    """Return the node group of a rule.

    The group computes the weight of each point and removes points of weight 0. If weights fade, they are also
    stored as the attribute WEIGHT and multiplied into the point radius, so that points fade too.
    """
    module = _modules()[rule.name]

    def build(nodes: Nodes) -> None:
        nodes.tree[RULE] = rule.name
        _add_sockets(nodes.tree, rule)
        inputs = RuleInputs(nodes)
        weight = module.weight(inputs)
        points = inputs.points
        if module.FADES:
            points = _store_weight(nodes, points, weight)
        keep = nodes.add("GeometryNodeSeparateGeometry", domain="POINT")
        nodes.link(points, keep, "Geometry")
        nodes.link((weight > 0.0).socket, keep, "Selection")
        # Blender drops the material of a point cloud when points are removed
        material = nodes.add("GeometryNodeSetMaterial")
        nodes.link(keep.outputs["Selection"], material, "Geometry")
        nodes.link(inputs[MATERIAL].socket, material, "Material")
        nodes.link(material.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")

    return ensure_group(f"LODGS {rule.name.title()}", _version(rule), build)


def is_current(tree: bpy.types.NodeTree | None, rule: Rule) -> bool:
    """Return whether a modifier's group, edited or not, belongs to a rule and has the current version."""
    return tree is not None and tree.get(RULE) == rule.name and tree.get(VERSION) == _version(rule)


def _version(rule: Rule) -> int:
    return 100 * _SHARED_VERSION + _modules()[rule.name].VERSION


def rule_of_group(tree: bpy.types.NodeTree | None) -> Rule | None:
    """Return the rule of a modifier's group, or None for edited and unrelated groups."""
    return None if tree is None or RULE not in tree or is_edited(tree) else rules().get(tree[RULE])


def table_socket(name: str) -> str:
    """Return the socket name of a table, which differs from fact and control names."""
    return f"{name}_table"


def _add_sockets(tree: bpy.types.GeometryNodeTree, rule: Rule) -> None:
    for name in fact_names(rule):
        tree.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
    for control in rule.controls:
        kind = "NodeSocketInt" if control.integer else "NodeSocketFloat"
        socket = tree.interface.new_socket(control.name, in_out="INPUT", socket_type=kind)
        socket.description = control.about
        number = int if control.integer else float
        socket.min_value, socket.max_value = number(control.low), number(control.high)
        socket.default_value = number(control.default)
    for name in rule.tables:
        tree.interface.new_socket(table_socket(name), in_out="INPUT", socket_type="NodeSocketObject")
    for name, kind in _SHARED.items():
        tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)


def _store_weight(nodes: Nodes, points: bpy.types.NodeSocket, weight: Field) -> bpy.types.NodeSocket:
    """Store the weight as an attribute and multiply the point radius by it."""
    store = nodes.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    store.inputs["Name"].default_value = WEIGHT
    nodes.link(points, store, "Geometry")
    nodes.link(weight.socket, store, "Value")
    radius = nodes.add("GeometryNodeSetPointRadius")
    nodes.link(store.outputs["Geometry"], radius, "Points")
    faded = nodes.field(nodes.add("GeometryNodeInputRadius").outputs["Radius"]) * weight
    nodes.link(faded.socket, radius, "Radius")
    return radius.outputs["Points"]
