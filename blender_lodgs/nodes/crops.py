"""``training.lod.crop`` in geometry nodes: what crops and hiding leave of a level's points.

A crop is an object (``data.cleaning``): its place, how large it is drawn and as what drive the sockets that
bear its number, so that reading these gives the test's arguments back.
"""

from __future__ import annotations

import bpy

from ...training.lod.crop import FACE
from ..attributes import HIDDEN
from .building import VERSION, Field, Nodes, edited, group

COUNT = "lodgs_crops"
"""Custom property of these groups: how many crops they have."""
NAME = "LODGS Clean Up"
OBJECT, SIZE, SPHERE, OUTSIDE, USE = "crop_{}", "size_{}", "sphere_{}", "outside_{}", "use_{}"
"""Sockets of each crop, counted from 1: its object, the half of its box's edges or its radius, and what is 1
for a sphere, for one that cuts out, and for one in use."""
_SOCKETS = {
    OBJECT: "NodeSocketObject", SIZE: "NodeSocketFloat", SPHERE: "NodeSocketFloat",
    OUTSIDE: "NodeSocketFloat", USE: "NodeSocketFloat",
}  # fmt: skip
_VERSION = 2
MATERIAL = "material"


def crops_group(count: int) -> bpy.types.GeometryNodeTree:
    """The group for so many crops, made where this file has none of this version. It drops the points that
    are hidden, or that crops do not keep."""

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT] = count
        for number in range(1, count + 1):
            for name, kind in _SOCKETS.items():
                nodes.tree.interface.new_socket(name.format(number), in_out="INPUT", socket_type=kind)
        nodes.tree.interface.new_socket(MATERIAL, in_out="INPUT", socket_type="NodeSocketMaterial")
        sockets = nodes.add("NodeGroupInput").outputs
        keep = nodes.add("GeometryNodeSeparateGeometry", domain="POINT")
        nodes.link(sockets["Geometry"], keep, "Geometry")
        nodes.link(_kept(nodes, sockets, count).socket, keep, "Selection")
        # Blender drops a point cloud's material when points go
        material = nodes.add("GeometryNodeSetMaterial")
        nodes.link(keep.outputs["Selection"], material, "Geometry")
        nodes.link(sockets[MATERIAL], material, "Material")
        nodes.link(material.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")

    return group(NAME if count == 0 else f"{NAME} {count}", _VERSION, build)


def crops_of_group(tree: bpy.types.NodeTree | None) -> int | None:
    """How many crops a modifier's group has; None for other groups, and for changed ones."""
    return None if tree is None or COUNT not in tree or edited(tree) else tree[COUNT]


def serves(tree: bpy.types.NodeTree | None, count: int) -> bool:
    """Whether a modifier's group is for so many crops and of this version, changed by somebody or not."""
    return tree is not None and tree.get(COUNT) == count and tree.get(VERSION) == _VERSION


def _kept(nodes: Nodes, sockets, count: int) -> Field:
    """1 for points that are not hidden and that the crops keep, as ``crop.kept`` has it."""
    kept = 1.0 - nodes.field(nodes.named(HIDDEN))
    position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
    inside, none_inside = None, None
    for number in range(1, count + 1):
        used, out = (nodes.field(sockets[name.format(number)]) for name in (USE, OUTSIDE))
        held = holds(nodes, sockets, number, position) & used
        keeps = used * (1.0 - out)
        inside = held * keeps if inside is None else inside.maximum(held * keeps)
        none_inside = 1.0 - keeps if none_inside is None else none_inside * (1.0 - keeps)
        kept = kept * (1.0 - held * out)
    return kept if inside is None or none_inside is None else kept * inside.maximum(none_inside)


def holds(nodes: Nodes, sockets, number: int, position: bpy.types.NodeSocket) -> Field:
    """1 for points that lie in the crop of a number, used or not. One that is flat holds none."""
    info = nodes.add("GeometryNodeObjectInfo", transform_space="RELATIVE")
    nodes.link(sockets[OBJECT.format(number)], info, "Object")
    inverse = nodes.add("FunctionNodeInvertMatrix")
    nodes.link(info.outputs["Transform"], inverse, "Matrix")
    own = nodes.add("FunctionNodeTransformPoint")
    nodes.link(position, own, "Vector")
    nodes.link(inverse.outputs["Matrix"], own, "Transform")
    squared = nodes.vector("MULTIPLY", own.outputs["Vector"], own.outputs["Vector"])
    apart = nodes.add("ShaderNodeSeparateXYZ")
    nodes.link(squared, apart, "Vector")
    x, y, z = (nodes.field(apart.outputs[axis]) for axis in "XYZ")
    size, sphere = (nodes.field(sockets[name.format(number)]) for name in (SIZE, SPHERE))
    away = (sphere > 0.5).where(x + y + z, x.maximum(y).maximum(z))
    return nodes.field(inverse.outputs["Invertible"]) & (away <= size * size * FACE)
