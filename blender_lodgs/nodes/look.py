"""Node group for looks and paint: ``training.editing.look`` and ``training.editing.paint`` in geometry nodes.

The group computes the colour and the opacity factor of points and ellipsoids. Where Blender draws splats
itself, it also changes their spherical harmonics, which are linear in the look's matrix. LODGS' own drawing
reads the same settings without this group (``data.looks``).
"""

from __future__ import annotations

import bpy

from ...training.editing.paint import COLUMNS as PAINT
from ...training.splats.gaussians import SH_C0
from .. import compat
from ..attributes import BASE, COLOR, LOOK_OPACITY, sh_name
from .building import VERSION, Field, Nodes, ensure_group, is_edited
from .crops import OBJECT, SIZE, SPHERE, USE, inside_crop

COUNT = "lodgs_looks"
"""Custom property of these groups: their number of regions with a local look."""
NAME = "LODGS Look"
MATRIX_ROWS, OPACITY, BEYOND = ("red_{}", "green_{}", "blue_{}"), "opacity_{}", "beyond_{}"
"""Sockets of each look: the rows of its colour matrix, its opacity factor, and a flag that is 1 if the look
applies outside its region. Look 0 applies everywhere and has no flag. The looks of regions are numbered from
1 and also have the sockets of a crop."""
HIGHER_SH = "lodgs_higher_sh"
"""Custom property of these groups: number of SH coefficients above degree 0 that they change."""
_VERSION = 3


def look_group(count: int, higher: int) -> bpy.types.GeometryNodeTree:
    """Return the group for ``count`` regions.

    Args:
        count: number of regions with a local look.
        higher: number of SH coefficients above degree 0 of the splats. It matters only where Blender draws
            splats itself (:func:`changed_sh`).
    """
    higher = changed_sh(higher)

    def build(nodes: Nodes) -> None:
        nodes.tree[COUNT], nodes.tree[HIGHER_SH] = count, higher
        for number in range(count + 1):
            _add_sockets(nodes.tree, number)
        sockets = nodes.add("NodeGroupInput").outputs
        position = nodes.add("GeometryNodeInputPosition").outputs["Position"]
        color = _painted_color(nodes)
        opacity = nodes.field(sockets[OPACITY.format(0)])
        color = _apply_matrix(nodes, sockets, 0, color)
        rows = [sockets[row.format(0)] for row in MATRIX_ROWS]
        for number in range(1, count + 1):
            enabled, outside = (nodes.field(sockets[name.format(number)]) for name in (USE, BEYOND))
            inside = inside_crop(nodes, sockets, number, position)
            affected = enabled & (outside > 0.5).where(1.0 - inside, inside)
            mapped = _apply_matrix(nodes, sockets, number, color)
            color = [affected.where(new, old) for new, old in zip(mapped, color, strict=True)]
            opacity = opacity * affected.where(nodes.field(sockets[OPACITY.format(number)]), 1.0)
            if compat.NATIVE_SPLATS:
                local = [sockets[row.format(number)] for row in MATRIX_ROWS]
                rows = _product_where(nodes, affected, local, rows)
        display_color = nodes.add("FunctionNodeCombineColor")
        for socket, channel in zip(display_color.inputs, color, strict=False):
            nodes.tree.links.new(_linear_from_srgb(channel.clip(0.0, 1.0)).socket, socket)
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
        if compat.NATIVE_SPLATS:
            points = _changed_harmonics(nodes, points, color, rows, higher)
        nodes.link(points, nodes.add("NodeGroupOutput"), "Geometry")

    name = NAME if count == 0 else f"{NAME} {count}"
    if compat.NATIVE_SPLATS:
        name += f" ({higher + 1} SH)"
    return ensure_group(name, _VERSION, build)


def changed_sh(higher: int) -> int:
    """Return the number of SH coefficients above degree 0 that Blender draws, and the group thus changes."""
    return min(higher, compat.NATIVE_HIGHER_SH) if compat.NATIVE_SPLATS else 0


def is_unedited_look(tree: bpy.types.NodeTree | None) -> bool:
    """Return whether a modifier's group is an unedited look group."""
    return tree is not None and COUNT in tree and not is_edited(tree)


def is_current(tree: bpy.types.NodeTree | None, count: int, higher: int) -> bool:
    """Return whether a modifier's group, edited or not, has this version and these arguments."""
    return (
        tree is not None
        and tree.get(COUNT) == count
        and tree.get(HIGHER_SH) == changed_sh(higher)
        and tree.get(VERSION) == _VERSION
    )


def _add_sockets(tree: bpy.types.GeometryNodeTree, number: int) -> None:
    kinds = dict.fromkeys(MATRIX_ROWS, "NodeSocketVector") | {OPACITY: "NodeSocketFloat"}
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


def _apply_matrix(nodes: Nodes, sockets, number: int, color: list[Field]) -> list[Field]:
    """Multiply a colour by the matrix of a look."""
    vector = nodes.add("ShaderNodeCombineXYZ")
    for channel, axis in zip(color, "XYZ", strict=True):
        nodes.link(channel.socket, vector, axis)
    return [
        nodes.field(nodes.vector("DOT_PRODUCT", sockets[row.format(number)], vector.outputs["Vector"]))
        for row in MATRIX_ROWS
    ]


def _product_where(
    nodes: Nodes, inside: Field, left: list[bpy.types.NodeSocket], right: list[bpy.types.NodeSocket]
) -> list[bpy.types.NodeSocket]:
    """Return the rows of ``left @ right`` where ``inside`` is 1, and those of ``right`` elsewhere."""
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
        nodes.link(inside.socket, switch, "Switch")
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
        color: view-independent colour with the look applied, in display space.
        rows: rows of the look's matrix.
        higher: number of coefficients above degree 0.
    """
    opacity = nodes.add("FunctionNodeSeparateColor")
    nodes.link(nodes.attribute(BASE, "FLOAT_COLOR"), opacity, "Color")
    base = nodes.add("FunctionNodeCombineColor")
    for channel, name in zip(color, ("Red", "Green", "Blue"), strict=True):
        nodes.link(((channel - 0.5) / SH_C0).socket, base, name)
    nodes.link(opacity.outputs["Alpha"], base, "Alpha")
    changed = [(BASE, "FLOAT_COLOR", base.outputs["Color"])]
    unpainted = 1.0 - nodes.field(nodes.attribute(PAINT[-1]))
    for name in map(sh_name, range(1, higher + 1)):
        scaled = nodes.add("ShaderNodeVectorMath", operation="SCALE")
        nodes.tree.links.new(nodes.attribute(name, "FLOAT_VECTOR"), scaled.inputs[0])
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


def _linear_from_srgb(srgb: Field) -> Field:
    """Convert sRGB to linear, as ``training.color.linear_from_srgb``."""
    return (srgb > 0.04045).where(((srgb + 0.055) / 1.055).power(2.4), srgb / 12.92)
