"""Compositor nodes that combine the images of two scenes."""

from __future__ import annotations

import bpy

from .. import compat

ALPHA_OVER = "CompositorNodeAlphaOver"
MIN_DEPTH = "CompositorNodeDilateErode"
"""Type of a node that only occurs where images are combined by depth."""
_CATCHER_REACH = 0.1
"""Share of the depth of a shadow catcher by which splats in front of it get its shadows: the depth of a splat
is that of its centre, which is nearer than the surface if the view grazes it."""
_COVERED = 0.999
"""Minimum alpha of a pixel that a mesh covers completely."""


class TreeBuilder:
    """Builder of compositor nodes, from left to right."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self._tree = tree
        self._x = 0

    def render_layer(self, scene: bpy.types.Scene, layer: str, row: int) -> bpy.types.Node:
        """Add the images of a view layer."""
        node = self._tree.nodes.new("CompositorNodeRLayers")
        node.location = (0, -420 * row)
        node.scene, node.layer, node.label = scene, layer, scene.name
        return node

    def over(self, front: bpy.types.NodeSocket, back: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Add a node that places an image over another one."""
        node = self._add(ALPHA_OVER)
        background, foreground = (socket for socket in node.inputs if socket.type == "RGBA")
        self._tree.links.new(back, background)
        self._tree.links.new(front, foreground)
        return node.outputs[0]

    def mix(
        self,
        factor: bpy.types.NodeSocket | float,
        first: bpy.types.NodeSocket,
        second: bpy.types.NodeSocket,
        blend: str = "MIX",
    ) -> bpy.types.NodeSocket:
        """Add a node that mixes or multiplies two images; the alpha is that of the first."""
        node = self._add(compat.COMPOSITOR_MIX)
        node.blend_type = blend
        if hasattr(node, "data_type"):
            node.data_type = "RGBA"
        sockets = [node.inputs[0], *(socket for socket in node.inputs if socket.type == "RGBA")]
        self._connect(sockets, factor, first, second)
        return next(socket for socket in node.outputs if socket.type == "RGBA")

    def nearer(self, front: bpy.types.Node, back: bpy.types.Node) -> bpy.types.NodeSocket:
        """Add nodes that return 1 where a layer of meshes is nearer than another layer.

        Where a mesh covers a part of a pixel, the pixel's depth is that of the mesh or of the background. The
        smallest depth of the neighbouring pixels is that of the mesh.
        """
        depth, other_depth = front.outputs["Depth"], back.outputs["Depth"]
        smallest = self._add(MIN_DEPTH, depth)
        smallest.inputs["Size"].default_value = -1
        near = self._add("CompositorNodeAntiAliasing", self._math("LESS_THAN", depth, other_depth))
        edge_near = self._math("LESS_THAN", smallest.outputs[0], other_depth)
        edge = self._math("LESS_THAN", front.outputs["Alpha"], _COVERED)
        return self._math("MAXIMUM", near.outputs[0], self._math("MULTIPLY", edge_near, edge))

    def is_near_catcher(self, catcher: bpy.types.Node, splats: bpy.types.Node) -> bpy.types.NodeSocket:
        """Add nodes that return 1 where splats are not far in front of a layer with a shadow catcher."""
        depth = self._math("MULTIPLY", catcher.outputs["Depth"], 1 - _CATCHER_REACH)
        return self._math("LESS_THAN", depth, splats.outputs["Depth"])

    def _math(self, operation: str, *sources: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        node = self._add(compat.COMPOSITOR_MATH, *sources)
        node.operation = operation
        return node.outputs[0]

    def _add(self, kind: str, *sources: bpy.types.NodeSocket | float) -> bpy.types.Node:
        node = self._tree.nodes.new(kind)
        self._x += 200
        node.location = (200 + self._x, -self._x % 400)
        self._connect(node.inputs, *sources)
        return node

    def _connect(self, sockets, *sources: bpy.types.NodeSocket | float) -> None:
        for source, socket in zip(sources, sockets, strict=False):
            if isinstance(source, bpy.types.NodeSocket):
                self._tree.links.new(source, socket)
            else:
                socket.default_value = source
