"""Rule ``training.lod.rules.cut`` in geometry nodes."""

from __future__ import annotations

import bpy

from ....training.lod.tree.nodes import MIN_DETAIL, NODE_SIZE, PARENT, PARENT_SIZE
from ..building import Field
from . import RuleInputs

VERSION = 1
FADES = False


def weight(inputs: RuleInputs) -> Field:
    """Return 1 if a node is fine enough and its parent is not."""
    nodes = inputs.nodes
    detail = (inputs.focal_px / inputs["pixels"]).maximum(MIN_DETAIL)

    def is_coarse(position: bpy.types.NodeSocket, size: str) -> Field:
        """Return 1 if a node is too coarse. Node and parent use the same arithmetic, so rounding agrees."""
        distance = nodes.field(nodes.vector("DISTANCE", position, inputs.camera))
        return distance < inputs.column(size) * detail

    parent = nodes.add("ShaderNodeCombineXYZ")
    for name, axis in zip(PARENT, "XYZ", strict=True):
        nodes.link(inputs.column(name).socket, parent, axis)
    parent_is_coarse = is_coarse(parent.outputs["Vector"], PARENT_SIZE)
    return parent_is_coarse & (1.0 - is_coarse(inputs.position(), NODE_SIZE))
