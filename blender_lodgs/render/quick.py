"""The camera's picture as viewports draw it: by the graphics card, quickly, and without a trainer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import bpy
import gpu
import numpy as np

from ...training.errors import LodgsError
from ...training.render.picture import Picture
from ..data import shown
from ..viewport import views
from . import engine
from .cameras import scene_camera

IMAGE = "LODGS Viewport Quality"
"""The image that takes the picture."""

EVERYTHING = 10**9


def render(context: bpy.types.Context) -> bpy.types.Image:
    """Draws what the scene's camera sees of the splats into an image, at the render's size.

    Returns:
        The image, in linear light; where an Image Editor is open, it shows it.

    Raises:
        LodgsError: there is no camera, or no graphics card can be used.
    """
    linear = picture(context).linear()
    height, width = linear.shape[:2]
    image = bpy.data.images.get(IMAGE)
    if image is None or tuple(image.size) != (width, height):
        if image is not None:
            bpy.data.images.remove(image)
        image = bpy.data.images.new(IMAGE, width, height, alpha=True, float_buffer=True)
        image.colorspace_settings.name = "Linear Rec.709"
        image.alpha_mode = "PREMUL"
    image.pixels.foreach_set(np.ascontiguousarray(linear[::-1]).reshape(-1))
    image.update()
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
    return image


def render_animation(context: bpy.types.Context, frames: Iterable[int]) -> Iterator[Path]:
    """Draws frames of the scene one by one, and saves each as the output settings say.

    Yields:
        The file of each frame, when it is written. The scene returns to its frame at the end.

    Raises:
        LodgsError: as :func:`render`, or a file cannot be written.
    """
    scene, before = context.scene, context.scene.frame_current
    try:
        for frame in frames:
            scene.frame_set(frame)
            path = scene.render.frame_path(frame=frame)
            try:
                render(context).save_render(path, scene=scene)
            except RuntimeError as error:
                raise LodgsError(f"{path} could not be written.", "Choose another output folder.") from error
            yield Path(path)
    finally:
        scene.frame_set(before)


def picture(context: bpy.types.Context) -> Picture:
    """What the scene's camera sees of the splats, as viewports draw it.

    Raises:
        LodgsError: as :func:`render`.
    """
    scene = context.scene
    camera = scene_camera(scene)
    _require_graphics()
    depsgraph = context.evaluated_depsgraph_get()
    (width, height), settings = engine.size(scene.render), scene.render
    projection = camera.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=settings.pixel_aspect_x, scale_y=settings.pixel_aspect_y
    )
    background = None if settings.film_transparent else tuple(scene.lodgs_render.background)
    result = Picture.empty(width, height, background)
    view, screen = views.ViewState(), gpu.types.GPUOffScreen(width, height)
    with screen.bind():  # type: ignore[attr-defined]
        gpu.state.active_framebuffer_get().clear(color=(0, 0, 0, 0), depth=1.0)
        views.draw_splats(
            view, shown.splat_instances(depsgraph), depsgraph, camera.matrix_world.normalized().inverted(),
            projection, EVERYTHING, under_overlays=False, wait=True,
        )  # fmt: skip
    if view.canvas.frame is not None:
        with view.canvas.frame.bind():  # type: ignore[union-attr]
            buffer = view.canvas.frame.read_color(0, 0, width, height, 4, 0, "FLOAT")
        buffer.dimensions = width * height * 4
        drawn = np.array(buffer, np.float32).reshape(height, width, 4)[::-1]
        behind = 1 - drawn[..., 3:]
        result.image[:] = drawn[..., :3] + behind * result.image
        if background is None:
            result.alpha[:] = drawn[..., 3]
    return result


def _require_graphics() -> None:
    """Makes sure that there are graphics."""
    if not bpy.app.background:
        return
    try:
        gpu.init()
    except Exception as error:  # no such function before 5.2, or no graphics on this computer
        raise LodgsError(
            "This Blender has no graphics in background.",
            "Render from a window, or with LODGS and the trainer's Python.",
        ) from error
