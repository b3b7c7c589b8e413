"""GLSL sources and creation of the shaders that draw splats; shaders and constant textures are cached."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gpu
import numpy as np

from ...training.editing.clutter import KINDS
from ...training.lod.crop import FACE_SQUARED
from ...training.splats.level_colors import LEVEL_COLORS
from .arrangement import WIDTH

MARK_COLORS = ((1.0, 0.45, 0.05), *(kind.color for kind in KINDS.values()), (0.5, 0.5, 0.5))
"""Colours of marked splats, sRGB, see ``cleaning.displayed_marks``: selected ones, clutter, other splats."""

MAX_TEXTURES = 8
"""Maximum number of textures for records."""
BLOCK = 1024
"""Number of splats per instance of the quads: drivers draw small instances slowly, software by far."""
COMPACT = 6.0
"""Squared radius of compact splats in standard deviations. The integral of (1 - r^2 / 6)^2 is that of a
Gaussian."""

_FETCH = """
vec4 texel(sampler2D data, int i) { return texelFetch(data, ivec2(i % WIDTH, i / WIDTH), 0); }
"""
_PROJECT_FRAGMENT = """
// SH coefficient k of a record, see ``records``.
vec3 coefficient(int k, ivec2 record)
{
  int start = 11 + 3 * k;
  vec4 a = record_texel(record, start / 4);
  int part = start % 4;
  if (part == 0) { return a.xyz; }
  if (part == 1) { return a.yzw; }
  vec4 b = record_texel(record, start / 4 + 1);
  return part == 2 ? vec3(a.zw, b.x) : vec3(a.w, b.xy);
}

vec3 view_color(ivec2 record, vec3 base, vec3 d)
{
  vec3 c = 0.5 + 0.28209479177387814 * base;
  if (degree >= 1) {
    c += 0.4886025119029199 * (d.z * coefficient(2, record) - d.y * coefficient(1, record)
                               - d.x * coefficient(3, record));
  }
  if (degree >= 2) {
    vec3 q = d * d;
    c += 1.0925484305920792 * (d.x * d.y * coefficient(4, record) - d.y * d.z * coefficient(5, record)
                               - d.x * d.z * coefficient(7, record));
    c += 0.31539156525252005 * (2.0 * q.z - q.x - q.y) * coefficient(6, record);
    c += 0.5462742152960396 * (q.x - q.y) * coefficient(8, record);
    if (degree >= 3) {
      c -= 0.5900435899266435 * (d.y * (3.0 * q.x - q.y) * coefficient(9, record)
                                 + d.x * (q.x - 3.0 * q.y) * coefficient(15, record));
      c += 2.890611442640554 * d.x * d.y * d.z * coefficient(10, record);
      c -= 0.4570457994644658 * (4.0 * q.z - q.x - q.y)
           * (d.y * coefficient(11, record) + d.x * coefficient(13, record));
      c += 0.3731763325901154 * d.z * (2.0 * q.z - 3.0 * q.x - 3.0 * q.y) * coefficient(12, record);
      c += 1.445305721320277 * d.z * (q.x - q.y) * coefficient(14, record);
    }
    if (degree >= 4) {
      c += 2.5033429417967046 * d.x * d.y * (q.x - q.y) * coefficient(16, record);
      c -= 1.7701307697799304 * d.z * (d.y * (3.0 * q.x - q.y) * coefficient(17, record)
                                       + d.x * (q.x - 3.0 * q.y) * coefficient(23, record));
      c += 0.9461746957575601 * d.x * d.y * (7.0 * q.z - 1.0) * coefficient(18, record);
      c -= 0.6690465435572892 * d.z * (7.0 * q.z - 3.0)
           * (d.y * coefficient(19, record) + d.x * coefficient(21, record));
      c += 0.10578554691520431 * (q.z * (35.0 * q.z - 30.0) + 3.0) * coefficient(20, record);
      c += 0.47308734787878004 * (q.x - q.y) * (7.0 * q.z - 1.0) * coefficient(22, record);
      c += 0.6258357354491761 * (q.x * (q.x - 3.0 * q.y) - q.y * (3.0 * q.x - q.y))
           * coefficient(24, record);
    }
  }
  return c;
}

void main()
{
  center_reach = axes = color_opacity = vec4(0.0);  // not drawn unless set below

  // slot, weight, placement plus 1 - 1 / enlargement, level for the colour (0: own colour, below 0: mark)
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  vec4 instance = texel(instances, pixel.y * WIDTH + pixel.x);
  int slot = int(instance.x), row = int(instance.z) * 5;
  ivec2 record = ivec2(slot / part_size, slot % part_size * texels);
  vec4 mean = record_texel(record, 0);
  float opacity = mean.w * instance.y;
  mean.w = 1.0;
  vec4 filtered = texel(placements, row + 4);  // variance, uncompensated part, range of looks
  mat3 look = mat3(1.0);
  for (int i = int(filtered.z); i < int(filtered.w); i++) {  // see ``splats._looks_texture``
    int at = 6 * i;
    vec4 red = texel(looks, at + 3), green = texel(looks, at + 4), blue = texel(looks, at + 5);
    vec3 local = vec3(dot(texel(looks, at), mean), dot(texel(looks, at + 1), mean),
                      dot(texel(looks, at + 2), mean));
    local *= local;
    float crop_distance = green.w > 0.0 ? local.x + local.y + local.z : max(local.x, max(local.y, local.z));
    if ((crop_distance <= FACE) != (blue.w > 0.0)) {
      look = transpose(mat3(red.xyz, green.xyz, blue.xyz)) * look;
      opacity *= red.w;
    }
  }
  if (opacity <= 1.0 / 255.0) {
    return;
  }
  vec4 to_view_x = texel(placements, row), to_view_y = texel(placements, row + 1);
  vec4 to_view_z = texel(placements, row + 2), camera = texel(placements, row + 3);
  vec3 position = vec3(dot(to_view_x, mean), dot(to_view_y, mean), dot(to_view_z, mean));
  vec4 clip = projection * vec4(position, 1.0);
  if (clip.w <= 0.0 || abs(clip.z) >= clip.w) {
    return;
  }

  // Jacobian of the projection (in pixels) times the root of the covariance: rotation, then scales.
  vec3 ndc = clip.xyz / clip.w;
  vec2 center = 0.5 * (frame.xy + frame.zw), limit = 1.3 * (frame.zw - center);
  vec2 clamped = clamp(ndc.xy, center - limit, center + limit);
  mat4 rows = transpose(projection);
  vec3 by_x = (rows[0].xyz - clamped.x * rows[3].xyz) * (0.5 * size.x / clip.w);
  vec3 by_y = (rows[1].xyz - clamped.y * rows[3].xyz) * (0.5 * size.y / clip.w);
  vec4 q = record_texel(record, 1);  // w, x, y, z
  vec4 s = record_texel(record, 2);  // scales, and the first number of the colour
  s.xyz /= 1.0 - fract(instance.z);
  mat3 turn = mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 to_view = transpose(mat3(to_view_x.xyz, to_view_y.xyz, to_view_z.xyz));
  mat3 half_covariance = to_view * turn * mat3(s.x, 0.0, 0.0, 0.0, s.y, 0.0, 0.0, 0.0, s.z);
  vec3 row_x = by_x * half_covariance, row_y = by_y * half_covariance;
  float xx = dot(row_x, row_x) + filtered.x, xy = dot(row_x, row_y), yy = dot(row_y, row_y) + filtered.x;
  if (filtered.y < filtered.x) {
    vec3 area = cross(row_x, row_y);
    float squared_area = dot(area, area), trace = xx + yy - 2.0 * filtered.x;
    opacity *= sqrt((squared_area + filtered.y * (trace + filtered.y))
                    / (squared_area + filtered.x * (trace + filtered.x)));
    if (opacity <= 1.0 / 255.0) {
      return;
    }
  }

  // Ellipse where alpha falls to 1/255, from its principal axes.
  float middle = 0.5 * (xx + yy);
  float spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-6 * middle ? normalize(vec2(xy, middle + spread - xx))
                                      : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float longer = sqrt(middle + spread), shorter = sqrt(max(middle - spread, filtered.x));
  float reach = sqrt(2.0 * log(255.0 * opacity));
  center_reach = vec4(ndc, reach);
  axes = vec4(longer * axis, shorter * vec2(-axis.y, axis.x)) * reach * 2.0 / size.xyxy;

  vec3 base = vec3(s.w, record_texel(record, 3).xy);
  vec3 color = max(look * view_color(record, base, normalize(mean.xyz * camera.w - camera.xyz)), 0.0);
  if (instance.w != 0.0) {  // keep the lightness to keep the scene readable
    float lightness = 0.35 + 0.65 * min(dot(color, vec3(1.0 / 3.0)), 1.0);
    int entry = instance.w < 0.0 ? PALETTE - 1 - int(instance.w) : int(instance.w - 1.0) % PALETTE;
    color = lightness * texelFetch(palette, ivec2(entry, 0), 0).rgb;
  }
  color_opacity = vec4(color, opacity);
}
"""
"""Project one splat per pixel: its centre, the half axes of its quad, its colour and opacity."""
_SPLAT_VERTEX = (
    _FETCH
    + """
void main()
{
  int splat = gl_InstanceID * BLOCK + int(corner.z);
  vec4 center = texel(centers, splat), half_axes = texel(axes, splat);
  vec2 position = corner.xy;
#ifdef COMPACT
  position *= min(1.0, sqrt(COMPACT) / center.w);
#endif
  position_in_sigmas = position * center.w;
  color_opacity = texel(colors, splat);
  gl_Position = vec4(center.xy + position.x * half_axes.xy + position.y * half_axes.zw, center.z, 1.0);
}
"""
)
_SPLAT_FRAGMENT = """
void main()
{
  float squared = dot(position_in_sigmas, position_in_sigmas);
#ifdef COMPACT
  float falloff = max(1.0 - squared / COMPACT, 0.0);
  falloff *= falloff;
#else
  float falloff = exp(-0.5 * squared);
#endif
  float alpha = min(0.99, color_opacity.a * falloff);
  if (alpha < 1.0 / 255.0) {
    discard;
  }
  result = vec4(color_opacity.rgb * alpha, alpha);
}
"""
_COPY_VERTEX = """
void main()
{
  shift = corner.z;
  gl_Position = vec4(corner.xy, 0.0, 1.0);
}
"""
_COPY_FRAGMENT = (
    _FETCH
    + """
void main() { copied = texel(source, int(gl_FragCoord.x) + int(shift)); }
"""
)
_SCREEN_VERTEX = """
void main()
{
  texture_position = 0.5 * corner + 0.5;
  gl_Position = vec4(corner, 0.0, 1.0);
}
"""
_DEPTH_FRAGMENT = """
// At a lower resolution, the farthest texel of a pixel: thin lines of the grid would hide whole pixels.
void main()
{
  vec2 position = texture_position * vec2(textureSize(depth, 0)), step = fwidth(position);
  ivec2 end = max(ivec2(round(step)), ivec2(1));
  ivec2 first = ivec2(position - 0.5 * vec2(end - 1));
  gl_FragDepth = 0.0;
  for (int y = 0; y < end.y; y++) {
    for (int x = 0; x < end.x; x++) {
      gl_FragDepth = max(gl_FragDepth, texelFetch(depth, first + ivec2(x, y), 0).r);
    }
  }
  result = vec4(0.0);
}
"""
_COMPOSITE_FRAGMENT = """
vec3 linear(vec3 code)
{
  return mix(pow((code + 0.055) / 1.055, vec3(2.4)), code / 12.92, step(code, vec3(0.04045)));
}

// Colour below a partly covering overlay: that of the nearest pixel without an overlay.
vec3 color_below(ivec2 pixel, vec3 fallback)
{
  ivec2 size = textureSize(overlay, 0);
  for (int radius = 2; radius <= 8; radius *= 2) {
    for (int i = 0; i < 9; i++) {
      ivec2 nearby = clamp(pixel + radius * ivec2(i % 3 - 1, i / 3 - 1), ivec2(0), size - 1);
      vec4 neighbor = texelFetch(overlay, nearby, 0);
      if (neighbor.a == 0.0) {
        return linear(neighbor.rgb);
      }
    }
  }
  return fallback;
}

// Blender composites the linear buffer (gamma 2.2) over the scene, but splats blend in display space:
// d = s + (1 - a) b. The output matches that over black (b = 0) and, averaged over the channels, over white
// (b = 1). The buffer already has the overlays and the background (alpha 0). Blending fades the background
// and would fade thin overlays with it, so those are added again.
void main()
{
  vec4 splats = texture(colors, texture_position);
  vec3 black = pow(clamp(splats.rgb, 0.0, 1.0), vec3(2.2));
  vec3 white = pow(clamp(splats.rgb + 1.0 - splats.a, 0.0, 1.0), vec3(2.2));
  float alpha = 1.0 - dot(white - black, vec3(1.0 / 3.0));

  ivec2 pixel = ivec2(texture_position * vec2(textureSize(overlay, 0)));
  vec4 covering = texelFetch(overlay, pixel, 0);
  float uncovered = 1.0 - covering.a;
  vec3 added = vec3(0.0);
  if (covering.a > 0.0 && covering.a < 1.0) {
    added = linear(covering.rgb);
    added -= color_below(pixel, added);
  }
  result = uncovered * vec4(black + alpha * added, alpha);
}
"""


_cache: dict[str, Any] = {}
"""Shaders with their quads, and constant textures, by name."""


def clear() -> None:
    """Free the cached shaders and textures."""
    _cache.clear()


def cached(name: str, create: Callable[[], Any]) -> Any:
    """Return a cached resource; create it on first use."""
    if name not in _cache:
        _cache[name] = create()
    return _cache[name]


def is_cached(name: str) -> bool:
    """Return True if a resource exists."""
    return name in _cache


def bind_textures(shader: gpu.types.GPUShader, textures: dict[str, gpu.types.GPUTexture]) -> None:
    """Bind textures to samplers, given in the order of their slots.

    Under OpenGL, Blender 5.3 also binds every texture to slot 0, so that one has to come last.
    """
    for name, texture in reversed(textures.items()):
        shader.uniform_sampler(name, texture)


def program(name: str) -> tuple[gpu.types.GPUShader, gpu.types.GPUBatch]:
    """Return the cached shader "splats", "compact_splats", "depth" or "composite", with its batch."""
    return cached(name, lambda: (_SHADERS[name](), _triangles() if name.endswith("splats") else _quad()))


def projection_shader(textures: int) -> tuple[gpu.types.GPUShader, gpu.types.GPUBatch]:
    """Return the cached shader that projects splats from a number of textures, with its quad.

    Each number has a shader, because software rendering samples all textures of a shader for every texel.
    """
    return cached(f"project_{textures}", lambda: (_projection_shader(textures), _quad()))


def copy_shader() -> gpu.types.GPUShader:
    """Return the cached shader that copies texels between textures."""
    return cached("copy", _copy_shader)


def palette() -> gpu.types.GPUTexture:
    """Return the cached texture of level colours and then of marks."""

    def create() -> gpu.types.GPUTexture:
        colors = np.ones((len(LEVEL_COLORS) + len(MARK_COLORS), 4), np.float32)
        colors[:, :3] = *LEVEL_COLORS, *MARK_COLORS
        data = gpu.types.Buffer("FLOAT", colors.size, colors.reshape(-1))
        return gpu.types.GPUTexture((len(colors), 1), format="RGBA32F", data=data)

    return cached("palette", create)


def empty_texture() -> gpu.types.GPUTexture:
    """Return a cached transparent texture of one pixel."""
    return cached(
        "empty",
        lambda: gpu.types.GPUTexture((1, 1), format="RGBA8", data=gpu.types.Buffer("FLOAT", 4, [0.0] * 4)),
    )


def _quad() -> gpu.types.GPUBatch:
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=2, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, 4)
    vertices.attr_fill("corner", np.float32([(-1, -1), (1, -1), (-1, 1), (1, 1)]))
    return gpu.types.GPUBatch(type="TRI_STRIP", buf=vertices)


def _triangles() -> gpu.types.GPUBatch:
    """Return triangles around the unit circle for BLOCK splats; third values are the splats' numbers."""
    corners = np.empty((BLOCK, 3, 3), np.float32)
    corners[..., :2] = (0, 2), (-(3**0.5), -1), (3**0.5, -1)
    corners[..., 2] = np.arange(BLOCK)[:, None]
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=3, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, 3 * BLOCK)
    vertices.attr_fill("corner", corners.reshape(-1, 3))
    return gpu.types.GPUBatch(type="TRIS", buf=vertices)


def _projection_shader(textures: int) -> gpu.types.GPUShader:
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "corner")
    for slot, name in enumerate(("center_reach", "axes", "color_opacity")):
        info.fragment_out(slot, "VEC4", name)
    parts = [f"records_{part}" for part in range(textures)]
    for slot, name in enumerate(("instances", "placements", "looks", "palette", *parts)):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("WIDTH", str(WIDTH))
    info.define("PALETTE", str(len(LEVEL_COLORS)))
    info.define("FACE", repr(FACE_SQUARED))
    info.push_constant("MAT4", "projection")
    info.push_constant("VEC4", "frame")
    info.push_constant("VEC2", "size")
    info.push_constant("INT", "degree")
    info.push_constant("INT", "texels")
    info.push_constant("INT", "part_size")
    read_texel = "".join(
        f"  if (record.x == {part}) {{ return texel({name}, record.y + i); }}\n"
        for part, name in enumerate(parts[:-1])
    )
    read_texel += f"  return texel({parts[-1]}, record.y + i);\n"
    interface = gpu.types.GPUStageInterfaceInfo("lodgs_project")
    interface.smooth("VEC2", "texture_position")
    return _create(
        info, interface, _SCREEN_VERTEX,
        f"{_FETCH}\n// Texel of a record, which is given by texture number and first texel.\n"
        f"vec4 record_texel(ivec2 record, int i)\n{{\n{read_texel}}}\n{_PROJECT_FRAGMENT}",
    )  # fmt: skip


def _splat_shader(compact: bool = False) -> gpu.types.GPUShader:
    interface = gpu.types.GPUStageInterfaceInfo("lodgs_splats")
    interface.smooth("VEC2", "position_in_sigmas")
    interface.flat("VEC4", "color_opacity")
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "corner")
    info.fragment_out(0, "VEC4", "result")
    for slot, name in enumerate(("centers", "axes", "colors")):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("WIDTH", str(WIDTH))
    info.define("BLOCK", str(BLOCK))
    if compact:
        info.define("COMPACT", str(COMPACT))
    return _create(info, interface, _SPLAT_VERTEX, _SPLAT_FRAGMENT)


def _copy_shader() -> gpu.types.GPUShader:
    interface = gpu.types.GPUStageInterfaceInfo("lodgs_copy")
    interface.flat("FLOAT", "shift")
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "corner")
    info.fragment_out(0, "VEC4", "copied")
    info.sampler(0, "FLOAT_2D", "source")
    info.define("WIDTH", str(WIDTH))
    return _create(info, interface, _COPY_VERTEX, _COPY_FRAGMENT)


def _depth_shader() -> gpu.types.GPUShader:
    info, interface = _shader_info("depth")
    interface.smooth("VEC2", "texture_position")
    info.sampler(0, "FLOAT_2D", "depth")
    info.depth_write("ANY")
    return _create(info, interface, _SCREEN_VERTEX, _DEPTH_FRAGMENT)


def _composite_shader() -> gpu.types.GPUShader:
    info, interface = _shader_info("composite")
    interface.smooth("VEC2", "texture_position")
    info.sampler(0, "FLOAT_2D", "colors")
    info.sampler(1, "FLOAT_2D", "overlay")
    return _create(info, interface, _SCREEN_VERTEX, _COMPOSITE_FRAGMENT)


_SHADERS = {
    "splats": _splat_shader,
    "compact_splats": partial(_splat_shader, compact=True),
    "depth": _depth_shader,
    "composite": _composite_shader,
}


def _shader_info(name: str) -> tuple[gpu.types.GPUShaderCreateInfo, gpu.types.GPUStageInterfaceInfo]:
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "corner")
    info.fragment_out(0, "VEC4", "result")
    return info, gpu.types.GPUStageInterfaceInfo(f"lodgs_{name}")


def _create(
    info: gpu.types.GPUShaderCreateInfo,
    interface: gpu.types.GPUStageInterfaceInfo,
    vertex: str,
    fragment: str,
) -> gpu.types.GPUShader:
    info.vertex_out(interface)
    info.vertex_source(vertex)
    info.fragment_source(fragment)
    return gpu.shader.create_from_info(info)
