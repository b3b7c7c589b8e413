"""Splats and points in their own colours in Solid shading, where Blender draws every point cloud in one grey.

Each is a flat disc of its radius just in front of the ball that Blender draws, so that other objects hide it
and are hidden by it as usual. Where the viewport colours by object, at random or in one colour, that is left
as it is.
"""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from mathutils import Matrix, Vector

from .. import attributes

Color = tuple[float, float, float, float]

_VERTEX = """
void main()
{
  vec4 clip = model_view_projection * vec4(position, 1.0);
  vec4 front = clip + color_radius.w * toward;
  gl_Position = vec4(clip.xy, front.z / max(front.w, 1e-6) * clip.w, clip.w);
  gl_PointSize = color_radius.w * pixels / clip.w + 2.0; // a pixel around, for the ball's outline
  // The level's colour (sRGB) in the lightness of the point's (linear), so that the scene stays readable.
  float lightness = pow(dot(color_radius.rgb, vec3(1.0 / 3.0)), 1.0 / 2.2);
  color = mix(color_radius.rgb, pow((0.35 + 0.65 * lightness) * tint.rgb, vec3(2.2)), tint.a);
}
"""
_FRAGMENT = """
void main()
{
  vec2 place = 2.0 * gl_PointCoord - 1.0;
  if (dot(place, place) > 1.0) {
    discard;
  }
  shown = vec4(color, 1.0);
}
"""

_shader: gpu.types.GPUShader | None = None
_batches: dict[int, gpu.types.GPUBatch] = {}
"""Points on the graphics card, by their object's ``session_uid``; they stay until the object changes."""


def draw(
    objects: list[tuple[bpy.types.Object, Color]],
    depsgraph: bpy.types.Depsgraph,
    view: Matrix,
    projection: Matrix,
    height: int,
) -> None:
    """Draws point clouds as their modifiers leave them into the active framebuffer, tested against its depth.

    Args:
        objects: point clouds, each with the colour (sRGB) in which to show it; alpha 0 is each point's own.
        view, projection: from the world to the camera's space, and on to clip space.
        height: of the framebuffer in pixels.
    """
    shader = _disc_shader()
    shader.bind()
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    gpu.state.program_point_size_set(True)
    for obj, tint in objects:
        batch = _batches.get(obj.session_uid)
        if batch is None:
            batch = _batches[obj.session_uid] = _upload(obj.evaluated_get(depsgraph).data)
        scale = obj.matrix_world.median_scale
        shader.uniform_float("model_view_projection", projection @ view @ obj.matrix_world)
        shader.uniform_float("toward", projection @ Vector((0, 0, scale, 0)))
        shader.uniform_float("tint", tint)
        shader.uniform_float("pixels", abs(projection[1][1]) * scale * height)
        batch.draw(shader)
    gpu.state.program_point_size_set(False)
    gpu.state.depth_mask_set(False)
    gpu.state.depth_test_set("NONE")


def _upload(cloud: bpy.types.PointCloud) -> gpu.types.GPUBatch:
    """A batch of positions, colours and radii, those of an evaluated point cloud."""
    count = len(cloud.points)
    color_radius = np.ones((count, 4), np.float32)
    colors, radii = (
        attributes.read_attribute(cloud, attributes.COLOR),
        attributes.read_attribute(cloud, attributes.RADIUS),
    )
    if colors is not None:
        color_radius[:, :3] = colors[:, :3]
    if radii is not None:
        color_radius[:, 3] = radii
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="position", comp_type="F32", len=3, fetch_mode="FLOAT")
    layout.attr_add(id="color_radius", comp_type="F32", len=4, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, count)
    if count:
        vertices.attr_fill("position", attributes.read_attribute(cloud, "position"))
        vertices.attr_fill("color_radius", color_radius)
    return gpu.types.GPUBatch(type="POINTS", buf=vertices)


def _disc_shader() -> gpu.types.GPUShader:
    global _shader
    if _shader is None:
        between = gpu.types.GPUStageInterfaceInfo("lodgs_disc")
        between.smooth("VEC3", "color")
        info = gpu.types.GPUShaderCreateInfo()
        info.push_constant("MAT4", "model_view_projection")
        info.push_constant("VEC4", "toward")
        info.push_constant("VEC4", "tint")
        info.push_constant("FLOAT", "pixels")
        info.vertex_in(0, "VEC3", "position")
        info.vertex_in(1, "VEC4", "color_radius")
        info.vertex_out(between)
        info.fragment_out(0, "VEC4", "shown")
        info.vertex_source(_VERTEX)
        info.fragment_source(_FRAGMENT)
        _shader = gpu.shader.create_from_info(info)
    return _shader


def on_update(depsgraph: bpy.types.Depsgraph) -> None:
    """Frees what has changed; what was deleted goes with all the rest."""
    if depsgraph.id_type_updated("COLLECTION"):
        _batches.clear()
    elif _batches:
        for update in depsgraph.updates:
            if update.is_updated_geometry:
                _batches.pop(update.id.original.session_uid, None)


def clear() -> None:
    """Frees what is kept between drawings."""
    global _shader
    _batches.clear()
    _shader = None
