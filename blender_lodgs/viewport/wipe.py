"""The wipe: in a viewport that looks through a view, its photograph over the rendered picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..data import roots
from . import eye
from .splats import bind_textures

_VERTEX = """
void main()
{
  place = across;
  gl_Position = vec4(position, 0.0, 1.0);
}
"""
_FRAGMENT = """
void main()
{
  vec3 seen = place.x < wipe ? texture(photograph, place).rgb : texture(rendered, place).rgb;
  if (abs(place.x - wipe) < line) {
    seen = vec3(1.0);
  }
  vec3 above = pow((seen + 0.055) / 1.055, vec3(2.4));
  shown = vec4(mix(seen / 12.92, above, step(vec3(0.04045), seen)), 1.0);
}
"""

_shader: gpu.types.GPUShader | None = None
_handle: Any = None


@dataclass
class Comparison:
    """A view's two pictures.

    Attributes:
        view: the camera object's ``session_uid``.
        photograph, rendered: (H, W, 3) float32, display-coded, rows from the top.
        psnr: in dB.
    """

    view: int
    photograph: np.ndarray
    rendered: np.ndarray
    psnr: float
    textures: list = field(default_factory=list)


comparison: Comparison | None = None
"""The comparison that viewports show."""


def show(context: bpy.types.Context, found: Comparison) -> None:
    """Shows a comparison in the viewports that look through its view."""
    global comparison
    comparison = found
    context.scene.lodgs_render.show_comparison = True


def draw(pictures: Comparison, wipe: float, corners: list[tuple[float, float]], line: float) -> None:
    """Draws the photograph left of the wipe and the rendered picture right of it, in linear light: the
    framebuffer of a viewport's overlays codes it for the display.

    Args:
        wipe: 0 to 1, from the left.
        corners: of the picture, in clip space: below left and above right.
        line: half the width of the line between both, in widths of the picture.
    """
    if not pictures.textures:
        pictures.textures += [_texture(pictures.photograph), _texture(pictures.rendered)]
    (left, bottom), (right, top) = corners
    batch = batch_for_shader(
        _wipe_shader(), "TRI_STRIP",
        {
            "position": [(left, bottom), (right, bottom), (left, top), (right, top)],
            "across": [(0, 1), (1, 1), (0, 0), (1, 0)],
        },
    )  # fmt: skip
    shader = _wipe_shader()
    shader.bind()
    bind_textures(shader, {"photograph": pictures.textures[0], "rendered": pictures.textures[1]})
    shader.uniform_float("wipe", wipe)
    shader.uniform_float("line", line)
    batch.draw(shader)


def _texture(picture: np.ndarray) -> gpu.types.GPUTexture:
    height, width = picture.shape[:2]
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = picture
    data = gpu.types.Buffer("FLOAT", rgba.size, rgba.reshape(-1))
    return gpu.types.GPUTexture((width, height), format="RGBA16F", data=data)


def _wipe_shader() -> gpu.types.GPUShader:
    global _shader
    if _shader is None:
        between = gpu.types.GPUStageInterfaceInfo("lodgs_wipe")
        between.smooth("VEC2", "place")
        info = gpu.types.GPUShaderCreateInfo()
        info.push_constant("FLOAT", "wipe")
        info.push_constant("FLOAT", "line")
        info.sampler(0, "FLOAT_2D", "photograph")
        info.sampler(1, "FLOAT_2D", "rendered")
        info.vertex_in(0, "VEC2", "position")
        info.vertex_in(1, "VEC2", "across")
        info.vertex_out(between)
        info.fragment_out(0, "VEC4", "shown")
        info.vertex_source(_VERTEX)
        info.fragment_source(_FRAGMENT)
        _shader = gpu.shader.create_from_info(info)
    return _shader


def _draw() -> None:
    context = bpy.context
    scene, region, view = context.scene, context.region, context.region_data
    camera = scene.camera
    if camera is None or eye.looked_through(context) != camera or not shown(context):
        return
    assert comparison is not None
    left, bottom, right, top = eye.frame(camera, scene, view.window_matrix @ view.view_matrix)
    width = region.width * (right - left) / 2
    draw(
        comparison, scene.lodgs_render.wipe, [(left, bottom), (right, top)], 0.75 / max(width, 1)
    )  # fmt: skip


def shown(context: bpy.types.Context) -> bool:
    """Whether there is a comparison of the scene's camera, and the panel that can switch it off again."""
    camera, root = context.scene.camera, roots.active_root(context)
    if comparison is None or camera is None or root is None or root.lodgs.cameras is None:
        return False
    return (
        context.scene.lodgs_render.show_comparison
        and camera.session_uid == comparison.view
        and camera in root.lodgs.cameras.objects[:]
    )


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    global comparison
    comparison = None


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    global _handle, _shader, comparison
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    bpy.app.handlers.load_post.remove(_on_load)
    _handle = _shader = comparison = None
