"""The rules of ``training.lod.rules`` in geometry nodes, one a module of the same name, found by itself.

A module has ``VERSION``, to be raised whenever its nodes change; ``FADES``, whether weights lie between 0
and 1; and ``weight(inputs)``, the formula. What all groups have in common is here: their sockets bear the
names of the rule's facts and controls, so that properties drive them by bare names and reading them gives the
rule's arguments back, with an object for each of its tables (``data.tables``); and distances are taken in
the local space of the modifier's object, that is in the splats' own world, whatever the transforms of its
parents.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

import bpy

from ....training.lod.rule import Rule, fact_names, rules
from ...attributes import COLUMN, OPACITY_LOGIT, WEIGHT
from ..building import VERSION, Field, Nodes, edited, group

EYE, FREEZE, EYE_OBJECT, EYE_POSITION = "eye", "freeze", "eye_object", "eye_position"
FOCAL, HELD_FOCAL, MATERIAL = "focal_px", "held_focal", "material"
EYES = ("CAMERA", "OBJECT", "TRAINING", "VIEW")
"""What the socket "eye" counts, as ``SplatScene.eye``; the last two, and a frozen eye, are "eye_position"."""
HELD = EYES.index("VIEW")
RULE = "lodgs_rule"
"""Custom property of these groups: the rule's name."""

_SHARED = {
    EYE: "NodeSocketInt", FREEZE: "NodeSocketBool", EYE_OBJECT: "NodeSocketObject",
    EYE_POSITION: "NodeSocketVector", FOCAL: "NodeSocketFloat", HELD_FOCAL: "NodeSocketFloat",
    MATERIAL: "NodeSocketMaterial",
}  # fmt: skip
_SHARED_VERSION = 2


class Inputs:
    """What a formula is made of.

    Attributes:
        eye: its place.
        distance: of each point from the eye.
        focal_px: the eye's focal length in pixels.
        points: the geometry, for what needs all points at once.
        nodes: to add others.
    """

    def __init__(self, nodes: Nodes) -> None:
        self.nodes = nodes
        self._sockets = nodes.add("NodeGroupInput").outputs
        self.points = self._sockets["Geometry"]
        held = self._held()
        self.focal_px = held.where(self[HELD_FOCAL], self[FOCAL])
        self.eye = self._eye()
        self.distance = nodes.field(nodes.vector("DISTANCE", self.position(), self.eye))

    def __getitem__(self, name: str) -> Field:
        """A fact or a control."""
        return self.nodes.field(self._sockets[name])

    def column(self, name: str) -> Field:
        """A column of the splats; 0 where they have none of that name."""
        return self.nodes.field(self.nodes.named(name))

    def position(self) -> bpy.types.NodeSocket:
        """Where each point is."""
        return self.nodes.add("GeometryNodeInputPosition").outputs["Position"]

    def table(self, name: str) -> bpy.types.NodeSocket:
        """A table, a point a row; none where the scene lacks it. Wherever its object is does not count."""
        info = self.nodes.add("GeometryNodeObjectInfo", transform_space="ORIGINAL")
        self.nodes.link(self._sockets[table_socket(name)], info, "Object")
        return info.outputs["Geometry"]

    def table_column(self, name: str) -> Field:
        """A column of a table."""
        return self.nodes.field(self.nodes.named(COLUMN.format(name)))

    def table_place(self) -> bpy.types.NodeSocket:
        """A table's columns ``x``, ``y``, ``z`` as places."""
        node = self.nodes.add("ShaderNodeCombineXYZ")
        for name in "xyz":
            self.nodes.link(self.table_column(name).socket, node, name.upper())
        return node.outputs["Vector"]

    def opacity(self) -> Field:
        """Each splat's own opacity."""
        return 1.0 / ((self.column(OPACITY_LOGIT) * -1.0).exp() + 1.0)

    def _held(self) -> Field:
        """Whether the eye stays where it is, or is the viewport's."""
        return self[FREEZE].maximum(self[EYE] > HELD - 0.5)

    def _eye(self) -> bpy.types.NodeSocket:
        nodes = self.nodes
        seen_from = []
        for obj in (
            nodes.add("GeometryNodeInputActiveCamera").outputs["Active Camera"], self._sockets[EYE_OBJECT],
        ):  # fmt: skip
            info = nodes.add("GeometryNodeObjectInfo", transform_space="RELATIVE")
            nodes.link(obj, info, "Object")
            seen_from.append(info.outputs["Location"])
        which = self[FREEZE].where(2.0, self[EYE].minimum(2.0))
        return nodes.which(which, *seen_from, self._sockets[EYE_POSITION], kind="VECTOR")


@cache
def _modules() -> dict[str, ModuleType]:
    names = [found.name for found in iter_modules(__path__)]
    return {name: import_module(f"{__name__}.{name}") for name in names}


def rule_group(rule: Rule) -> bpy.types.GeometryNodeTree:
    """The group of a rule, made where this file has none of this version.

    It gives each point its weight and drops those of weight 0. Where weights fade, they become the attribute
    WEIGHT, and a factor on the points' radius, so that points fade as well.
    """
    module = _modules()[rule.name]

    def build(nodes: Nodes) -> None:
        nodes.tree[RULE] = rule.name
        _sockets(nodes.tree, rule)
        inputs = Inputs(nodes)
        weight, points = module.weight(inputs), inputs.points
        if module.FADES:
            points = _faded(nodes, points, weight)
        keep = nodes.add("GeometryNodeSeparateGeometry", domain="POINT")
        nodes.link(points, keep, "Geometry")
        nodes.link((weight > 0.0).socket, keep, "Selection")
        # Blender drops a point cloud's material when points go
        material = nodes.add("GeometryNodeSetMaterial")
        nodes.link(keep.outputs["Selection"], material, "Geometry")
        nodes.link(inputs[MATERIAL].socket, material, "Material")
        nodes.link(material.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")

    return group(f"LODGS {rule.name.title()}", _version(rule), build)


def serves(tree: bpy.types.NodeTree | None, rule: Rule) -> bool:
    """Whether a modifier's group is of a rule and of this version, changed by somebody or not."""
    return tree is not None and tree.get(RULE) == rule.name and tree.get(VERSION) == _version(rule)


def _version(rule: Rule) -> int:
    return 100 * _SHARED_VERSION + _modules()[rule.name].VERSION


def rule_of_group(tree: bpy.types.NodeTree | None) -> Rule | None:
    """The rule that a modifier's group states and follows; None for other groups, and changed ones."""
    return None if tree is None or RULE not in tree or edited(tree) else rules().get(tree[RULE])


def table_socket(name: str) -> str:
    """The socket of a rule's table: facts and controls may have the table's name."""
    return f"{name}_table"


def _sockets(tree: bpy.types.GeometryNodeTree, rule: Rule) -> None:
    for name in fact_names(rule):
        tree.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
    for control in rule.controls:
        kind = "NodeSocketInt" if control.whole else "NodeSocketFloat"
        socket = tree.interface.new_socket(control.name, in_out="INPUT", socket_type=kind)
        socket.description = control.about
        number = int if control.whole else float
        socket.min_value, socket.max_value = number(control.low), number(control.high)
        socket.default_value = number(control.default)
    for name in rule.tables:
        tree.interface.new_socket(table_socket(name), in_out="INPUT", socket_type="NodeSocketObject")
    for name, kind in _SHARED.items():
        tree.interface.new_socket(name, in_out="INPUT", socket_type=kind)


def _faded(nodes: Nodes, points: bpy.types.NodeSocket, weight: Field) -> bpy.types.NodeSocket:
    store = nodes.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    store.inputs["Name"].default_value = WEIGHT
    nodes.link(points, store, "Geometry")
    nodes.link(weight.socket, store, "Value")
    radius = nodes.add("GeometryNodeSetPointRadius")
    nodes.link(store.outputs["Geometry"], radius, "Points")
    faded = nodes.field(nodes.add("GeometryNodeInputRadius").outputs["Radius"]) * weight
    nodes.link(faded.socket, radius, "Radius")
    return radius.outputs["Points"]
