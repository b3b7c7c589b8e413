"""Node group that removes hidden and cropped points: ``training.lod.crop`` in geometry nodes.

A crop is an object (``data.cleaning``). Its transform, display size and display type drive the sockets with
its number, so the arguments of the crop can be read back from the sockets.
"""

from __future__ import annotations

import bpy

from ...training.lod.crop import FACE_SQUARED
from ..attributes import HIDDEN
from .building import VERSION, Field, Nodes, ensure_group, is_edited

COUNT = "lodgs_crops"
"""Custom property of these groups: their number of crops."""
NAME = "LODGS Clean Up"
OBJECT, SIZE, SPHERE, OUTSIDE, USE = "crop_{}", "size_{}", "sphere_{}", "outside_{}", "use_{}"
"""Sockets of each crop, numbered from 1: object, radius or half edge length, and three flags (1 or 0).

The flags select a sphere instead of a box, remove the inside instead of the outside, and enable the crop. The
second one is 2 in frames in which the crop removes nothing.
"""
_SOCKETS = {
    OBJECT: "NodeSocketObject", SIZE: "NodeSocketFloat", SPHERE: "NodeSocketFloat",
    OUTSIDE: "NodeSocketFloat", USE: "NodeSocketFloat",
}  # fmt: skip
_VERSION = 3
MATERIAL = "material"


def crops_group(count: int) -> bpy.types.GeometryNodeTree:
    """Return the group for ``count`` crops. It removes hidden points and points that crops exclude."""

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT] = count
        for number in range(1, count + 1):
            for name, kind in _SOCKETS.items():
                nodes.tree.interface.new_socket(name.format(number), in_out="INPUT", socket_type=kind)
        nodes.tree.interface.new_socket(MATERIAL, in_out="INPUT", socket_type="NodeSocketMaterial")
        sockets = nodes.add("NodeGroupInput").outputs
        keep = nodes.add("GeometryNodeSeparateGeometry", domain="POINT")
        nodes.link(sockets["Geometry"], keep, "Geometry")
        nodes.link(_keep_mask(nodes, sockets, count).socket, keep, "Selection")
        # Blender drops the material of a point cloud when points are removed
        material = nodes.add("GeometryNodeSetMaterial")
        nodes.link(keep.outputs["Selection"], material, "Geometry")
        nodes.link(sockets[MATERIAL], material, "Material")
        nodes.link(material.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")

    return ensure_group(NAME if count == 0 else f"{NAME} {count}", _VERSION, build)


def crop_count(tree: bpy.types.NodeTree | None) -> int | None:
    """Return the number of crops of a modifier's group, or None for edited and unrelated groups."""
    return None if tree is None or COUNT not in tree or is_edited(tree) else tree[COUNT]


def is_current(tree: bpy.types.NodeTree | None, count: int) -> bool:
    """Return whether a modifier's group, edited or not, has this version and ``count`` crops."""
    return tree is not None and tree.get(COUNT) == count and tree.get(VERSION) == _VERSION


def _keep_mask(nodes: Nodes, sockets, count: int) -> Field:
    """Return 1 for points to keep: not hidden and not excluded by crops, as in ``training.lod.crop``."""
    keep = 1.0 - nodes.field(nodes.attribute(HIDDEN))
    position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
    inside: Field | None = None
    no_keep_crop: Field | None = None  # 1 if no enabled crop keeps its inside
    for number in range(1, count + 1):
        enabled, side = (nodes.field(sockets[name.format(number)]) for name in (USE, OUTSIDE))
        in_crop = inside_crop(nodes, sockets, number, position) & enabled
        keeps, removes = enabled & (side < 0.5), (side > 0.5) & (side < 1.5)
        inside = in_crop * keeps if inside is None else inside.maximum(in_crop * keeps)
        no_keep_crop = 1.0 - keeps if no_keep_crop is None else no_keep_crop * (1.0 - keeps)
        keep = keep * (1.0 - in_crop * removes)
    return keep if inside is None or no_keep_crop is None else keep * inside.maximum(no_keep_crop)


def inside_crop(nodes: Nodes, sockets, number: int, position: bpy.types.NodeSocket) -> Field:
    """Return 1 for points inside a crop, enabled or not. A crop with a singular transform contains none."""
    info = nodes.add("GeometryNodeObjectInfo", transform_space="RELATIVE")
    nodes.link(sockets[OBJECT.format(number)], info, "Object")
    inverse = nodes.add("FunctionNodeInvertMatrix")
    nodes.link(info.outputs["Transform"], inverse, "Matrix")
    local = nodes.add("FunctionNodeTransformPoint")
    nodes.link(position, local, "Vector")
    nodes.link(inverse.outputs["Matrix"], local, "Transform")
    squared = nodes.vector("MULTIPLY", local.outputs["Vector"], local.outputs["Vector"])
    components = nodes.add("ShaderNodeSeparateXYZ")
    nodes.link(squared, components, "Vector")
    x, y, z = (nodes.field(components.outputs[axis]) for axis in "XYZ")
    size, sphere = (nodes.field(sockets[name.format(number)]) for name in (SIZE, SPHERE))
    distance2 = (sphere > 0.5).where(x + y + z, x.maximum(y).maximum(z))
    return nodes.field(inverse.outputs["Invertible"]) & (distance2 <= size * size * FACE_SQUARED)
