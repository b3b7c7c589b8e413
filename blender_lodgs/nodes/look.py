"""Node group for looks and paint: ``training.editing.look`` and ``training.editing.paint`` in geometry nodes.

The group computes the colour and the opacity factor of points and ellipsoids, which Blender itself draws.
Harmonics and opacities of the splats stay unchanged. LODGS' own drawing reads the same settings without this
group (``data.looks``).
"""

from __future__ import annotations

import bpy

from ...training.editing.paint import COLUMNS as PAINT
from ...training.splats.gaussians import SH_C0
from ..attributes import BASE, COLOR, LOOK_OPACITY
from .building import VERSION, Field, Nodes, ensure_group, is_edited
from .crops import OBJECT, SIZE, SPHERE, USE, inside_crop

COUNT = "lodgs_looks"
"""Custom property of these groups: their number of regions with a local look."""
NAME = "LODGS Look"
ROWS, OPACITY, BEYOND = ("red_{}", "green_{}", "blue_{}"), "opacity_{}", "beyond_{}"
"""Sockets of each look: the rows of its colour matrix, and its opacity factor. Look 0 applies everywhere. The
looks of regions follow from 1: they also have the sockets of a crop, and a flag that is 1 if the look applies
outside the region."""
_VERSION = 2


def look_group(count: int) -> bpy.types.GeometryNodeTree:
    """Return the group for ``count`` regions."""

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT] = count
        for number in range(count + 1):
            _add_sockets(nodes.tree, number)
        sockets = nodes.add("NodeGroupInput").outputs
        position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
        color = _painted_color(nodes)
        opacity = nodes.field(sockets[OPACITY.format(0)])
        color = _mapped(nodes, sockets, 0, color)
        for number in range(1, count + 1):
            enabled, beyond = (nodes.field(sockets[name.format(number)]) for name in (USE, BEYOND))
            inside = inside_crop(nodes, sockets, number, position)
            affected = enabled & (beyond > 0.5).where(1.0 - inside, inside)
            mapped = _mapped(nodes, sockets, number, color)
            color = [affected.where(new, old) for new, old in zip(mapped, color, strict=True)]
            opacity = opacity * affected.where(nodes.field(sockets[OPACITY.format(number)]), 1.0)
        display_color = nodes.add("FunctionNodeCombineColor")
        for socket, channel in zip(display_color.inputs, color, strict=False):
            nodes.tree.links.new(_linear(channel.clip(0.0, 1.0)).socket, socket)
        points = sockets["Geometry"]
        for name, kind, value in (
            (COLOR, "FLOAT_COLOR", display_color.outputs["Color"]),
            (LOOK_OPACITY, "FLOAT", opacity.socket),
        ):
            store = nodes.add("GeometryNodeStoreNamedAttribute", data_type=kind, domain="POINT")
            store.inputs["Name"].default_value = name
            nodes.link(points, store, "Geometry")
            nodes.link(value, store, "Value")
            points = store.outputs["Geometry"]
        nodes.link(points, nodes.add("NodeGroupOutput"), "Geometry")

    return ensure_group(NAME if count == 0 else f"{NAME} {count}", _VERSION, build)


def is_unedited_look(tree: bpy.types.NodeTree | None) -> bool:
    """Return whether a modifier's group is an unedited look group."""
    return tree is not None and COUNT in tree and not is_edited(tree)


def is_current(tree: bpy.types.NodeTree | None, count: int) -> bool:
    """Return whether a modifier's group, edited or not, has this version and ``count`` regions."""
    return tree is not None and tree.get(COUNT) == count and tree.get(VERSION) == _VERSION


def _add_sockets(tree: bpy.types.GeometryNodeTree, number: int) -> None:
    kinds = dict.fromkeys(ROWS, "NodeSocketVector") | {OPACITY: "NodeSocketFloat"}
    if number:
        kinds |= {OBJECT: "NodeSocketObject"} | dict.fromkeys((SIZE, SPHERE, USE, BEYOND), "NodeSocketFloat")
    for name, kind in kinds.items():
        tree.interface.new_socket(name.format(number), in_out="INPUT", socket_type=kind)


def _painted_color(nodes: Nodes) -> list[Field]:
    """Return red, green and blue of the painted splats, sRGB-encoded and without view dependence."""
    components = nodes.add("ShaderNodeSeparateXYZ")
    nodes.link(nodes.attribute(BASE, "FLOAT_COLOR"), components, "Vector")
    base = [nodes.field(components.outputs[axis]) * SH_C0 + 0.5 for axis in "XYZ"]
    *paint, amount = (nodes.field(nodes.attribute(name)) for name in PAINT)
    return [(1.0 - amount) * channel + coat for channel, coat in zip(base, paint, strict=True)]


def _mapped(nodes: Nodes, sockets, number: int, color: list[Field]) -> list[Field]:
    """Multiply a colour by the matrix of a look."""
    vector = nodes.add("ShaderNodeCombineXYZ")
    for channel, axis in zip(color, "XYZ", strict=True):
        nodes.link(channel.socket, vector, axis)
    return [
        nodes.field(nodes.vector("DOT_PRODUCT", sockets[row.format(number)], vector.outputs["Vector"]))
        for row in ROWS
    ]


def _linear(srgb: Field) -> Field:
    """Convert sRGB to linear, as ``training.scenes.color.linear_from_srgb``."""
    return (srgb > 0.04045).where(((srgb + 0.055) / 1.055).power(2.4), srgb / 12.92)
