"""The node group "LODGS Ellipsoids": splats as meshes that Cycles and EEVEE light, reflect and shadow.

Every splat becomes an instance of one sphere, turned and stretched to REACH standard deviations. Its material
has the alpha of a Gaussian: where a ray passes the centre in d standard deviations, the opacity times
exp(-d²/2), which is the splat's projection. Colours are those without view dependence.
"""

from __future__ import annotations

import math

import bpy

from ..attributes import COLOR, LOOK_OPACITY, OPACITY_LOGIT, ROTATION, SCALE, WEIGHT
from .building import Nodes, edited, group, switched

NAME = "LODGS Ellipsoids"
MATERIAL = "LODGS Ellipsoids"
ALPHA = "splat_opacity"
REACH = 3.0
"""Standard deviations from the middle to the surface, where alpha is 1 % of the opacity."""
BOUNCES = 512
"""Transparent surfaces that a ray of Cycles has to pass.

With its own limit, 8, it would leave black holes; ended by chance before that, it leaves noise, and the
samples that remove it cost far more time than going on.
"""


def attach(obj: bpy.types.Object) -> None:
    """Gives an object of splats this modifier, last of all; it is on where its scene wants ellipsoids."""
    modifier = obj.modifiers.get(NAME)
    if modifier is None:
        switched(obj, ellipsoids(), show_render="lodgs_render.draws_ellipsoids")
    elif isinstance(modifier, bpy.types.NodesModifier) and (
        modifier.node_group is None or not edited(modifier.node_group)
    ):
        modifier.node_group = ellipsoids()  # an older file has an older one


def ellipsoids() -> bpy.types.GeometryNodeTree:
    """The group."""
    return group(NAME, 2, _build)


def _build(nodes: Nodes) -> None:
    add, link = nodes.add, nodes.link

    def attribute(name: str, kind: str) -> bpy.types.Node:
        node = add("GeometryNodeInputNamedAttribute", data_type=kind)
        node.inputs["Name"].default_value = name
        return node

    def value(node: bpy.types.Node) -> bpy.types.NodeSocket:
        return next(s for s in node.outputs if s.name == "Attribute" and s.enabled)

    points = add("NodeGroupInput").outputs[0]
    opacity = 1.0 / ((nodes.field(value(attribute(OPACITY_LOGIT, "FLOAT"))) * -1.0).exp() + 1.0)
    for factor in (attribute(WEIGHT, "FLOAT"), attribute(LOOK_OPACITY, "FLOAT")):
        # splats without the attribute are there in full
        opacity = opacity * nodes.field(factor.outputs["Exists"]).where(nodes.field(value(factor)), 1.0)
    store = add("GeometryNodeStoreNamedAttribute", data_type="FLOAT", domain="POINT")
    store.inputs["Name"].default_value = ALPHA
    link(points, store, "Geometry")
    link(opacity.socket, store, "Value")

    sphere = add("GeometryNodeMeshIcoSphere")
    sphere.inputs["Radius"].default_value, sphere.inputs["Subdivisions"].default_value = 1.0, 3
    smooth = add("GeometryNodeSetShadeSmooth")
    link(sphere.outputs["Mesh"], smooth, "Mesh" if "Mesh" in smooth.inputs else "Geometry")
    material = add("GeometryNodeSetMaterial")
    link(smooth.outputs[0], material, "Geometry")
    material.inputs["Material"].default_value = falloff()
    reach = add("ShaderNodeVectorMath", operation="SCALE")
    nodes.tree.links.new(value(attribute(SCALE, "FLOAT_VECTOR")), reach.inputs[0])
    reach.inputs["Scale"].default_value = REACH
    stand = add("GeometryNodeInstanceOnPoints")
    link(store.outputs["Geometry"], stand, "Points")
    link(material.outputs["Geometry"], stand, "Instance")
    link(value(attribute(ROTATION, "QUATERNION")), stand, "Rotation")
    link(reach.outputs["Vector"], stand, "Scale")
    link(stand.outputs["Instances"], add("NodeGroupOutput"), "Geometry")


def falloff() -> bpy.types.Material:
    """The material of the ellipsoids: alpha of a Gaussian, once for each ray that passes.

    On the unit sphere that all ellipsoids are images of, a ray from the direction v that meets the surface at
    p passes the centre in a distance of sqrt(1 - (p·v)²). It counts where it enters; if it began inside,
    where it leaves, as long as the centre was before it.
    """
    material = bpy.data.materials.get((MATERIAL, None))
    if material is not None:
        return material
    material = bpy.data.materials.new(MATERIAL)
    if material.node_tree is None:
        material.use_nodes = True
    if hasattr(material, "surface_render_method"):
        material.surface_render_method = "BLENDED"
    material.use_backface_culling = False
    tree = material.node_tree
    tree.nodes.clear()

    add = Nodes(tree).add

    def join(operation: str, *values: bpy.types.NodeSocket | float, kind: str = "ShaderNodeMath"):
        node = add(kind, operation=operation)
        for socket, given in zip(node.inputs, values, strict=False):
            if isinstance(given, bpy.types.NodeSocket):
                tree.links.new(given, socket)
            else:
                socket.default_value = given
        single = kind == "ShaderNodeMath" or operation in ("DOT_PRODUCT", "LENGTH")
        return node.outputs["Value" if single else "Vector"]

    geometry = add("ShaderNodeNewGeometry")
    local = add("ShaderNodeVectorTransform", vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT")
    tree.links.new(geometry.outputs["Incoming"], local.inputs["Vector"])
    towards = join("NORMALIZE", local.outputs["Vector"], kind="ShaderNodeVectorMath")
    place = join("NORMALIZE", add("ShaderNodeTexCoord").outputs["Object"], kind="ShaderNodeVectorMath")
    cosine = join("DOT_PRODUCT", place, towards, kind="ShaderNodeVectorMath")
    beside = join("SUBTRACT", 1.0, join("MULTIPLY", cosine, cosine))
    bell = join("POWER", math.exp(-REACH * REACH / 2), beside)
    opacity = add("ShaderNodeAttribute", attribute_name=ALPHA, attribute_type="INSTANCER")
    alpha = join("MINIMUM", join("MULTIPLY", opacity.outputs["Fac"], bell), 0.99)
    stretch = join("LENGTH", local.outputs["Vector"], kind="ShaderNodeVectorMath")
    way = join("MULTIPLY", add("ShaderNodeLightPath").outputs["Ray Length"], stretch)
    half = join("ABSOLUTE", cosine)
    began_inside = join("LESS_THAN", way, join("MULTIPLY", half, 2.0))
    past_centre = join("GREATER_THAN", way, half)
    leaves = join("MULTIPLY", geometry.outputs["Backfacing"], join("MULTIPLY", began_inside, past_centre))
    enters = join("SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    once = join("MULTIPLY", alpha, join("ADD", enters, leaves))
    color = add("ShaderNodeAttribute", attribute_name=COLOR, attribute_type="INSTANCER")
    emission, through, mix = (
        add(kind) for kind in ("ShaderNodeEmission", "ShaderNodeBsdfTransparent", "ShaderNodeMixShader")
    )
    tree.links.new(color.outputs["Color"], emission.inputs["Color"])
    tree.links.new(once, mix.inputs[0])
    tree.links.new(through.outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], add("ShaderNodeOutputMaterial").inputs["Surface"])
    return material
