"""Wipe between the photo and the rendered image of a view, in viewports that look through its camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..data import roots
from . import view_camera
from .shaders import bind_textures

_VERTEX = """
void main()
{
  image_position = corner;
  gl_Position = vec4(position, 0.0, 1.0);
}
"""
_FRAGMENT = """
void main()
{
  vec3 code = image_position.x < wipe ? texture(photo, image_position).rgb
                                      : texture(rendered, image_position).rgb;
  if (abs(image_position.x - wipe) < line) {
    code = vec3(1.0);
  }
  vec3 above = pow((code + 0.055) / 1.055, vec3(2.4));
  result = vec4(mix(code / 12.92, above, step(vec3(0.04045), code)), 1.0);
}
"""

_shader: gpu.types.GPUShader | None = None
_handle: Any = None


@dataclass
class Comparison:
    """Photo and rendered image of a view.

    Attributes:
        view: ``session_uid`` of the camera object.
        photo, rendered: (H, W, 3) float32, sRGB, top row first.
        psnr: PSNR in dB.
        textures: both images on the graphics card once they are drawn.
    """

    view: int
    photo: np.ndarray
    rendered: np.ndarray
    psnr: float
    textures: list[gpu.types.GPUTexture] = field(default_factory=list)


comparison: Comparison | None = None
"""Displayed comparison."""


def show(context: bpy.types.Context, new_comparison: Comparison) -> None:
    """Show a comparison in the viewports that look through its camera."""
    global comparison
    comparison = new_comparison
    context.scene.lodgs_render.show_comparison = True


def draw(images: Comparison, wipe: float, corners: list[tuple[float, float]], line: float) -> None:
    """Draw the photo left of the wipe and the rendered image right of it, in linear colours.

    A viewport's overlay framebuffer converts them for the display.

    Args:
        wipe: position from 0 (left) to 1 (right).
        corners: lower left and upper right corner of the image in clip space.
        line: half the width of the dividing line, as a fraction of the image width.
    """
    if not images.textures:
        images.textures += [_texture(images.photo), _texture(images.rendered)]
    (left, bottom), (right, top) = corners
    batch = batch_for_shader(
        _wipe_shader(), "TRI_STRIP",
        {
            "position": [(left, bottom), (right, bottom), (left, top), (right, top)],
            "corner": [(0, 1), (1, 1), (0, 0), (1, 0)],
        },
    )  # fmt: skip
    shader = _wipe_shader()
    shader.bind()
    bind_textures(shader, {"photo": images.textures[0], "rendered": images.textures[1]})
    shader.uniform_float("wipe", wipe)
    shader.uniform_float("line", line)
    batch.draw(shader)


def _texture(image: np.ndarray) -> gpu.types.GPUTexture:
    height, width = image.shape[:2]
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = image
    data = gpu.types.Buffer("FLOAT", rgba.size, rgba.reshape(-1))
    return gpu.types.GPUTexture((width, height), format="RGBA16F", data=data)


def _wipe_shader() -> gpu.types.GPUShader:
    global _shader
    if _shader is None:
        interface = gpu.types.GPUStageInterfaceInfo("lodgs_wipe")
        interface.smooth("VEC2", "image_position")
        info = gpu.types.GPUShaderCreateInfo()
        info.push_constant("FLOAT", "wipe")
        info.push_constant("FLOAT", "line")
        info.sampler(0, "FLOAT_2D", "photo")
        info.sampler(1, "FLOAT_2D", "rendered")
        info.vertex_in(0, "VEC2", "position")
        info.vertex_in(1, "VEC2", "corner")
        info.vertex_out(interface)
        info.fragment_out(0, "VEC4", "result")
        info.vertex_source(_VERTEX)
        info.fragment_source(_FRAGMENT)
        _shader = gpu.shader.create_from_info(info)
    return _shader


def _draw() -> None:
    context = bpy.context
    scene, region, view = context.scene, context.region, context.region_data
    camera = scene.camera
    if camera is None or view_camera.active_camera(context) != camera or not is_shown(context):
        return
    assert comparison is not None
    left, bottom, right, top = view_camera.camera_frame(camera, scene, view.window_matrix)
    width = region.width * (right - left) / 2
    draw(comparison, scene.lodgs_render.wipe, [(left, bottom), (right, top)], 0.75 / max(width, 1))


def is_shown(context: bpy.types.Context) -> bool:
    """Return True if a comparison of the scene camera is displayed and its panel is available."""
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
