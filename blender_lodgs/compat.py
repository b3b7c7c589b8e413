"""Differences between Blender versions, detected by feature, never by version number."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import bpy
import numpy as np

WIDE_TYPE = (
    "FLOAT4" if "FLOAT4" in bpy.types.Attribute.bl_rna.properties["data_type"].enum_items else "FLOAT_COLOR"
)
"""Attribute type for four plain floats: FLOAT4 from Blender 5.2 on, the equally exact FLOAT_COLOR before."""


def _denoises() -> bool:
    try:
        import _cycles  # type: ignore[import-not-found]
    except ImportError:
        return False
    return getattr(_cycles, "with_openimagedenoise", True)


HAS_DENOISER = _denoises()
"""True if Cycles was built with Open Image Denoise; some Linux distributions omit it."""


def _native_splats() -> tuple[str, str] | None:
    for name, kind in bpy.types.PointCloud.bl_rna.properties.items():
        if isinstance(kind, bpy.types.EnumProperty) and not kind.is_readonly:
            for item in kind.enum_items:
                if "SPLAT" in item.identifier.upper():
                    return name, item.identifier
    return None


NATIVE_SPLATS = _native_splats()
"""Property of point clouds and its value for Gaussian splats; None before Blender 5.3."""


NATIVE_HIGHER_SH = 15
"""Number of SH coefficients above degree 0 of Blender's own splats (degree 3)."""


def make_native(cloud: bpy.types.PointCloud) -> bool:
    """Set a point cloud's type to Gaussian splats; return False where Blender has no such type."""
    if NATIVE_SPLATS:
        setattr(cloud, *NATIVE_SPLATS)
    return bool(NATIVE_SPLATS)


def is_native(cloud: bpy.types.PointCloud) -> bool:
    """Return True if Blender draws a point cloud as Gaussian splats."""
    return NATIVE_SPLATS is not None and getattr(cloud, NATIVE_SPLATS[0]) == NATIVE_SPLATS[1]


def new_point_cloud(name: str, positions: np.ndarray) -> bpy.types.PointCloud:
    """Create a point-cloud datablock of points at the positions (N, 3), without users."""
    coordinates = np.ascontiguousarray(positions, np.float32).ravel()
    cloud = bpy.data.pointclouds.new(name)
    if hasattr(cloud, "resize"):
        cloud.resize(len(positions))
    else:
        bpy.data.pointclouds.remove(cloud)
        cloud = _converted_vertices(name, coordinates)
    position = cloud.attributes.get("position") or cloud.attributes.new("position", "FLOAT_VECTOR", "POINT")
    position.data.foreach_set("vector", coordinates)
    return cloud


def _converted_vertices(name: str, coordinates: np.ndarray) -> bpy.types.PointCloud:
    """Create a point cloud from vertices; the only way without PointCloud.resize.

    The vertices have their coordinates (3N,) before, since Blender 5.0 keeps the bounds of the conversion. A
    separate scene keeps mode and selection.
    """
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(coordinates) // 3)
    mesh.vertices.foreach_set("co", coordinates)
    carrier, scene = bpy.data.objects.new(name, mesh), bpy.data.scenes.new(name)
    scene.collection.objects.link(carrier)
    with bpy.context.temp_override(
        scene=scene, view_layer=scene.view_layers[0], active_object=carrier, object=carrier,
        selected_objects=[carrier], selected_editable_objects=[carrier],
    ):  # fmt: skip
        bpy.ops.object.convert(target="POINTCLOUD")
    cloud = carrier.data
    assert isinstance(cloud, bpy.types.PointCloud)
    bpy.data.objects.remove(carrier)
    bpy.data.scenes.remove(scene)
    bpy.data.meshes.remove(mesh)
    cloud.name = name
    return cloud


def _input_identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    """Return the identifier of the group input called ``name``."""
    return next(
        item.identifier
        for item in modifier.node_group.interface.items_tree
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name
    )


def has_input(modifier: bpy.types.NodesModifier, name: str) -> bool:
    """Return True if a modifier's node group has an input called ``name``."""
    return any(
        item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name
        for item in modifier.node_group.interface.items_tree
    )


def input_path(modifier: bpy.types.NodesModifier, name: str) -> str:
    """Return the data path, from the modifier's object, of the group input called ``name``."""
    identifier, owner = _input_identifier(modifier, name), f'modifiers["{modifier.name}"]'
    if hasattr(modifier, "properties"):
        return f"{owner}.properties.inputs.{identifier}.value"
    return f'{owner}["{identifier}"]'


def get_input(modifier: bpy.types.NodesModifier, name: str):
    """Return the value of the group input called ``name``."""
    identifier = _input_identifier(modifier, name)
    if hasattr(modifier, "properties"):
        return getattr(modifier.properties.inputs, identifier).value
    return modifier[identifier]


def set_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Set the group input called ``name`` and tag the object for evaluation."""
    identifier = _input_identifier(modifier, name)
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def use_standard_view(settings: bpy.types.ColorManagedViewSettings) -> None:
    """Set the view transform that keeps display colours, if Blender's colour configuration has it."""
    with suppress(TypeError):  # a studio's own configuration
        settings.view_transform = "Standard"


def sequencer_strips(scene: bpy.types.Scene):
    """Return the strips of a scene's sequencer; Blender 4.3 and earlier call them sequences."""
    editor = scene.sequence_editor_create()
    return editor.strips if hasattr(editor, "strips") else editor.sequences


def set_png(settings: bpy.types.ImageFormatSettings, alpha: bool) -> None:
    """Set the image format to PNG with 8 bits."""
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_mode = "PNG", "RGBA" if alpha else "RGB"
    settings.color_depth = "8"


def set_multilayer_exr(settings: bpy.types.ImageFormatSettings) -> None:
    """Set the image format to multilayer EXR with 32-bit floats."""
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"


@contextmanager
def square_pixels(render: bpy.types.RenderSettings) -> Iterator[None]:
    """Set square pixels while a render is saved: Blender 5.0 writes no multilayer EXR with other pixels."""
    aspects = render.pixel_aspect_x, render.pixel_aspect_y
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    try:
        yield
    finally:
        render.pixel_aspect_x, render.pixel_aspect_y = aspects


COMPOSITOR_START = (
    "CompositorNodeRLayers", "CompositorNodeComposite", "CompositorNodeViewer", "NodeGroupOutput",
    "NodeReroute",
)  # fmt: skip
"""Nodes of an unedited compositor tree."""


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """Return the scene's compositor tree, created if necessary, and enable compositing."""
    if hasattr(scene, "compositing_node_group"):
        if scene.compositing_node_group is None:
            scene.compositing_node_group = bpy.data.node_groups.new(scene.name, "CompositorNodeTree")
        tree = scene.compositing_node_group
    else:
        scene.use_nodes = True
        tree = scene.node_tree
    assert tree is not None
    scene.render.use_compositing = True
    return tree


def uses_compositor(scene: bpy.types.Scene) -> bool:
    """Return True if renders of a scene are composited."""
    if hasattr(scene, "compositing_node_group"):
        return scene.render.use_compositing and scene.compositing_node_group is not None
    return scene.render.use_compositing and scene.use_nodes and scene.node_tree is not None


def reset_compositor(scene: bpy.types.Scene) -> None:
    """Reset the compositor of a scene to its default."""
    if hasattr(scene, "compositing_node_group"):
        tree, scene.compositing_node_group = scene.compositing_node_group, None
        if tree is not None and not tree.users:
            bpy.data.node_groups.remove(tree)
        return
    nodes = compositor_tree(scene).nodes
    nodes.clear()
    layers, output = nodes.new("CompositorNodeRLayers"), nodes.new("CompositorNodeComposite")
    output.location = (400, 0)
    scene.node_tree.links.new(layers.outputs["Image"], output.inputs["Image"])
    scene.use_nodes = False


COMPOSITOR_MATH = "CompositorNodeMath" if hasattr(bpy.types, "CompositorNodeMath") else "ShaderNodeMath"
COMPOSITOR_MIX = "CompositorNodeMixRGB" if hasattr(bpy.types, "CompositorNodeMixRGB") else "ShaderNodeMix"


def compositor_output(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Add an output node and return its image socket."""
    if hasattr(bpy.types, "CompositorNodeComposite"):
        output = tree.nodes.new("CompositorNodeComposite")
    else:
        if not any(item.in_out == "OUTPUT" for item in tree.interface.items_tree):
            tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    output.location = (1400, 0)
    return output.inputs[0]
