"""Node group "LODGS Ellipsoids": splats as meshes that Cycles and EEVEE light, reflect and shadow.

Every splat becomes an instance of one sphere, rotated and scaled to the ellipsoid outside which its alpha is
below MIN_ALPHA. The material has the alpha of a projected Gaussian: for a ray that passes the centre at a
distance of d standard deviations, alpha is opacity * exp(-d²/2). Colours have no view dependence.
"""

from __future__ import annotations

import math

import bpy

from ..attributes import COLOR, LOOK_OPACITY, OPACITY_LOGIT, ROTATION, SCALE, WEIGHT
from .building import VERSION, Nodes, add_switched_modifier, ensure_group, is_edited

NAME = "LODGS Ellipsoids"
MATERIAL = "LODGS Ellipsoids"
MATERIAL_VERSION = 3
ALPHA = "splat_opacity"
HIDDEN = "lodgs_hides_ellipsoids"
"""Custom property of view layers: 1 makes all ellipsoids transparent, also those of instances."""
MIN_ALPHA = math.exp(-(3.0**2) / 2)
"""Alpha at the surface of an ellipsoid, 1 %. An opaque one has a radius of three standard deviations."""
BOUNCES = 512
"""Transparent bounces of Cycles.

The default of 8 leaves black holes. Ending rays at random leaves noise, and the samples that remove it take
far longer than the additional bounces.
"""


def attach(obj: bpy.types.Object) -> None:
    """Add this modifier to a splat object as the last one. The scene's render settings switch it on."""
    modifier = obj.modifiers.get(NAME)
    if modifier is None:
        add_switched_modifier(obj, ellipsoids(), show_render="lodgs_render.draws_ellipsoids")
    elif isinstance(modifier, bpy.types.NodesModifier) and (
        modifier.node_group is None or not is_edited(modifier.node_group)
    ):
        modifier.node_group = ellipsoids()  # a file of an older version has an older group


def raise_bounces(cycles: bpy.types.PropertyGroup, bounced_light_only: bool) -> None:
    """Raise Cycles' transparent bounces for rays through many ellipsoids.

    Args:
        cycles: ``Scene.cycles``.
        bounced_light_only: cameras see no ellipsoids; rays of bounced light may end at random.
    """
    cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, BOUNCES)
    if not bounced_light_only:
        cycles.min_transparent_bounces = max(cycles.min_transparent_bounces, BOUNCES)


def ellipsoids() -> bpy.types.GeometryNodeTree:
    """Return the node group."""
    return ensure_group(NAME, 4, _build)


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
        # a missing attribute means 1
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
    scale = add("ShaderNodeVectorMath", operation="SCALE")
    nodes.tree.links.new(value(attribute(SCALE, "FLOAT_VECTOR")), scale.inputs[0])
    link(((opacity / MIN_ALPHA).log() * 2.0).sqrt().socket, scale, "Scale")
    instances = add("GeometryNodeInstanceOnPoints")
    link(store.outputs["Geometry"], instances, "Points")
    link((opacity > MIN_ALPHA).socket, instances, "Selection")
    link(material.outputs["Geometry"], instances, "Instance")
    link(value(attribute(ROTATION, "QUATERNION")), instances, "Rotation")
    link(scale.outputs["Vector"], instances, "Scale")
    link(instances.outputs["Instances"], add("NodeGroupOutput"), "Geometry")


def falloff() -> bpy.types.Material:
    """Return the material of the ellipsoids. A ray gets the alpha of the Gaussian once per ellipsoid.

    All ellipsoids are images of one unit sphere. There, a ray with direction v that hits the surface at p
    passes the centre at a distance of sqrt(p² - (p·v)²). Alpha counts at the entry point. A ray that starts
    inside gets it at the exit point, if it started before the centre.
    """
    material = bpy.data.materials.get((MATERIAL, None))
    if material is not None and material.get(VERSION) == MATERIAL_VERSION:
        return material
    if material is not None:  # groups of older files keep it
        material.name = f"{MATERIAL} (older)"
    material = bpy.data.materials.new(MATERIAL)
    material[VERSION] = MATERIAL_VERSION
    if material.node_tree is None:
        material.use_nodes = True
    if hasattr(material, "surface_render_method"):
        material.surface_render_method = "BLENDED"
    material.use_backface_culling = False
    if hasattr(material, "cycles"):  # rays find the light of many small ellipsoids with less noise
        material.cycles.emission_sampling = "NONE"
    _build_falloff(material.node_tree)
    return material


def _build_falloff(tree: bpy.types.NodeTree) -> None:
    """Build the nodes of :func:`falloff`."""
    tree.nodes.clear()
    nodes = Nodes(tree)
    add = nodes.add
    geometry = add("ShaderNodeNewGeometry")
    local = add("ShaderNodeVectorTransform", vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT")
    tree.links.new(geometry.outputs["Incoming"], local.inputs["Vector"])
    direction = nodes.vector("NORMALIZE", local.outputs["Vector"])
    surface = add("ShaderNodeTexCoord").outputs["Object"]
    along = nodes.vector("DOT_PRODUCT", surface, direction)
    radius2 = nodes.vector("DOT_PRODUCT", surface, surface)
    distance2 = nodes.math("SUBTRACT", radius2, nodes.math("MULTIPLY", along, along))
    opacity = add("ShaderNodeAttribute", attribute_name=ALPHA, attribute_type="INSTANCER").outputs["Fac"]
    gaussian = nodes.math("POWER", nodes.math("DIVIDE", MIN_ALPHA, opacity), distance2)
    alpha = nodes.math("MINIMUM", nodes.math("MULTIPLY", opacity, gaussian), 0.99)
    stretch = nodes.vector("LENGTH", local.outputs["Vector"])
    length = nodes.math("MULTIPLY", add("ShaderNodeLightPath").outputs["Ray Length"], stretch)
    half_chord = nodes.math("ABSOLUTE", along)
    starts_inside = nodes.math("LESS_THAN", length, nodes.math("MULTIPLY", half_chord, 2.0))
    passed_center = nodes.math("GREATER_THAN", length, half_chord)
    exits = nodes.math(
        "MULTIPLY", geometry.outputs["Backfacing"], nodes.math("MULTIPLY", starts_inside, passed_center)
    )
    enters = nodes.math("SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    hidden = add("ShaderNodeAttribute", attribute_name=HIDDEN, attribute_type="VIEW_LAYER").outputs["Fac"]
    visible = nodes.math("SUBTRACT", nodes.math("ADD", enters, exits), hidden)
    factor = nodes.math("MULTIPLY", alpha, nodes.math("MAXIMUM", visible, 0.0))
    color = add("ShaderNodeAttribute", attribute_name=COLOR, attribute_type="INSTANCER")
    emission, transparent, mix = (
        add(kind) for kind in ("ShaderNodeEmission", "ShaderNodeBsdfTransparent", "ShaderNodeMixShader")
    )
    tree.links.new(color.outputs["Color"], emission.inputs["Color"])
    tree.links.new(factor, mix.inputs[0])
    tree.links.new(transparent.outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], add("ShaderNodeOutputMaterial").inputs["Surface"])
