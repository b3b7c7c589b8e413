"""``training.lod.rules.cut`` in geometry nodes."""

from __future__ import annotations

import bpy

from ....training.lod.rules.cut import K_LEAST, NODE_SIZE, PARENT, PARENT_SIZE
from ..building import Field
from . import Inputs

VERSION = 1
FADES = False


def weight(inputs: Inputs) -> Field:
    """1 where a node is fine enough and its parent is not."""
    nodes = inputs.nodes
    detail = (inputs.focal_px / inputs["pixels"]).maximum(K_LEAST)

    def coarse(place: bpy.types.NodeSocket, size: str) -> Field:
        """The same arithmetic for a node as itself and as a parent, so that both are of one mind."""
        away = nodes.field(nodes.vector("DISTANCE", place, inputs.eye))
        return away < inputs.column(size) * detail

    parent = nodes.add("ShaderNodeCombineXYZ")
    for name, axis in zip(PARENT, "XYZ", strict=True):
        nodes.link(inputs.column(name).socket, parent, axis)
    above = coarse(parent.outputs["Vector"], PARENT_SIZE)
    return above & (1.0 - coarse(inputs.position(), NODE_SIZE))
