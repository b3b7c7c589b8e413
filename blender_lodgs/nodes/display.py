"""Node groups that switch between Blender's own drawing of splat objects and that of LODGS.

"LODGS Display" hides Blender's drawing in viewports that LODGS draws, and turns splats into coloured points
there. It reduces a level to the corners of its bounds, because Blender would draw every hidden point. "LODGS
Native Splats" applies the level-of-detail weights and the opacity of looks where Blender 5.3 or later draws
the splats itself: its own drawing reads opacities from ``radiance:base`` only. "LODGS Viewport" drops the
harmonics in viewports that LODGS draws, because crops and rules would copy them at every change.

Before Blender 5.3 splat clouds carry the material of points. From 5.3 on they carry none, since a material
would replace the splats' own colours; the group sets it instead, or the artist's own material.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy

from .. import compat
from ..attributes import BASE, COLOR, HIGHER_SH, LOOK_OPACITY, WEIGHT
from . import ellipsoids
from .building import (
    Nodes,
    add_switched_modifier,
    ensure_group,
    is_edited,
    read_scene,
    remove_modifier,
    replace_driver,
)

NAME = "LODGS Display"
NATIVE = "LODGS Native Splats"
VIEWPORT = "LODGS Viewport"
_NAMES = NAME, NATIVE, VIEWPORT
_POINTS = "LODGS Points"
MATERIAL = "material"
_HIDE_POINTS = "Hide Points"
_BOUNDS_ONLY = "Bounds Only"
_COUNT = "lodgs_count"
"""Attribute of reduced points: the number of points before."""


def display_group() -> bpy.types.GeometryNodeTree:
    """Return the group that hides Blender's drawing: plain points, of radius 0 where LODGS draws splats.

    With *Bounds Only*, the points are the eight corners of the bounds, which *View Selected* needs.
    """
    return ensure_group(NAME, 4 if compat.NATIVE_SPLATS else 3, _build_display)


def native_group() -> bpy.types.GeometryNodeTree:
    """Return the group that multiplies opacities by level-of-detail weights and the look's opacity."""
    return ensure_group(NATIVE, 1, _build_native)


def viewport_group() -> bpy.types.GeometryNodeTree:
    """Return the group that drops the spherical harmonics above degree 0."""
    return ensure_group(VIEWPORT, 1, _build_viewport)


def attach(obj: bpy.types.Object) -> None:
    """Give a splat object its display modifiers; those of other Blender versions are replaced.

    Drivers switch them: *LODGS Display* is on in viewports that Blender does not draw, *LODGS Native Splats*
    where Blender draws the viewport or the render.
    """
    is_native = compat.make_native(obj.data)
    _set_material(obj.data, is_native)
    if _is_outdated(obj, NAME, display_group):
        modifier = add_switched_modifier(obj, display_group(), show_viewport="lodgs_viewport.hides_blender")
        if is_native:
            compat.set_input(modifier, MATERIAL, points_material())
            driver = replace_driver(obj, compat.input_path(modifier, _HIDE_POINTS), "on")
            read_scene(driver, "on", "lodgs_viewport.splats")
    if is_native and _is_outdated(obj, NATIVE, native_group):
        add_switched_modifier(
            obj,
            native_group(),
            show_viewport="lodgs_viewport.native",
            show_render="lodgs_render.draws_points",
        )
    elif not is_native:
        remove_modifier(obj, obj.modifiers.get(NATIVE))
    keep_order(obj)


def drop_harmonics(obj: bpy.types.Object) -> None:
    """Give a splat object *LODGS Viewport*, on in viewports that Blender does not draw."""
    if _is_outdated(obj, VIEWPORT, viewport_group):
        add_switched_modifier(obj, viewport_group(), show_viewport="lodgs_viewport.hides_blender")


def keep_harmonics(obj: bpy.types.Object) -> None:
    """Remove *LODGS Viewport*, so that other modifiers and Python read complete splats in viewports."""
    remove_modifier(obj, obj.modifiers.get(VIEWPORT))


def reduce_points(obj: bpy.types.Object) -> None:
    """Let viewports that LODGS draws evaluate a splat object to the corners of its bounds.

    Objects with modifiers of artists need all points: LODGS reads their splats after evaluation.
    """
    path = _bounds_path(obj)
    if path and not _has_driver(obj, path):
        read_scene(replace_driver(obj, path, "on"), "on", "lodgs_viewport.hides_points")


def keep_points(obj: bpy.types.Object) -> None:
    """Revert :func:`reduce_points`."""
    path = _bounds_path(obj)
    if path and _has_driver(obj, path):
        obj.driver_remove(path)
        compat.set_input(obj.modifiers[NAME], _BOUNDS_ONLY, False)


def is_reduced(cloud: bpy.types.PointCloud) -> bool:
    """Return True if an evaluated cloud has the corners of its bounds instead of its points."""
    return _COUNT in cloud.attributes


def point_count(cloud: bpy.types.PointCloud) -> int:
    """Return the number of points of an evaluated cloud, before :func:`reduce_points`."""
    count = cloud.attributes.get(_COUNT)
    return count.data[0].value if count is not None and len(count.data) else len(cloud.points)


def _bounds_path(obj: bpy.types.Object) -> str:
    """Return the data path of *Bounds Only*; empty without this input."""
    modifier = obj.modifiers.get(NAME)
    if modifier is None or modifier.node_group is None or not compat.has_input(modifier, _BOUNDS_ONLY):
        return ""
    return compat.input_path(modifier, _BOUNDS_ONLY)


def _has_driver(obj: bpy.types.Object, path: str) -> bool:
    return obj.animation_data is not None and obj.animation_data.drivers.find(path) is not None


@contextmanager
def with_all_attributes(context: bpy.types.Context, objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Evaluate splat objects with all points and harmonics within the block."""
    changed, settings = [obj for obj in objects if VIEWPORT in obj.modifiers], context.scene.lodgs_viewport
    all_points, settings.all_points = settings.all_points, True
    for obj in changed:
        keep_harmonics(obj)
    context.view_layer.update()
    try:
        yield
    finally:
        settings.all_points = all_points
        for obj in changed:
            drop_harmonics(obj)
            keep_order(obj)


def is_display(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier is one of this module or that of ellipsoids."""
    return modifier.name in (*_NAMES, ellipsoids.NAME)


def is_drawn_by_blender(evaluated: bpy.types.Object) -> bool:
    """Return True if viewports show an evaluated object as Blender's own splats.

    The type of an empty evaluated cloud is not reliable: Blender resets it.
    """
    modifier = evaluated.modifiers.get(NAME)
    return compat.is_native(evaluated.data) and not (modifier is not None and modifier.show_viewport)


def keep_order(obj: bpy.types.Object) -> None:
    """Move *LODGS Viewport* before the modifiers that remove splats, and the others behind them.

    Those stay before the modifier of ellipsoids.
    """
    index = obj.modifiers.find(VIEWPORT)
    if index > 0:
        obj.modifiers.move(index, 0)
    for name in (NAME, NATIVE):
        index = obj.modifiers.find(name)
        end = obj.modifiers.find(ellipsoids.NAME)
        last = len(obj.modifiers) - 1 if end < 0 else end - (index < end)
        if index >= 0 and index != last:
            obj.modifiers.move(index, last)


def points_material() -> bpy.types.Material:
    """Return the material that shows every point in its display colour, unlit; one per file."""
    material = bpy.data.materials.get((_POINTS, None))
    if material is None:
        material = bpy.data.materials.new(_POINTS)
        if material.node_tree is None:
            material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        color, emission = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeEmission")
        output = nodes.new("ShaderNodeOutputMaterial")
        color.attribute_name = COLOR
        links.new(color.outputs["Color"], emission.inputs["Color"])
        links.new(emission.outputs["Emission"], output.inputs["Surface"])
        for x, node in enumerate((color, emission, output)):
            node.location = (x * 200, 0)
    return material


def _set_material(cloud: bpy.types.PointCloud, is_native: bool) -> None:
    """Add the points material to a cloud, or remove it if Blender draws splats; other materials stay."""
    names = [material.name if material else "" for material in cloud.materials]
    own = [name.partition(".")[0] for name in names] == [_POINTS]  # appended ones have a number
    if is_native and own:
        cloud.materials.clear()
    elif not is_native and not cloud.materials:
        cloud.materials.append(points_material())


def _is_outdated(obj: bpy.types.Object, name: str, current) -> bool:
    """Remove a modifier with the group of another version; return True if the object needs a new one."""
    modifier = obj.modifiers.get(name)
    if modifier is None:
        return True
    tree = modifier.node_group
    if tree is not None and (is_edited(tree) or tree == current()):
        return False
    remove_modifier(obj, modifier)
    return True


def _build_display(nodes: Nodes) -> None:
    nodes.tree.interface.new_socket(_BOUNDS_ONLY, in_out="INPUT", socket_type="NodeSocketBool")
    if compat.NATIVE_SPLATS:
        nodes.tree.interface.new_socket(_HIDE_POINTS, in_out="INPUT", socket_type="NodeSocketBool")
        nodes.tree.interface.new_socket(MATERIAL, in_out="INPUT", socket_type="NodeSocketMaterial")
    source = nodes.add("NodeGroupInput")
    points = source.outputs[0]
    radius = nodes.add("GeometryNodeSetPointRadius")
    if compat.NATIVE_SPLATS:
        kind = nodes.add("GeometryNodePointsSetType")
        kind.inputs["Type"].default_value = "Points"
        nodes.link(points, kind, "Points")
        nodes.link(source.outputs[_HIDE_POINTS], radius, "Selection")
        material = nodes.add("GeometryNodeSetMaterial")
        nodes.link(kind.outputs[0], material, "Geometry")
        nodes.link(source.outputs[MATERIAL], material, "Material")
        points = material.outputs["Geometry"]
    radius.inputs["Radius"].default_value = 0.0
    nodes.link(points, radius, "Points")
    switch = nodes.add("GeometryNodeSwitch", input_type="GEOMETRY")
    nodes.link(source.outputs[_BOUNDS_ONLY], switch, "Switch")
    nodes.link(radius.outputs["Points"], switch, "False")
    nodes.link(_bounds(nodes, source.outputs[0]), switch, "True")
    nodes.link(switch.outputs["Output"], nodes.add("NodeGroupOutput"), "Geometry")


def _bounds(nodes: Nodes, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Return the corners of the bounds as points of radius 0, with the number of points."""
    box, corners = nodes.add("GeometryNodeBoundBox"), nodes.add("GeometryNodeMeshToPoints")
    if "Use Radius" in box.inputs:
        box.inputs["Use Radius"].default_value = False
    corners.inputs["Radius"].default_value = 0.0
    size = nodes.add("GeometryNodeAttributeDomainSize", component="POINTCLOUD")
    store = nodes.add("GeometryNodeStoreNamedAttribute", data_type="INT", domain="POINT")
    store.inputs["Name"].default_value = _COUNT
    nodes.link(points, box, "Geometry")
    nodes.link(box.outputs["Bounding Box"], corners, "Mesh")
    nodes.link(points, size, "Geometry")
    nodes.link(corners.outputs[0], store, "Geometry")
    nodes.link(size.outputs["Point Count"], store, "Value")
    return store.outputs["Geometry"]


def _build_viewport(nodes: Nodes) -> None:
    remove = nodes.add("GeometryNodeRemoveAttribute")
    if "Pattern Mode" in remove.inputs:
        remove.inputs["Pattern Mode"].default_value = "Wildcard"
    else:
        remove.pattern_mode = "WILDCARD"
    remove.inputs["Name"].default_value = HIGHER_SH
    nodes.link(nodes.add("NodeGroupInput").outputs[0], remove, "Geometry")
    nodes.link(remove.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")


def _build_native(nodes: Nodes) -> None:
    base = nodes.add("GeometryNodeInputNamedAttribute", data_type="FLOAT_COLOR")
    base.inputs["Name"].default_value = BASE
    channels = nodes.add("FunctionNodeSeparateColor")
    nodes.link(next(s for s in base.outputs if s.enabled), channels, "Color")
    opacity = nodes.field(channels.outputs["Alpha"])
    for name in (WEIGHT, LOOK_OPACITY):
        factor = nodes.add("GeometryNodeInputNamedAttribute", data_type="FLOAT")
        factor.inputs["Name"].default_value = name
        value = nodes.field(next(s for s in factor.outputs if s.name == "Attribute" and s.enabled))
        opacity = opacity * nodes.field(factor.outputs["Exists"]).where(value, 1.0)
    color = nodes.add("FunctionNodeCombineColor")
    for channel in ("Red", "Green", "Blue"):
        nodes.link(channels.outputs[channel], color, channel)
    nodes.link(opacity.socket, color, "Alpha")
    store = nodes.add("GeometryNodeStoreNamedAttribute", data_type="FLOAT_COLOR", domain="POINT")
    store.inputs["Name"].default_value = BASE
    nodes.link(nodes.add("NodeGroupInput").outputs[0], store, "Geometry")
    nodes.link(color.outputs["Color"], store, "Value")
    nodes.link(store.outputs["Geometry"], nodes.add("NodeGroupOutput"), "Geometry")
