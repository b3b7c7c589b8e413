"""Rule ``training.lod.rules.chunks`` in geometry nodes."""

from __future__ import annotations

import bpy

from ....training.lod.rule import NO_FINER
from ....training.lod.rules.chunks import BITS, FADE_SHARE, MEMBER_COLUMNS, TABLE
from ..building import Field, Nodes
from . import RuleInputs

VERSION = 2
FADES = True
_ROW = "row"
"""Attribute of chunks: their row in the table, kept while they are sorted."""


def weight(inputs: RuleInputs) -> Field:
    """Return the weights of ``Chunks.weights``: by chunks if present and enabled, else by distance."""
    nodes = inputs.nodes
    size = nodes.add("GeometryNodeAttributeDomainSize", component="MESH")
    table = inputs.table(TABLE)
    nodes.link(table, size, "Geometry")
    has_chunks = nodes.field(size.outputs["Point Count"]) > 0.5
    chunk_weights = _by_chunks(inputs, _with_rows(nodes, table))
    return (has_chunks & inputs["chunks"]).where(chunk_weights, _by_distance(inputs))


def _by_distance(inputs: RuleInputs) -> Field:
    """Return 1 if d_l <= distance < d_l of the next coarser level."""
    distance = inputs.distance * inputs["distance_scale"]
    after_near = (inputs["finer"] >= float(NO_FINER)).where(1.0, distance >= inputs["d_l"])
    before_far = (inputs["coarser"] > 0.5).where(distance < inputs["coarser_d_l"], 1.0)
    return after_near & before_far


def _by_chunks(inputs: RuleInputs, chunks: bpy.types.NodeSocket) -> Field:
    """Blend the sets of two chunks by their shares, and outside the chunks with weights by distance.

    Chunk properties are sampled as single values, so only the set membership costs time per splat.
    """
    nodes = inputs.nodes
    fade = inputs["fade"]
    position = inputs.table_position()

    def at(index: int, ordered: bpy.types.NodeSocket, values: Field) -> Field:
        """Return a value of the chunk at an index of a sorted list. A larger index reads the last chunk."""
        return nodes.field(nodes.sample(ordered, values.socket, index, clamp=True))

    row = nodes.field(nodes.attribute(_ROW))
    distance = nodes.field(nodes.vector("DISTANCE", position, inputs.camera))
    beyond = (distance / inputs.table_column("radius").maximum(1e-20) - 1.0) / FADE_SHARE
    nearest = nodes.sort_points(chunks, distance.socket)
    center = nodes.sample(nearest, position, 0, kind="FLOAT_VECTOR", clamp=True)
    to_camera = nodes.vector("SUBTRACT", inputs.camera, center)
    to_chunk = nodes.vector("SUBTRACT", position, center)
    length2 = nodes.field(nodes.vector("DOT_PRODUCT", to_chunk, to_chunk))
    t = nodes.field(nodes.vector("DOT_PRODUCT", to_camera, to_chunk)) / length2  # nearest chunk: 0 / 0 = 0
    ahead = nodes.sort_points(chunks, (t * -1.0).socket)

    t_second, t_third = at(0, ahead, t), at(1, ahead, t)
    fading = fade & (t_second > 0.0)
    s = (t_third * 2.0 - t_second).maximum(0.0)
    share = fading * ((t_second - s) / (1.0 - s * 2.0).maximum(1e-20)).clip(0.0, 0.5)
    nearest_beyond = at(0, nearest, beyond)
    min_beyond = fading.where(nearest_beyond.minimum(at(0, ahead, beyond)), nearest_beyond)
    inside = fade.where((1.0 - min_beyond).clip(0.0, 1.0), min_beyond <= 0.0)
    first, second = (_member(inputs, at(0, ordered, row)) for ordered in (nearest, ahead))
    sets = inside * (1.0 - share) * first + inside * share * second
    return (inside < 1.0).where(sets + (1.0 - inside) * _by_distance(inputs), sets)


def _with_rows(nodes: Nodes, table: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Store the row number of each chunk as the attribute _ROW."""
    node = nodes.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    node.inputs["Name"].default_value = _ROW
    nodes.link(table, node, "Geometry")
    nodes.link(nodes.add("GeometryNodeInputIndex").outputs["Index"], node, "Value")
    return node.outputs["Geometry"]


def _member(inputs: RuleInputs, number: Field) -> Field:
    """Return 1 for splats that belong to a chunk: one bit of a membership column."""
    nodes = inputs.nodes
    columns = [inputs.column(name).socket for name in MEMBER_COLUMNS]
    column = nodes.field(nodes.index_switch((number / BITS).floor(), *columns))
    bit = nodes.field(nodes.math("POWER", 2.0, number.modulo(BITS).socket))
    return (column / bit).floor().modulo(2.0)
