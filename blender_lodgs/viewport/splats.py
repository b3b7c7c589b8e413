"""True Gaussians in a framebuffer: the shaders that draw splats which are on the graphics card.

What a pixel shows is that of ``docs/rasterizer.md``; splats are blended back to front in half floats, in
display space as the photographs are, in an offscreen buffer of their own. A splat is hidden where what is
already drawn lies nearer than its mean. The result is composited into the active framebuffer, which is
linear, beneath overlays that are there already.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gpu
import numpy as np
from mathutils import Matrix

from ...training.editing.look import Looks
from ...training.lod.colors import LEVEL_COLORS
from ...training.lod.crop import FACE_SQUARED
from .arranging import WIDTH, Arrangement

MOST_COEFFICIENTS = 24
"""Coefficients beyond the first: degree 4."""

SELECTED = (1.0, 0.45, 0.05)
"""The colour of what is selected, sRGB."""

PARTS = 8
"""Textures that splats' records are in at most: a driver may take long for one that holds them all."""

DILATION, MIP_FILTER = (0.3, 0.0), (0.1, 1.0)
"""Variance added to projected splats, in square pixels, and whether their opacity pays for it: 3DGS's, and
Mip-Splatting's 2D filter."""

Frame = tuple[float, float, float, float]
WHOLE: Frame = (-1.0, -1.0, 1.0, 1.0)
"""Left, bottom, right and top of all that is drawn, in clip space."""

_FETCH = """
vec4 texel(sampler2D data, int i) { return texelFetch(data, ivec2(i % WIDTH, i / WIDTH), 0); }
"""
_STORED = (
    "vec4 stored(ivec2 record, int i)\n{\n"
    + "".join(
        f"  if (record.x == {part}) {{ return texel(records_{part}, record.y + i); }}\n"
        for part in range(PARTS)
    )
    + "  return vec4(0.0);\n}\n"
)
"""A texel of a record, which is the number of its texture and its first texel there."""
_VERTEX = (
    _FETCH
    + _STORED
    + """
// Three floats of a splat's record, as ``resident.read_records`` makes them.
vec3 coefficient(int k, ivec2 record)
{
  int start = 11 + 3 * k;
  vec4 a = stored(record, start / 4);
  int part = start % 4;
  if (part == 0) { return a.xyz; }
  if (part == 1) { return a.yzw; }
  vec4 b = stored(record, start / 4 + 1);
  return part == 2 ? vec3(a.zw, b.x) : vec3(a.w, b.xy);
}

vec3 seen_color(ivec2 record, vec3 base, vec3 d)
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
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, unless drawn
  place = vec2(0.0);
  color_opacity = vec4(0.0);

  // splat, weight, placement, level whose colour it gets; -1: that of what is selected
  vec4 instance = texel(instances, gl_InstanceID);
  int slot = int(instance.x), row = int(instance.z) * 5;
  ivec2 record = ivec2(slot / part_size, slot % part_size * texels);
  vec4 mean = stored(record, 0);
  float opacity = mean.w * instance.y;
  mean.w = 1.0;
  vec4 filtered = texel(placements, row + 4);  // added variance, whether opacity pays for it, looks
  mat3 look = mat3(1.0);
  for (int i = int(filtered.z); i < int(filtered.w); i++) {  // see ``_looks``
    int at = 6 * i;
    vec4 red = texel(looks, at + 3), green = texel(looks, at + 4), blue = texel(looks, at + 5);
    vec3 own = vec3(dot(texel(looks, at), mean), dot(texel(looks, at + 1), mean),
                    dot(texel(looks, at + 2), mean));
    own *= own;
    float away = green.w > 0.0 ? own.x + own.y + own.z : max(own.x, max(own.y, own.z));
    if ((away <= FACE) != (blue.w > 0.0)) {
      look = transpose(mat3(red.xyz, green.xyz, blue.xyz)) * look;
      opacity *= red.w;
    }
  }
  if (opacity <= 1.0 / 255.0) {
    return;
  }
  vec4 to_view_x = texel(placements, row), to_view_y = texel(placements, row + 1);
  vec4 to_view_z = texel(placements, row + 2), eye = texel(placements, row + 3);
  vec3 position = vec3(dot(to_view_x, mean), dot(to_view_y, mean), dot(to_view_z, mean));
  vec4 clip = projection * vec4(position, 1.0);
  if (clip.w <= 0.0 || abs(clip.z) >= clip.w) {
    return;
  }

  // The projection's derivative (in pixels) times half the covariance: rotation, then scales.
  vec3 ndc = clip.xyz / clip.w;
  vec2 centre = 0.5 * (frame.xy + frame.zw), most = 1.3 * (frame.zw - centre);
  vec2 held = clamp(ndc.xy, centre - most, centre + most);
  mat4 rows = transpose(projection);
  vec3 by_x = (rows[0].xyz - held.x * rows[3].xyz) * (0.5 * size.x / clip.w);
  vec3 by_y = (rows[1].xyz - held.y * rows[3].xyz) * (0.5 * size.y / clip.w);
  vec4 q = stored(record, 1);  // w, x, y, z
  vec4 s = stored(record, 2);  // and of the colour the first number
  mat3 turn = mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 to_view = transpose(mat3(to_view_x.xyz, to_view_y.xyz, to_view_z.xyz));
  mat3 half_covariance = to_view * turn * mat3(s.x, 0.0, 0.0, 0.0, s.y, 0.0, 0.0, 0.0, s.z);
  vec3 row_x = by_x * half_covariance, row_y = by_y * half_covariance;
  float xx = dot(row_x, row_x) + filtered.x, xy = dot(row_x, row_y), yy = dot(row_y, row_y) + filtered.x;
  if (filtered.y > 0.0) {
    vec3 area = cross(row_x, row_y);
    float before = dot(area, area);
    opacity *= sqrt(before / (before + filtered.x * (xx + yy - filtered.x)));
    if (opacity <= 1.0 / 255.0) {
      return;
    }
  }

  // The ellipse where alpha falls to 1/255, along its own axes.
  float middle = 0.5 * (xx + yy);
  float apart = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-6 * middle ? normalize(vec2(xy, middle + apart - xx))
                                      : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float longer = sqrt(middle + apart), shorter = sqrt(max(middle - apart, filtered.x));
  float reach = sqrt(2.0 * log(255.0 * opacity));
  vec2 offset = corner.x * longer * reach * axis + corner.y * shorter * reach * vec2(-axis.y, axis.x);
  place = corner * reach;
  gl_Position = vec4(ndc.xy + offset * 2.0 / size, ndc.z, 1.0);

  vec3 base = vec3(s.w, stored(record, 3).xy);
  vec3 color = max(look * seen_color(record, base, normalize(mean.xyz * eye.w - eye.xyz)), 0.0);
  if (instance.w != 0.0) {  // in the lightness of its own colour, so that the scene stays readable
    float lightness = 0.35 + 0.65 * min(dot(color, vec3(1.0 / 3.0)), 1.0);
    color = lightness * (instance.w < 0.0
      ? SELECTED : texelFetch(palette, ivec2(int(instance.w - 1.0) % PALETTE, 0), 0).rgb);
  }
  color_opacity = vec4(color, opacity);
}
"""
)
_FRAGMENT = """
void main()
{
  float alpha = min(0.99, color_opacity.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) {
    discard;
  }
  drawn = vec4(color_opacity.rgb * alpha, alpha);
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
  at = 0.5 * corner + 0.5;
  gl_Position = vec4(corner, 0.0, 1.0);
}
"""
_DEPTH_FRAGMENT = """
void main()
{
  gl_FragDepth = texelFetch(depth, ivec2(at * vec2(textureSize(depth, 0))), 0).r;
  drawn = vec4(0.0);
}
"""
_COMPOSITE_FRAGMENT = """
vec3 linear(vec3 code)
{
  return mix(pow((code + 0.055) / 1.055, vec3(2.4)), code / 12.92, step(code, vec3(0.04045)));
}

// What a pixel would show without the overlay that covers part of it: what pixels nearby do that have none.
vec3 without(ivec2 pixel, vec3 otherwise)
{
  ivec2 size = textureSize(overlay, 0);
  for (int away = 2; away <= 8; away *= 2) {
    for (int i = 0; i < 9; i++) {
      ivec2 nearby = clamp(pixel + away * ivec2(i % 3 - 1, i / 3 - 1), ivec2(0), size - 1);
      vec4 there = texelFetch(overlay, nearby, 0);
      if (there.a == 0.0) {
        return linear(there.rgb);
      }
    }
  }
  return otherwise;
}

// Blender's buffer is linear with a gamma of 2.2, and so is how it lies over the scene; splats lie over it as
// displayed, d = s + (1 - a) b. What is written does so over black (b = 0) and, in the mean of the channels,
// over white (b = 1). Overlays are in the buffer already, and so is the background, which has alpha 0: it is
// faded by the blending, which would fade thin overlays with it, so that those are added again.
void main()
{
  vec4 splats = texture(colors, at);
  vec3 black = pow(clamp(splats.rgb, 0.0, 1.0), vec3(2.2));
  vec3 white = pow(clamp(splats.rgb + 1.0 - splats.a, 0.0, 1.0), vec3(2.2));
  float alpha = 1.0 - dot(white - black, vec3(1.0 / 3.0));

  ivec2 pixel = ivec2(at * vec2(textureSize(overlay, 0)));
  vec4 there = texelFetch(overlay, pixel, 0);
  float room = 1.0 - there.a;
  vec3 again = vec3(0.0);
  if (there.a > 0.0 && there.a < 1.0) {
    again = linear(there.rgb);
    again -= without(pixel, again);
  }
  drawn = room * vec4(black + alpha * again, alpha);
}
"""


def instances_texture(
    arrangement: Arrangement, places: np.ndarray, selected: np.ndarray | None = None
) -> tuple[gpu.types.GPUTexture, int]:
    """An arrangement's list on the graphics card, and how many splats it has: those that have a place there.

    Args:
        places: see ``resident.Store``.
        selected: see ``resident.Resident``; these get the colour of what is selected.
    """
    there = places[arrangement.splats]
    some = there >= 0
    rows = arrangement.instances if some.all() else arrangement.instances[some]
    height = max(-(-len(rows) // WIDTH), 1)
    data = gpu.types.Buffer("FLOAT", height * WIDTH * 4)
    listed = np.frombuffer(data, np.float32).reshape(-1, 4)[: len(rows)]  # type: ignore[arg-type]
    listed[:], listed[:, 0] = rows, there[some]
    if selected is not None:
        listed[selected[arrangement.splats[some]], 3] = -1
    return gpu.types.GPUTexture((WIDTH, height), format="RGBA32F", data=data), len(rows)


def copy_records(
    frame: gpu.types.GPUFrameBuffer, store: gpu.types.GPUTexture, places: np.ndarray, records: np.ndarray
) -> None:
    """Brings records to their places in a texture, which Blender has no other way to change a part of.

    Args:
        frame: with the texture as its colours.
        places: (M,) ascending; records of neighbours go on from one row of the texture to the next.
        records: (M, 4 * texels) float32.
    """
    texels = records.shape[1] // 4
    height = -(-records.size // (4 * WIDTH))
    data = gpu.types.Buffer("FLOAT", height * WIDTH * 4)
    np.frombuffer(data, np.float32)[: records.size] = records.reshape(-1)  # type: ignore[arg-type]
    source = gpu.types.GPUTexture((WIDTH, height), format="RGBA32F", data=data)
    begins = np.flatnonzero(np.diff(places, prepend=-2) != 1)
    ends = np.append(begins[1:], len(places))
    start, stop = places[begins].astype(np.int64) * texels, (places[ends - 1].astype(np.int64) + 1) * texels
    # each run of neighbours as its parts in rows of the texture
    first, last = start // WIDTH, (stop - 1) // WIDTH
    parts = last - first + 1
    run = np.repeat(np.arange(len(begins)), parts)
    row = first[run] + np.arange(len(run)) - (np.cumsum(parts) - parts)[run]
    left = np.where(row == first[run], start[run] % WIDTH, 0)
    right = np.where(row == last[run], (stop[run] - 1) % WIDTH + 1, WIDTH)
    shift = begins[run] * texels + row * WIDTH - start[run]  # from a column to its texel in the source
    corners = np.empty((len(run), 6, 3), np.float32)
    x, y = 2.0 * np.stack([left, right]) / WIDTH - 1, 2.0 * np.stack([row, row + 1]) / store.height - 1
    for corner, (across, up) in enumerate(((0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1))):
        corners[:, corner] = np.stack([x[across], y[up], shift], axis=1)
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=3, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, 6 * len(run))
    vertices.attr_fill("corner", corners.reshape(-1, 3))
    shader = _once("copy", _copy_shader)
    with frame.bind():  # type: ignore[union-attr]
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")
        shader.bind()
        shader.uniform_sampler("source", source)
        gpu.types.GPUBatch(type="TRIS", buf=vertices).draw(shader)


class Canvas:
    """The framebuffer that splats are blended in; one for each viewport, made anew for another size.

    It is no ``GPUOffScreen``: making one leaves the framebuffer that is being drawn into unbound.
    """

    def __init__(self) -> None:
        self.size = (0, 0)
        self.colors: gpu.types.GPUTexture | None = None
        self.frame: gpu.types.GPUFrameBuffer | None = None

    def resize(self, size: tuple[int, int]) -> None:
        """Makes it (width, height) large."""
        if size != self.size:
            self.size, self.colors = size, gpu.types.GPUTexture(size, format="RGBA16F")
            self._depth = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
            self.frame = gpu.types.GPUFrameBuffer(depth_slot=self._depth, color_slots=self.colors)


def draw(
    records: Sequence[gpu.types.GPUTexture | None],
    part: int,
    higher: int,
    instances: gpu.types.GPUTexture,
    count: int,
    worlds: Sequence[np.ndarray],
    view: Matrix,
    projection: Matrix,
    canvas: Canvas,
    *,
    antialias: Sequence[bool] = (),
    looks: Sequence[Looks] = (),
    resolution: float = 1.0,
    under_overlays: bool = True,
    frame: Frame = WHOLE,
) -> None:
    """Draws splats into the active framebuffer, tested against its depth.

    Args:
        records, part, higher: the textures of a ``resident.Store``, how many places each has, and how many
            coefficients it has.
        instances, count: an arrangement's list.
        worlds: each placement's ``matrix_world``, (4, 4) float64.
        view, projection: from the world to the camera's space, and on to clip space.
        antialias: of each placement, see ``SplatScene.antialias``; none: no one is.
        looks: of each placement; none: they are as they are.
        resolution: of the splats, over that of the framebuffer.
        under_overlays: leave what the framebuffer shows already on top, where it has alpha; it is coded in
            sRGB, as a viewport's is.
        frame: left, bottom, right, top in clip space of the picture that is looked at. How splats beside it
            are stretched depends on how far, so that those that reach into it are as a render has them.
    """
    target = gpu.state.active_framebuffer_get()
    _, _, width, height = gpu.state.viewport_get()
    depth = gpu.types.GPUTexture((width, height), format="R32F", data=target.read_depth(0, 0, width, height))
    overlay = _once("nothing", _nothing)
    if under_overlays:
        overlay = gpu.types.GPUTexture(
            (width, height), format="RGBA8", data=target.read_color(0, 0, width, height, 4, 0, "FLOAT")
        )
    flags = antialias or [False] * len(worlds)
    looks = looks or [()] * len(worlds)
    every_look = _looks(looks)  # a texture is freed with its last name
    placements = _placements(worlds, flags, list(map(len, looks)), view, projection)
    size = max(1, round(width * resolution)), max(1, round(height * resolution))
    canvas.resize(size)
    with canvas.frame.bind():  # type: ignore[union-attr]
        canvas.frame.clear(color=(0, 0, 0, 0), depth=1.0)
        gpu.state.color_mask_set(False, False, False, False)
        gpu.state.depth_test_set("ALWAYS")
        gpu.state.depth_mask_set(True)
        shader, quad = _program("depth")
        shader.bind()
        shader.uniform_sampler("depth", depth)
        quad.draw(shader)
        gpu.state.color_mask_set(True, True, True, True)
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(False)
        gpu.state.blend_set("ALPHA_PREMULT")
        shader, quad = _program("splats")
        shader.bind()
        # those that are not there yet are alike, or drivers would compile for other formats again and again
        alike = next(texture for texture in records if texture is not None)
        textures = {
            "instances": instances, "placements": placements, "looks": every_look, "palette": _palette(),
        }  # fmt: skip
        for number in range(PARTS):
            texture = records[number] if number < len(records) else None
            textures[f"records_{number}"] = texture or alike
        bind_textures(shader, textures)
        shader.uniform_float("projection", projection)
        shader.uniform_float("size", size)
        shader.uniform_float("frame", frame)
        shader.uniform_int("degree", round((higher + 1) ** 0.5) - 1)
        shader.uniform_int("texels", -(-(14 + 3 * higher) // 4))
        shader.uniform_int("part_size", part)
        quad.draw_instanced(shader, instance_count=count)

    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("ALPHA_PREMULT")
    shader, quad = _program("composite")
    shader.bind()
    bind_textures(shader, {"colors": canvas.colors, "overlay": overlay})
    quad.draw(shader)
    gpu.state.blend_set("NONE")


def bind_textures(shader: gpu.types.GPUShader, textures: Mapping[str, gpu.types.GPUTexture]) -> None:
    """Bind textures to samplers, given in the order of their slots.

    Under OpenGL, Blender 5.3 also binds every texture to slot 0, so that one has to come last.
    """
    for name, texture in reversed(textures.items()):
        shader.uniform_sampler(name, texture)


def reset_state() -> None:
    """Gives Blender the state that it draws on with, after a drawing that was broken off."""
    gpu.state.color_mask_set(True, True, True, True)
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.program_point_size_set(False)
    gpu.state.blend_set("NONE")


def _placements(
    worlds: Sequence[np.ndarray],
    antialias: Sequence[bool],
    looks: Sequence[int],
    view: Matrix,
    projection: Matrix,
) -> gpu.types.GPUTexture:
    """Five texels a placement: three rows that take its splats to the camera's space, the eye in its own, the
    filter, and which looks it has.

    The eye's fourth number is 1; without perspective it is 0, and the rest the direction against the view.
    """
    view_matrix = np.array(view, np.float64)
    perspective = projection[3][3] == 0
    back = np.linalg.inv(view_matrix)
    eye = back[:, 3] if perspective else back[:, 2]
    data = np.zeros((-(-5 * len(worlds) // WIDTH) * WIDTH, 4), np.float32)
    last = 0
    for number, (world, filtered, count) in enumerate(zip(worlds, antialias, looks, strict=True)):
        rows = data[5 * number : 5 * number + 5]
        rows[4, 2:] = last, last + count
        last += count
        rows[4, :2] = MIP_FILTER if filtered else DILATION
        rows[:3] = (view_matrix @ world)[:3]
        rows[3, :3] = (np.linalg.pinv(world) @ eye)[:3]
        rows[3, 3] = perspective
    buffer = gpu.types.Buffer("FLOAT", data.size, data.reshape(-1))
    return gpu.types.GPUTexture((WIDTH, len(data) // WIDTH), format="RGBA32F", data=buffer)


def _looks(of_placements: Sequence[Looks]) -> gpu.types.GPUTexture:
    """Six texels a look: three rows to the space of its crop, zeros where it counts everywhere, and three
    rows of its matrix; beside these its opacity, whether the crop is a sphere, whether it counts outside."""
    every = [each for looks in of_placements for each in looks]
    data = np.zeros((max(-(-6 * len(every) // WIDTH), 1) * WIDTH, 4), np.float32)
    for number, (crop, look) in enumerate(every):
        rows = data[6 * number : 6 * number + 6]
        if crop is not None:
            rows[:3], rows[4:, 3] = crop.to_own, (crop.shape == "SPHERE", crop.outside)
        rows[3:, :3], rows[3, 3] = look.matrix, look.opacity
    buffer = gpu.types.Buffer("FLOAT", data.size, data.reshape(-1))
    return gpu.types.GPUTexture((WIDTH, len(data) // WIDTH), format="RGBA32F", data=buffer)


_kept: dict[str, Any] = {}
"""Shaders with their quads, and textures that never change, by name; made when they are first needed."""


def clear() -> None:
    """Frees what is kept between drawings."""
    _kept.clear()


def _once(name: str, make: Callable):
    if name not in _kept:
        _kept[name] = make()
    return _kept[name]


def _palette() -> gpu.types.GPUTexture:
    def make() -> gpu.types.GPUTexture:
        colors = np.ones((len(LEVEL_COLORS), 4), np.float32)
        colors[:, :3] = LEVEL_COLORS
        data = gpu.types.Buffer("FLOAT", colors.size, colors.reshape(-1))
        return gpu.types.GPUTexture((len(LEVEL_COLORS), 1), format="RGBA32F", data=data)

    return _once("palette", make)


def _nothing() -> gpu.types.GPUTexture:
    return gpu.types.GPUTexture((1, 1), format="RGBA8", data=gpu.types.Buffer("FLOAT", 4, [0.0] * 4))


def _program(name: str) -> tuple[gpu.types.GPUShader, gpu.types.GPUBatch]:
    return _once(name, lambda: (_SHADERS[name](), _quad()))


def _quad() -> gpu.types.GPUBatch:
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id="corner", comp_type="F32", len=2, fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, 4)
    vertices.attr_fill("corner", np.float32([(-1, -1), (1, -1), (-1, 1), (1, 1)]))
    return gpu.types.GPUBatch(type="TRI_STRIP", buf=vertices)


def _splat_shader() -> gpu.types.GPUShader:
    info, between = _shader("splats")
    between.smooth("VEC2", "place")
    between.flat("VEC4", "color_opacity")
    names = ("instances", "placements", "looks", "palette", *(f"records_{part}" for part in range(PARTS)))
    for slot, name in enumerate(names):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("WIDTH", str(WIDTH))
    info.define("PALETTE", str(len(LEVEL_COLORS)))
    info.define("FACE", repr(FACE_SQUARED))
    info.define("SELECTED", f"vec3{SELECTED}")
    info.push_constant("MAT4", "projection")
    info.push_constant("VEC4", "frame")
    info.push_constant("VEC2", "size")
    info.push_constant("INT", "degree")
    info.push_constant("INT", "texels")
    info.push_constant("INT", "part_size")
    return _made(info, between, _VERTEX, _FRAGMENT)


def _copy_shader() -> gpu.types.GPUShader:
    between = gpu.types.GPUStageInterfaceInfo("lodgs_copy")
    between.flat("FLOAT", "shift")
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "corner")
    info.fragment_out(0, "VEC4", "copied")
    info.sampler(0, "FLOAT_2D", "source")
    info.define("WIDTH", str(WIDTH))
    return _made(info, between, _COPY_VERTEX, _COPY_FRAGMENT)


def _depth_shader() -> gpu.types.GPUShader:
    info, between = _shader("depth")
    between.smooth("VEC2", "at")
    info.sampler(0, "FLOAT_2D", "depth")
    info.depth_write("ANY")
    return _made(info, between, _SCREEN_VERTEX, _DEPTH_FRAGMENT)


def _composite_shader() -> gpu.types.GPUShader:
    info, between = _shader("composite")
    between.smooth("VEC2", "at")
    info.sampler(0, "FLOAT_2D", "colors")
    info.sampler(1, "FLOAT_2D", "overlay")
    return _made(info, between, _SCREEN_VERTEX, _COMPOSITE_FRAGMENT)


_SHADERS = {"splats": _splat_shader, "depth": _depth_shader, "composite": _composite_shader}


def _shader(name: str) -> tuple[gpu.types.GPUShaderCreateInfo, gpu.types.GPUStageInterfaceInfo]:
    info = gpu.types.GPUShaderCreateInfo()
    info.vertex_in(0, "VEC2", "corner")
    info.fragment_out(0, "VEC4", "drawn")
    return info, gpu.types.GPUStageInterfaceInfo(f"lodgs_{name}")


def _made(info, between, vertex: str, fragment: str) -> gpu.types.GPUShader:
    info.vertex_out(between)
    info.vertex_source(vertex)
    info.fragment_source(fragment)
    return gpu.shader.create_from_info(info)
