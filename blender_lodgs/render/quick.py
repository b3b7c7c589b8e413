"""The camera's picture as viewports draw it: by the graphics card, quickly, and without a trainer.

It is a render like F12's, of the same depsgraph: only what draws the splats is another.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import gpu
import numpy as np

from ...training.errors import LodgsError
from ...training.render.image import RenderedImage
from ..data import shown
from ..data.cameras import scene_camera
from ..viewport import views
from . import engine, renderer

IMAGE = "Render Result"
"""The image that takes the picture."""

EVERYTHING = 10**9


def render(context: bpy.types.Context) -> bpy.types.Image:
    """Renders what the scene's camera sees of the view layer's splats, without compositor and sequencer.

    Returns:
        The image; where an Image Editor is open, it shows it.

    Raises:
        LodgsError: there is no camera, no graphics card can be used, or meshes are to hold out.
    """
    scene = context.scene
    scene_camera(scene)
    _require_graphics()
    if scene.lodgs_render.holdout:
        raise LodgsError(
            "Viewport Quality cannot leave out what meshes hide.", "Clear Hold Out, or press Render Image."
        )
    with _splats_alone(scene), engine.drawn_by(_frame):
        try:
            bpy.ops.render.render(scene=scene.name, layer=context.view_layer.name)
        except RuntimeError as error:
            raise LodgsError(str(error).strip(), "Mend that, and press it again.") from error
    image = bpy.data.images[IMAGE]
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
    if scene.render.is_movie_format:
        raise LodgsError(
            "Pictures of Viewport Quality are saved one by one.", "Choose an image format under Output."
        )
    try:
        for frame in frames:
            scene.frame_set(frame)
            path = scene.render.frame_path(frame=frame)
            image = render(context)
            try:
                image.save_render(path, scene=scene)
            except RuntimeError as error:
                raise LodgsError(f"{path} could not be written.", "Choose another output folder.") from error
            yield Path(path)
    finally:
        scene.frame_set(before)


@contextmanager
def _splats_alone(scene: bpy.types.Scene) -> Iterator[None]:
    """Has renders of a scene go through the engine alone, for the time of the block."""
    settings = scene.render
    before = settings.engine, settings.use_compositing, settings.use_sequencer
    settings.engine, settings.use_compositing, settings.use_sequencer = engine.ID, False, False
    try:
        yield
    finally:
        settings.engine, settings.use_compositing, settings.use_sequencer = before


def _frame(
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    window: tuple[int, int, int, int],
    on_progress: renderer.OnProgress,
) -> renderer.Frame:
    """As ``engine.frame``, with the passes of colours alone."""
    scene = depsgraph.scene
    camera, settings = scene_camera(scene).evaluated_get(depsgraph), scene.render
    projection = camera.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=settings.pixel_aspect_x, scale_y=settings.pixel_aspect_y
    )
    if projection[3][3] == 0:  # perspective: to any depth, as F12 has it
        projection[2][2], projection[2][3] = -1.0, -2.0 * camera.data.clip_start
    background = None if settings.film_transparent else tuple(scene.lodgs_render.background)
    result = RenderedImage.empty(width, height, background)
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
    left, bottom, across, up = window
    rows, columns = slice(height - bottom - up, height - bottom), slice(left, left + across)
    planes = {name: plane[rows, columns] for name, plane in result.passes().items()}
    return renderer.Frame(planes, float("nan"))


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
