"""Coloured points in Solid shading; Blender draws all point clouds in grey there.

Each point is a flat disc of its radius just in front of Blender's sphere, so that occlusion works as usual.
The viewport's Object, Random and Single colour modes stay unchanged.
"""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from mathutils import Matrix, Vector

from .. import attributes

Color = tuple[float, float, float, float]
Points = tuple[bpy.types.Object, Matrix, Color]
"""Point cloud, its transform in the world, and its tint (sRGB); alpha 0 keeps the points' own colours."""

_VERTEX = """
void main()
{
  vec4 clip = model_view_projection * vec4(position, 1.0);
  vec4 front = clip + color_radius.w * toward;
  gl_Position = vec4(clip.xy, front.z / max(front.w, 1e-6) * clip.w, clip.w);
  gl_PointSize = color_radius.w * pixels / clip.w + 2.0; // one more pixel covers the sphere's outline
  // The tint (sRGB) gets the lightness of the point's colour (linear) to keep the scene readable.
  float lightness = pow(dot(color_radius.rgb, vec3(1.0 / 3.0)), 1.0 / 2.2);
  color = mix(color_radius.rgb, pow((0.35 + 0.65 * lightness) * tint.rgb, vec3(2.2)), tint.a);
}
"""
_FRAGMENT = """
void main()
{
  vec2 disc_position = 2.0 * gl_PointCoord - 1.0;
  if (dot(disc_position, disc_position) > 1.0) {
    discard;
  }
  result = vec4(color, 1.0);
}
"""

_shader: gpu.types.GPUShader | None = None
_batches: dict[int, gpu.types.GPUBatch] = {}
"""Uploaded points by the ``session_uid`` of their object, valid until the object changes."""


def draw(
    clouds: list[Points],
    depsgraph: bpy.types.Depsgraph,
    view: Matrix,
    projection: Matrix,
    height: int,
) -> None:
    """Draw evaluated point clouds into the active framebuffer, tested against its depth.

    Args:
        clouds: point clouds or instances of them.
        view, projection: matrices from the world to camera space, and from there to clip space.
        height: height of the framebuffer in pixels.
    """
    shader = _disc_shader()
    shader.bind()
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    gpu.state.program_point_size_set(True)
    for obj, matrix, tint in clouds:
        batch = _batches.get(obj.session_uid)
        if batch is None:
            batch = _batches[obj.session_uid] = _upload(obj.evaluated_get(depsgraph).data)
        scale = matrix.median_scale
        shader.uniform_float("model_view_projection", projection @ view @ matrix)
        shader.uniform_float("toward", projection @ Vector((0, 0, scale, 0)))
        shader.uniform_float("tint", tint)
        shader.uniform_float("pixels", abs(projection[1][1]) * scale * height)
        batch.draw(shader)
    gpu.state.program_point_size_set(False)
    gpu.state.depth_mask_set(False)
    gpu.state.depth_test_set("NONE")


def _upload(cloud: bpy.types.PointCloud) -> gpu.types.GPUBatch:
    """Upload the positions, colours and radii of an evaluated point cloud."""
    count = len(cloud.points)
    color_radius = np.ones((count, 4), np.float32)
    colors = attributes.read_attribute(cloud, attributes.COLOR)
    radii = attributes.read_attribute(cloud, attributes.RADIUS)
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
        interface = gpu.types.GPUStageInterfaceInfo("lodgs_disc")
        interface.smooth("VEC3", "color")
        info = gpu.types.GPUShaderCreateInfo()
        info.push_constant("MAT4", "model_view_projection")
        info.push_constant("VEC4", "toward")
        info.push_constant("VEC4", "tint")
        info.push_constant("FLOAT", "pixels")
        info.vertex_in(0, "VEC3", "position")
        info.vertex_in(1, "VEC4", "color_radius")
        info.vertex_out(interface)
        info.fragment_out(0, "VEC4", "result")
        info.vertex_source(_VERTEX)
        info.fragment_source(_FRAGMENT)
        _shader = gpu.shader.create_from_info(info)
    return _shader


def on_update(depsgraph: bpy.types.Depsgraph) -> None:
    """Free the uploads of changed objects; all of them if a collection changed, as objects may be deleted."""
    if depsgraph.id_type_updated("COLLECTION"):
        _batches.clear()
    elif _batches:
        for update in depsgraph.updates:
            if update.is_updated_geometry:
                _batches.pop(update.id.original.session_uid, None)


def clear() -> None:
    """Free all uploads and the shader."""
    global _shader
    _batches.clear()
    _shader = None
