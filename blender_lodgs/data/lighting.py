"""Colour of the light that lamps and the world of a Blender scene give to a point."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Vector

_MAX_PIXELS = 1 << 22
"""Number of pixels beyond which a smaller copy of an environment image determines its mean."""


def has_lamps(context: bpy.types.Context) -> bool:
    """Return True if a scene has a visible lamp, or an environment image."""
    return _environment(context.scene.world) is not None or any(
        obj.type == "LIGHT" and obj.visible_get() for obj in context.view_layer.objects
    )


def mean_light(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, position: Vector) -> np.ndarray:
    """Return the mean irradiance of a small sphere at a position, (3,) linear, without shadows.

    Light from one direction gives the sphere a quarter of the irradiance of a surface that faces the light.
    """
    total = np.pi * _world_radiance(scene.world)
    for instance in depsgraph.object_instances:
        if instance.object.type != "LIGHT":
            continue
        total += _lamp_irradiance(instance.object.data, instance.matrix_world.copy(), position) / 4
    return total


def _lamp_irradiance(lamp: bpy.types.Light, matrix, position: Vector) -> np.ndarray:
    """Return the irradiance (3,) of a surface at a position that faces a lamp, linear.

    Units are those of Blender: the strength of a sun is an irradiance, that of other lamps a flux in watts.
    """
    color = np.array(lamp.color) * lamp.energy * 2 ** getattr(lamp, "exposure", 0.0)
    if lamp.use_temperature:
        color *= lamp.temperature_color
    if not getattr(lamp, "normalize", True):
        color *= _emitting_area(lamp, matrix)
    if lamp.type == "SUN":
        return color
    offset = position - matrix.translation
    distance2 = max(offset.length_squared, 1e-6)
    cosine = -(matrix.to_3x3() @ Vector((0, 0, 1))).normalized().dot(offset.normalized())
    if lamp.type == "AREA":
        return color * max(cosine, 0.0) / (np.pi * distance2)
    if lamp.type == "SPOT" and cosine < np.cos(lamp.spot_size / 2):
        return np.zeros(3)
    return color / (4 * np.pi * distance2)


def _emitting_area(lamp: bpy.types.Light, matrix) -> float:
    """Return the area of a lamp or the solid angle of a sun, by which it is brighter without *Normalize*."""
    if lamp.type == "SUN":
        return np.pi * np.sin(lamp.angle / 2) ** 2 or 1.0
    if lamp.type != "AREA":
        return 4 * (np.pi * lamp.shadow_soft_size**2 or 1.0)
    height = lamp.size_y if lamp.shape in ("RECTANGLE", "ELLIPSE") else lamp.size
    x, y, _ = matrix.to_scale()
    return lamp.size * x * height * y * (np.pi / 4 if lamp.shape in ("DISK", "ELLIPSE") else 1)


def _world_radiance(world: bpy.types.World | None) -> np.ndarray:
    """Return the mean radiance (3,) of a world's background, linear. Other nodes are ignored."""
    if world is None:
        return np.zeros(3)
    node = _background(world)
    if node is None:
        return np.array(world.color, np.float64)
    strength = node.inputs["Strength"].default_value
    image = _environment(world)
    color = np.array(node.inputs["Color"].default_value[:3]) if image is None else _mean_color(image)
    return strength * color


def _background(world: bpy.types.World) -> bpy.types.Node | None:
    nodes = world.node_tree.nodes if world.use_nodes and world.node_tree else ()
    return next((node for node in nodes if node.bl_idname == "ShaderNodeBackground"), None)


def _environment(world: bpy.types.World | None) -> bpy.types.Image | None:
    """Return the environment image that colours a world's background."""
    node = None if world is None else _background(world)
    if node is None or not node.inputs["Color"].links:
        return None
    source = node.inputs["Color"].links[0].from_node
    return source.image if source.bl_idname == "ShaderNodeTexEnvironment" else None


def _mean_color(image: bpy.types.Image) -> np.ndarray:
    """Return the mean colour (3,) of an equirectangular image over the sphere, linear."""
    width, height = tuple(image.size)  # type: ignore[misc]
    if not width or not height:
        return np.zeros(3)
    small = image
    if width * height > _MAX_PIXELS:
        small = image.copy()  # scaling changes an image
        shrink = (width * height / _MAX_PIXELS) ** 0.5
        small.scale(max(int(width / shrink), 1), max(int(height / shrink), 1))
    columns, rows = tuple(small.size)  # type: ignore[misc]
    values = np.empty(columns * rows * 4, np.float32)
    small.pixels.foreach_get(values)
    if small != image:
        bpy.data.images.remove(small)
    weights = np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5))
    return np.average(values.reshape(rows, columns, 4)[..., :3].mean(axis=1, dtype=np.float64), 0, weights)
