"""Photographs beside what the splats show from the same place: how alike they are, and a wipe over both.

Pictures and PSNR come from the renderer, at the size of the training images, as ``training evaluate`` has
them; what is compared are the splats that the scene shows now.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import gpu
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from gpu_extras.batch import batch_for_shader

from ..training.errors import LodgsError
from . import cameras, engine, processes, renderer, scenes

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


shown: Comparison | None = None
"""The comparison that the viewport shows."""


def measurable(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The views of a splat scene that have a photograph that a pinhole camera can be compared with."""
    return [
        view for view in scenes.views(root) if view.data.lodgs.photograph and not view.data.lodgs.distorted
    ]


def compare(
    context: bpy.types.Context,
    root: bpy.types.Object,
    view: bpy.types.Object,
    wanted: renderer.Wanted = lambda share, text: True,
) -> Comparison | None:
    """Renders one view as its photograph was taken, and remembers its PSNR; None where it was not wanted.

    Levels by distance are chosen from this view, where they follow the scene's camera.

    Raises:
        LodgsError: the view has no photograph, or it cannot be read or rendered.
    """
    facts, scene = view.data.lodgs, context.scene
    if not facts.photograph:
        raise LodgsError(f"'{view.name}' has no photograph.", "Choose another view.")
    if facts.distorted:
        raise LodgsError(
            f"The lens of '{view.name}' bends lines; the splats were trained on a straightened photograph.",
            "Measure with training evaluate.",
        )
    scale = root.lodgs.training.image_scale
    width, height = max(int(facts.width * scale), 1), max(int(facts.height * scale), 1)
    before = scene.camera
    scene.camera = view
    try:
        depsgraph = context.evaluated_depsgraph_get()
        pixel = max(1.0, facts.fy / facts.fx), max(1.0, facts.fx / facts.fy)
        camera, near = cameras.view_of(view.evaluated_get(depsgraph), depsgraph, width, height, pixel)
        drawn = renderer.frame(
            engine.splat_sets(depsgraph), camera, near, wanted, background=(0.0, 0.0, 0.0),
            photograph=Path(bpy.path.abspath(facts.photograph)),
        )  # fmt: skip
    finally:
        scene.camera = before
    if drawn is None:
        return None
    facts.psnr = drawn.psnr
    photograph, linear = (
        np.stack([drawn.planes[f"{name}.{channel}"] for channel in "RGB"], axis=2)
        for name in ("Photograph", "Combined")
    )
    return Comparison(view.session_uid, photograph, engine.coded(linear), drawn.psnr)


def show(context: bpy.types.Context, root: bpy.types.Object, view: bpy.types.Object) -> Comparison:
    """Compares a view, and shows it with the wipe: the viewport looks through it.

    Raises:
        LodgsError: as :func:`compare`.
    """
    global shown
    found = compare(context, root, view)
    assert found is not None
    scenes.through(context, view)
    shown = found
    context.scene.lodgs_render.show_comparison = True
    processes.redraw()
    return found


def worst(root: bpy.types.Object) -> bpy.types.Object:
    """The view that was least like its photograph when measured.

    Raises:
        LodgsError: none was measured.
    """
    measured = [view for view in scenes.views(root) if view.data.lodgs.psnr > 0]
    if not measured:
        raise LodgsError("No view has been measured.", "Press Measure first.")
    return min(measured, key=lambda view: view.data.lodgs.psnr)


class Measuring:
    """All views compared one after the other; ``processes.follow`` steps through them.

    Attributes:
        done, of: views measured, and to measure.
        problem: why it ended early; empty when it did not.
        running: whether it is still at work.
    """

    def __init__(self, context: bpy.types.Context, root: bpy.types.Object) -> None:
        self._root, self._views = root.session_uid, [view.session_uid for view in measurable(root)]
        if not self._views:
            raise LodgsError(f"'{root.name}' has no photographs to measure on.", "Import a COLMAP folder.")
        self.done, self.of, self.problem, self.running = 0, len(self._views), "", True

    def step(self) -> bool:
        """Measure one view; return whether there are more."""
        things = {thing.session_uid: thing for thing in bpy.data.objects}
        root = things.get(self._root)
        try:
            if root is not None and self.running and self.done < self.of:
                view = things.get(self._views[self.done])
                if view is not None:
                    compare(bpy.context, root, view)
                self.done += 1
        except LodgsError as error:
            self.problem, self.running = str(error), False
        self.running = self.running and root is not None and self.done < self.of
        processes.redraw()
        return self.running

    def cancel(self) -> None:
        """Stop after the view in the making."""
        self.running = False


measuring: Measuring | None = None
"""The measuring that is at work, or was last."""


def measure(context: bpy.types.Context, root: bpy.types.Object) -> Measuring:
    """Begin to measure every view; the caller follows it.

    Raises:
        LodgsError: there are no photographs, or it is at work already.
    """
    global measuring
    if measuring is not None and measuring.running:
        raise LodgsError("The views are being measured.", "Wait for it or cancel it.")
    measuring = Measuring(context, root)
    return measuring


# -- the wipe ----------------------------------------------------------------------------------------------


def draw(comparison: Comparison, wipe: float, corners: list[tuple[float, float]], line: float) -> None:
    """Draws the photograph left of the wipe and the rendered picture right of it, in linear light: the
    framebuffer of a viewport's overlays codes it for the display.

    Args:
        wipe: 0 to 1, from the left.
        corners: of the picture, in clip space: below left and above right.
        line: half the width of the line between both, in widths of the picture.
    """
    if not comparison.textures:
        comparison.textures += [_texture(comparison.photograph), _texture(comparison.rendered)]
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
    shader.uniform_sampler("photograph", comparison.textures[0])
    shader.uniform_sampler("rendered", comparison.textures[1])
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
    if shown is None or camera is None or not scene.lodgs_render.show_comparison:
        return
    if view.view_perspective != "CAMERA" or camera.session_uid != shown.view:
        return
    pose = camera.matrix_world.normalized()
    places = [
        location_3d_to_region_2d(region, view, pose @ corner)
        for corner in camera.data.view_frame(scene=scene)
    ]
    if any(place is None for place in places):
        return
    xs, ys = ([place[axis] for place in places] for axis in (0, 1))
    size = region.width, region.height
    corners = [
        tuple(2 * at / whole - 1 for at, whole in zip(corner, size, strict=True))
        for corner in ((min(xs), min(ys)), (max(xs), max(ys)))
    ]
    draw(shown, scene.lodgs_render.wipe, corners, 0.75 / max(max(xs) - min(xs), 1))


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    global shown, measuring
    shown = measuring = None


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    global _handle, _shader, shown
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
    bpy.app.handlers.load_post.remove(_on_load)
    _handle = _shader = shown = None
