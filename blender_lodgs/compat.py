"""What differs between Blender versions, each found by asking for the feature, never for the version."""

from __future__ import annotations

import bpy

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


DENOISES = _denoises()
"""Whether Cycles was built with Open Image Denoise: that of some Linux distributions was not."""


def _native_splats() -> tuple[str, str] | None:
    for name, kind in bpy.types.PointCloud.bl_rna.properties.items():
        if isinstance(kind, bpy.types.EnumProperty) and not kind.is_readonly:
            for item in kind.enum_items:
                if "SPLAT" in item.identifier.upper():
                    return name, item.identifier
    return None


NATIVE_SPLATS = _native_splats()
"""Property of point clouds, and its value, with which Blender draws Gaussian splats; None before 5.3."""


NATIVE_HIGHER_SH = 15
"""SH coefficients above degree 0 that Blender's own splats have: up to degree 3."""


def make_native(cloud: bpy.types.PointCloud) -> bool:
    """Set a point cloud's type to Gaussian splats; return False where Blender has no such type."""
    if NATIVE_SPLATS:
        setattr(cloud, *NATIVE_SPLATS)
    return bool(NATIVE_SPLATS)


def is_native(cloud: bpy.types.PointCloud) -> bool:
    """Return True if Blender draws a point cloud as Gaussian splats."""
    return NATIVE_SPLATS is not None and getattr(cloud, NATIVE_SPLATS[0]) == NATIVE_SPLATS[1]


def new_point_cloud(name: str, count: int) -> bpy.types.PointCloud:
    """A point-cloud datablock of ``count`` points, all at the origin, without users."""
    cloud = bpy.data.pointclouds.new(name)
    if hasattr(cloud, "resize"):
        cloud.resize(count)
        return cloud
    # Before PointCloud.resize, only a conversion makes points. In a scene of its own it meets no mode and
    # leaves the user's selection alone.
    bpy.data.pointclouds.remove(cloud)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(count)
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


def _identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    return next(
        item.identifier
        for item in modifier.node_group.interface.items_tree
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name
    )


def has_input(modifier: bpy.types.NodesModifier, name: str) -> bool:
    """Whether there is a group input called ``name``."""
    return any(
        item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name
        for item in modifier.node_group.interface.items_tree
    )


def input_path(modifier: bpy.types.NodesModifier, name: str) -> str:
    """The data path, from the modifier's object, of the group input called ``name``."""
    identifier, owner = _identifier(modifier, name), f'modifiers["{modifier.name}"]'
    if hasattr(modifier, "properties"):
        return f"{owner}.properties.inputs.{identifier}.value"
    return f'{owner}["{identifier}"]'


def get_input(modifier: bpy.types.NodesModifier, name: str):
    """The value of the group input called ``name``."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        return getattr(modifier.properties.inputs, identifier).value
    return modifier[identifier]


def set_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Sets the group input called ``name``; the object is evaluated anew."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def strips(scene: bpy.types.Scene):
    """The strips of a scene's sequencer, which Blender 4.3 and before call sequences."""
    editor = scene.sequence_editor_create()
    return editor.strips if hasattr(editor, "strips") else editor.sequences


def png(settings: bpy.types.ImageFormatSettings, alpha: bool) -> None:
    """Has pictures saved as PNGs of 8 bits."""
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_mode = "PNG", "RGBA" if alpha else "RGB"
    settings.color_depth = "8"


def multilayer_exr(settings: bpy.types.ImageFormatSettings) -> None:
    """Has pictures saved as multilayer EXRs, in whole floats."""
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"


COMPOSITOR_START = (
    "CompositorNodeRLayers", "CompositorNodeComposite", "CompositorNodeViewer", "NodeGroupOutput",
    "NodeReroute",
)  # fmt: skip
"""Nodes of a compositor tree that nobody has worked on."""


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The scene's compositor tree, made where there is none, and in use."""
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


def composites(scene: bpy.types.Scene) -> bool:
    """Whether a render's picture is what a compositor makes of it."""
    if hasattr(scene, "compositing_node_group"):
        return scene.render.use_compositing and scene.compositing_node_group is not None
    return scene.render.use_compositing and scene.use_nodes and scene.node_tree is not None


def reset_compositor(scene: bpy.types.Scene) -> None:
    """Makes the compositor of a scene what it is before anybody has worked on it."""
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


def to_straight(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """A new node that divides colours by their alpha."""
    node = tree.nodes.new("CompositorNodePremulKey")
    if hasattr(node, "mapping"):
        node.mapping = "PREMUL_TO_STRAIGHT"
    else:
        node.inputs["Type"].default_value = "To Straight"
    return node


def compositor_output(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """The socket that takes the finished picture, of a node made for it."""
    if hasattr(bpy.types, "CompositorNodeComposite"):
        output = tree.nodes.new("CompositorNodeComposite")
    else:
        if not any(item.in_out == "OUTPUT" for item in tree.interface.items_tree):
            tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    output.location = (600, 0)
    return output.inputs[0]


def stored_properties(owner: bpy.types.ID, name: str):
    """What a file stores of a property group of an ID, like a dict (also what no property of today reads);
    None where that is nothing."""
    if hasattr(owner, "bl_system_properties_get"):  # from 5.0 on they are no custom properties
        properties = owner.bl_system_properties_get()
        return None if properties is None else properties.get(name)
    return owner.get(name)
