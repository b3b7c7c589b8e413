"""``training.lod.rules.chunks`` in geometry nodes."""

from __future__ import annotations

import bpy

from ....training.lod.rule import NO_FINER
from ....training.lod.rules.chunks import BITS, LEAVING, MEMBERS, TABLE
from ..building import Field, Nodes
from . import Inputs

VERSION = 2
FADES = True
_ROW = "row"
"""Attribute of chunks that keeps their numbers while they are sorted."""


def weight(inputs: Inputs) -> Field:
    """``Chunks.weights``: the two nearest chunks' sets where they are in use, else what distances choose."""
    nodes = inputs.nodes
    size = nodes.add("GeometryNodeAttributeDomainSize", component="MESH")
    table = inputs.table(TABLE)
    nodes.link(table, size, "Geometry")
    there = nodes.field(size.outputs["Point Count"]) > 0.5
    return (there & inputs["chunks"]).where(_by_chunks(inputs, _numbered(nodes, table)), _by_distance(inputs))


def _by_distance(inputs: Inputs) -> Field:
    """1 where d_l <= distance < d_l of the next coarser level."""
    away = inputs.distance * inputs["distance_scale"]
    from_near = (inputs["finer"] >= float(NO_FINER)).where(1.0, away >= inputs["d_l"])
    not_beyond = (inputs["coarser"] > 0.5).where(away < inputs["coarser_d_l"], 1.0)
    return from_near & not_beyond


def _by_chunks(inputs: Inputs, chunks: bpy.types.NodeSocket) -> Field:
    """Both sets by their shares, and for the rest, away from the chunks, what distances choose.

    What is sampled of chunks are single values, so only the sets cost time for each splat.
    """
    nodes, fade, place = inputs.nodes, inputs["fade"], inputs.table_place()

    def at(index: int, ordered: bpy.types.NodeSocket, values: Field) -> Field:
        """A number of the chunk at a place of an order; of fewer chunks the last one's."""
        return nodes.field(nodes.sampled(ordered, values.socket, index, clamp=True))

    row, distance = nodes.field(nodes.named(_ROW)), nodes.field(nodes.vector("DISTANCE", place, inputs.eye))
    beyond = (distance / inputs.table_column("radius").maximum(1e-20) - 1.0) / LEAVING
    nearest = nodes.sorted(chunks, distance.socket)
    centre = nodes.sampled(nearest, place, 0, kind="FLOAT_VECTOR", clamp=True)
    away = nodes.vector("SUBTRACT", inputs.eye, centre)
    along = nodes.vector("SUBTRACT", place, centre)
    length2 = nodes.field(nodes.vector("DOT_PRODUCT", along, along))
    t = nodes.field(nodes.vector("DOT_PRODUCT", away, along)) / length2  # of the nearest itself 0 / 0 = 0
    ahead = nodes.sorted(chunks, (t * -1.0).socket)

    t_second, t_third = at(0, ahead, t), at(1, ahead, t)
    fading = fade & (t_second > 0.0)
    s = (t_third * 2.0 - t_second).maximum(0.0)
    share = fading * ((t_second - s) / (1.0 - s * 2.0).maximum(1e-20)).clip(0.0, 0.5)
    least = at(0, nearest, beyond)
    least = fading.where(least.minimum(at(0, ahead, beyond)), least)
    inside = fade.where((1.0 - least).clip(0.0, 1.0), least <= 0.0)
    first, second = (_member(inputs, at(0, ordered, row)) for ordered in (nearest, ahead))
    sets = inside * (1.0 - share) * first + inside * share * second
    return (inside < 1.0).where(sets + (1.0 - inside) * _by_distance(inputs), sets)


def _numbered(nodes: Nodes, table: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The chunks, each with its number."""
    node = nodes.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    node.inputs["Name"].default_value = _ROW
    nodes.link(table, node, "Geometry")
    nodes.link(nodes.add("GeometryNodeInputIndex").outputs["Index"], node, "Value")
    return node.outputs["Geometry"]


def _member(inputs: Inputs, number: Field) -> Field:
    """1 for the splats of a chunk's set: its bit of the column that tells of it."""
    nodes = inputs.nodes
    columns = [inputs.column(name).socket for name in MEMBERS]
    column = nodes.field(nodes.which((number / BITS).floor(), *columns))
    bit = nodes.field(nodes.math("POWER", 2.0, number.modulo(BITS).socket))
    return (column / bit).floor().modulo(2.0)
