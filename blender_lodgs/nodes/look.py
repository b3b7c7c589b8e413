"""``training.lod.look`` in geometry nodes, and ``paint``: the colours and opacities in which Blender itself
draws splats.

What LODGS draws gets its look from the same settings without this group (``data.looks``). Splats keep their
harmonics and opacities; the colour of points and ellipsoids is made of them, and the opacity's factor stands
beside them.
"""

from __future__ import annotations

import bpy

from ...training.lod.paint import COLUMNS as PAINT
from ...training.splats.gaussians import SH_C0
from ..attributes import BASE, COLOR, LOOK_OPACITY
from .building import VERSION, Field, Nodes, edited, group
from .crops import OBJECT, SIZE, SPHERE, USE, holds

COUNT = "lodgs_looks"
"""Custom property of these groups: how many regions with looks of their own they have."""
NAME = "LODGS Look"
ROWS, OPACITY, BEYOND = ("red_{}", "green_{}", "blue_{}"), "opacity_{}", "beyond_{}"
"""Sockets of each look: the rows of its matrix, and its opacity. 0 is the look everywhere; regions follow,
with the sockets of crops, and what is 1 where a look counts outside of one."""
_VERSION = 2


def look_group(count: int) -> bpy.types.GeometryNodeTree:
    """The group for so many regions, made where this file has none of this version."""

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT] = count
        for number in range(count + 1):
            _add_sockets(nodes.tree, number)
        sockets = nodes.add("NodeGroupInput").outputs
        position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
        color, opacity = _own_color(nodes), nodes.field(sockets[OPACITY.format(0)])
        color = _mapped(nodes, sockets, 0, color)
        for number in range(1, count + 1):
            used, beyond = (nodes.field(sockets[name.format(number)]) for name in (USE, BEYOND))
            held = holds(nodes, sockets, number, position)
            held = used & (beyond > 0.5).where(1.0 - held, held)
            there = _mapped(nodes, sockets, number, color)
            color = [held.where(new, old) for new, old in zip(there, color, strict=True)]
            opacity = opacity * held.where(nodes.field(sockets[OPACITY.format(number)]), 1.0)
        shown = nodes.add("FunctionNodeCombineColor")
        for socket, channel in zip(shown.inputs, color, strict=False):
            nodes.tree.links.new(_linear(channel.clip(0.0, 1.0)).socket, socket)
        points = sockets["Geometry"]
        for name, kind, value in (
            (COLOR, "FLOAT_COLOR", shown.outputs["Color"]),
            (LOOK_OPACITY, "FLOAT", opacity.socket),
        ):
            store = nodes.add("GeometryNodeStoreNamedAttribute", data_type=kind, domain="POINT")
            store.inputs["Name"].default_value = name
            nodes.link(points, store, "Geometry")
            nodes.link(value, store, "Value")
            points = store.outputs["Geometry"]
        nodes.link(points, nodes.add("NodeGroupOutput"), "Geometry")

    return group(NAME if count == 0 else f"{NAME} {count}", _VERSION, build)


def is_look(tree: bpy.types.NodeTree | None) -> bool:
    """Whether a modifier's group is such a one, and what it was made."""
    return tree is not None and COUNT in tree and not edited(tree)


def serves(tree: bpy.types.NodeTree | None, count: int) -> bool:
    """Whether a modifier's group is for so many regions and of this version, changed by somebody or not."""
    return tree is not None and tree.get(COUNT) == count and tree.get(VERSION) == _VERSION


def _add_sockets(tree: bpy.types.GeometryNodeTree, number: int) -> None:
    kinds = dict.fromkeys(ROWS, "NodeSocketVector") | {OPACITY: "NodeSocketFloat"}
    if number:
        kinds |= {OBJECT: "NodeSocketObject"} | dict.fromkeys((SIZE, SPHERE, USE, BEYOND), "NodeSocketFloat")
    for name, kind in kinds.items():
        tree.interface.new_socket(name.format(number), in_out="INPUT", socket_type=kind)


def _own_color(nodes: Nodes) -> list[Field]:
    """Red, green and blue of the splats with their paint, without view dependence, display-coded."""
    apart = nodes.add("ShaderNodeSeparateXYZ")
    nodes.link(_attribute(nodes, "FLOAT_COLOR", BASE), apart, "Vector")
    own = [nodes.field(apart.outputs[axis]) * SH_C0 + 0.5 for axis in "XYZ"]
    *paint, amount = (nodes.field(_attribute(nodes, "FLOAT", name)) for name in PAINT)
    return [(1.0 - amount) * channel + over for channel, over in zip(own, paint, strict=True)]


def _attribute(nodes: Nodes, kind: str, name: str) -> bpy.types.NodeSocket:
    """A named attribute, 0 where the points have none."""
    node = nodes.add("GeometryNodeInputNamedAttribute", data_type=kind)
    node.inputs["Name"].default_value = name
    return next(s for s in node.outputs if s.name == "Attribute" and s.enabled)


def _mapped(nodes: Nodes, sockets, number: int, color: list[Field]) -> list[Field]:
    """What the matrix of a number makes of a colour."""
    vector = nodes.add("ShaderNodeCombineXYZ")
    for channel, axis in zip(color, "XYZ", strict=True):
        nodes.link(channel.socket, vector, axis)
    return [
        nodes.field(nodes.vector("DOT_PRODUCT", sockets[row.format(number)], vector.outputs["Vector"]))
        for row in ROWS
    ]


def _linear(code: Field) -> Field:
    """As ``training.scenes.color.linear_from_srgb``."""
    return (code > 0.04045).where(((code + 0.055) / 1.055).power(2.4), code / 12.92)
