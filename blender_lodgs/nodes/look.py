"""``training.lod.look`` in geometry nodes, and ``paint``: the colours and opacities in which Blender itself
draws splats.

What LODGS draws gets its look from the same settings without this group (``data.looks``). The group writes
the colour of points and ellipsoids, and the look's factor on opacities as an attribute. Where Blender draws
splats itself, it also changes their spherical harmonics, which are linear in the look's matrix.
"""

from __future__ import annotations

import bpy

from ...training.lod.paint import COLUMNS as PAINT
from ...training.splats.gaussians import SH_C0
from .. import compat
from ..attributes import BASE, COLOR, LOOK_OPACITY, sh_name
from .building import VERSION, Field, Nodes, edited, group
from .crops import OBJECT, SIZE, SPHERE, USE, holds

COUNT = "lodgs_looks"
"""Custom property of these groups: how many regions with looks of their own they have."""
NAME = "LODGS Look"
ROWS, OPACITY, BEYOND = ("red_{}", "green_{}", "blue_{}"), "opacity_{}", "beyond_{}"
"""Sockets of each look: the rows of its matrix, and its opacity. 0 is the look everywhere; regions follow,
with the sockets of crops, and what is 1 where a look counts outside of one."""
HIGHER = "lodgs_higher_sh"
"""Custom property of these groups: number of SH coefficients above degree 0 that they change."""
_VERSION = 3


def look_group(count: int, higher: int) -> bpy.types.GeometryNodeTree:
    """Return the group for ``count`` regions, new unless this file has one of this version.

    Args:
        count: number of regions with looks of their own.
        higher: number of SH coefficients above degree 0 of the splats. It matters only where Blender draws
            splats itself (:func:`changed_sh`).
    """
    higher = changed_sh(higher)

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT], nodes.tree[HIGHER] = count, higher
        for number in range(count + 1):
            _add_sockets(nodes.tree, number)
        sockets = nodes.add("NodeGroupInput").outputs
        position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
        color, opacity = _own_color(nodes), nodes.field(sockets[OPACITY.format(0)])
        color = _mapped(nodes, sockets, 0, color)
        rows = [sockets[row.format(0)] for row in ROWS]
        for number in range(1, count + 1):
            used, beyond = (nodes.field(sockets[name.format(number)]) for name in (USE, BEYOND))
            held = holds(nodes, sockets, number, position)
            held = used & (beyond > 0.5).where(1.0 - held, held)
            there = _mapped(nodes, sockets, number, color)
            color = [held.where(new, old) for new, old in zip(there, color, strict=True)]
            opacity = opacity * held.where(nodes.field(sockets[OPACITY.format(number)]), 1.0)
            if compat.NATIVE_SPLATS:
                rows = _product_where(nodes, held, [sockets[row.format(number)] for row in ROWS], rows)
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
        if compat.NATIVE_SPLATS:
            points = _changed_harmonics(nodes, points, color, rows, higher)
        nodes.link(points, nodes.add("NodeGroupOutput"), "Geometry")

    name = NAME if count == 0 else f"{NAME} {count}"
    if compat.NATIVE_SPLATS:
        name += f" ({higher + 1} SH)"
    return group(name, _VERSION, build)


def changed_sh(higher: int) -> int:
    """Number of SH coefficients above degree 0 that the group changes: those that Blender itself draws."""
    return min(higher, compat.NATIVE_HIGHER_SH) if compat.NATIVE_SPLATS else 0


def is_look(tree: bpy.types.NodeTree | None) -> bool:
    """Whether a modifier's group is such a one, and what it was made."""
    return tree is not None and COUNT in tree and not edited(tree)


def serves(tree: bpy.types.NodeTree | None, count: int, higher: int) -> bool:
    """True if a modifier's group is of this version and for these arguments of :func:`look_group`."""
    return (
        tree is not None
        and tree.get(COUNT) == count
        and tree.get(HIGHER) == changed_sh(higher)
        and tree.get(VERSION) == _VERSION
    )


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


def _product_where(
    nodes: Nodes, held: Field, left: list[bpy.types.NodeSocket], right: list[bpy.types.NodeSocket]
) -> list[bpy.types.NodeSocket]:
    """Rows of the matrix product ``left @ right`` where ``held`` is 1, those of ``right`` elsewhere."""
    product = []
    for row, unchanged in zip(left, right, strict=True):
        factors = nodes.add("ShaderNodeSeparateXYZ")
        nodes.link(row, factors, "Vector")
        total = None
        for axis, other in zip("XYZ", right, strict=True):
            scaled = nodes.add("ShaderNodeVectorMath", operation="SCALE")
            nodes.tree.links.new(other, scaled.inputs[0])
            nodes.link(factors.outputs[axis], scaled, "Scale")
            term = scaled.outputs["Vector"]
            total = term if total is None else nodes.vector("ADD", total, term)
        switch = nodes.add("GeometryNodeSwitch", input_type="VECTOR")
        nodes.link(held.socket, switch, "Switch")
        nodes.link(total, switch, "True")
        nodes.link(unchanged, switch, "False")
        product.append(next(s for s in switch.outputs if s.enabled))
    return product


def _changed_harmonics(
    nodes: Nodes,
    points: bpy.types.NodeSocket,
    color: list[Field],
    rows: list[bpy.types.NodeSocket],
    higher: int,
) -> bpy.types.NodeSocket:
    """Store the look in ``radiance:base`` and the higher coefficients, which Blender itself draws from.

    Args:
        color: what the look makes of the view-independent colour, in display space.
        rows: of the look's matrix.
        higher: number of coefficients above degree 0.
    """
    opacity = nodes.add("FunctionNodeSeparateColor")
    nodes.link(_attribute(nodes, "FLOAT_COLOR", BASE), opacity, "Color")
    base = nodes.add("FunctionNodeCombineColor")
    for channel, name in zip(color, ("Red", "Green", "Blue"), strict=True):
        nodes.link(((channel - 0.5) / SH_C0).socket, base, name)
    nodes.link(opacity.outputs["Alpha"], base, "Alpha")
    changed = [(BASE, "FLOAT_COLOR", base.outputs["Color"])]
    unpainted = 1.0 - nodes.field(_attribute(nodes, "FLOAT", PAINT[-1]))
    for name in map(sh_name, range(1, higher + 1)):
        scaled = nodes.add("ShaderNodeVectorMath", operation="SCALE")
        nodes.tree.links.new(_attribute(nodes, "FLOAT_VECTOR", name), scaled.inputs[0])
        nodes.link(unpainted.socket, scaled, "Scale")
        vector = nodes.add("ShaderNodeCombineXYZ")
        for row, axis in zip(rows, "XYZ", strict=True):
            nodes.link(nodes.vector("DOT_PRODUCT", row, scaled.outputs["Vector"]), vector, axis)
        changed.append((name, "FLOAT_VECTOR", vector.outputs["Vector"]))
    # Each value depends on its own attribute and on paint, which nothing changes, so the order is free.
    for name, kind, value in changed:
        store = nodes.add("GeometryNodeStoreNamedAttribute", data_type=kind, domain="POINT")
        store.inputs["Name"].default_value = name
        nodes.link(points, store, "Geometry")
        nodes.link(value, store, "Value")
        points = store.outputs["Geometry"]
    return points


def _linear(code: Field) -> Field:
    """As ``training.scenes.color.linear_from_srgb``."""
    return (code > 0.04045).where(((code + 0.055) / 1.055).power(2.4), code / 12.92)
