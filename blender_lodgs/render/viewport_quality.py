"""Renders in viewport quality: the viewport's drawing code renders splats on the graphics card.

These renders need no trainer. They use Blender's render pipeline and the same depsgraph as F12.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy
import gpu
import numpy as np

from ...training.errors import LodgsError
from ...training.render.image import RenderedImage
from ..data import shown
from ..data.cameras import RenderView, scene_camera
from ..viewport import views
from ..viewport.splats import DrawTarget
from . import engine, renderer
from .written_images import require_complete_image

IMAGE = "Render Result"
"""Name of the image with the result."""

ALL_SPLATS = 10**9
"""Splat budget that draws everything."""


def render(context: bpy.types.Context) -> bpy.types.Image:
    """Render the splats of the view layer from the scene's camera, without compositor and sequencer.

    Returns:
        The rendered image. Open Image Editors show it.

    Raises:
        LodgsError: the scene has no camera, there is no graphics card, or a mesh holdout is set.
    """
    scene = context.scene
    scene_camera(scene)
    _require_graphics()
    if scene.camera.data.type == "PANO":
        raise LodgsError("Cannot render in viewport quality: the camera is panoramic.", "Press Render Image.")
    if scene.lodgs_render.holdout:
        raise LodgsError(
            "Cannot render in viewport quality: Hold Out is set.", "Clear Hold Out, or press Render Image."
        )
    with _engine_only(scene), engine.use_renderer(_render_frame):
        try:
            bpy.ops.render.render(scene=scene.name, layer=context.view_layer.name)
        except RuntimeError as error:
            raise LodgsError(f"Cannot render: {str(error).strip()}", "Press Render Image.") from error
    image = bpy.data.images[IMAGE]
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
    return image


def render_animation(context: bpy.types.Context, frames: Iterable[int]) -> Iterator[Path]:
    """Render frames of the scene and save them with its output settings.

    The current frame is restored at the end.

    Args:
        context: context with the scene to render.
        frames: frame numbers.

    Yields:
        The written file of each frame.

    Raises:
        LodgsError: see :func:`render`, or a file cannot be written.
    """
    scene = context.scene
    current_frame, subframe = scene.frame_current, scene.frame_subframe
    if scene.render.is_movie_format:
        raise LodgsError(
            "Cannot render in viewport quality: the output is a video.",
            "Choose an image format in the Output tab.",
        )
    if scene.render.use_multiview:
        raise LodgsError(
            "Cannot render in viewport quality: the animation is stereo or multi-view.",
            "Render it with F12's animation, or disable Stereoscopy in the Output tab.",
        )
    try:
        for frame in frames:
            scene.frame_set(frame)
            path = scene.render.frame_path(frame=frame)
            image = render(context)
            try:
                image.save_render(path, scene=scene)
            except RuntimeError as error:
                raise LodgsError(f"Cannot write {path}.", "Choose another output folder.") from error
            require_complete_image(Path(path))
            yield Path(path)
    finally:
        scene.frame_set(current_frame, subframe=subframe)


@contextmanager
def _engine_only(scene: bpy.types.Scene) -> Iterator[None]:
    """Render with the LODGS engine only within the block: no compositor, no sequencer."""
    settings = scene.render
    previous = settings.engine, settings.use_compositing, settings.use_sequencer
    settings.engine, settings.use_compositing, settings.use_sequencer = engine.ID, False, False
    try:
        yield
    finally:
        settings.engine, settings.use_compositing, settings.use_sequencer = previous


def _render_frame(
    depsgraph: bpy.types.Depsgraph,
    width: int,
    height: int,
    window: tuple[int, int, int, int],
    on_progress: renderer.OnProgress,
    camera: RenderView | None = None,
    motion: Sequence[engine.MotionKey] = (),
) -> renderer.RenderedFrame:
    """Render like ``engine.render_frame``, but only colour and alpha, and without blur."""
    scene = depsgraph.scene
    settings = scene.render
    camera = camera or RenderView.of(scene_camera(scene).evaluated_get(depsgraph))
    projection = camera.projection(depsgraph, width, height)
    if projection[3][3] == 0:  # perspective: no far clipping, as in F12
        projection[2][2], projection[2][3] = -1.0, -2.0 * camera.obj.data.clip_start
    background = None if settings.film_transparent else tuple(scene.lodgs_render.background)
    result = RenderedImage.empty(width, height, background)
    view = views.ViewState()
    screen = gpu.types.GPUOffScreen(width, height)
    with screen.bind():  # type: ignore[attr-defined]
        gpu.state.active_framebuffer_get().clear(color=(0, 0, 0, 0), depth=1.0)
        target = DrawTarget(camera.world_to_camera, projection, under_overlays=False)
        instances = shown.splat_instances(depsgraph)
        views.draw_splats(view, instances, depsgraph, target, ALL_SPLATS, wait=True)
    if view.canvas.frame is not None:
        with view.canvas.frame.bind():  # type: ignore[union-attr]
            buffer = view.canvas.frame.read_color(0, 0, width, height, 4, 0, "FLOAT")
        buffer.dimensions = width * height * 4
        drawn = np.array(buffer, np.float32).reshape(height, width, 4)[::-1]
        transparency = 1 - drawn[..., 3:]
        result.image[:] = drawn[..., :3] + transparency * result.image
        if background is None:
            result.alpha[:] = drawn[..., 3]
    left, bottom, window_width, window_height = window
    rows = slice(height - bottom - window_height, height - bottom)
    columns = slice(left, left + window_width)
    planes = {name: plane[rows, columns] for name, plane in result.passes().items()}
    return renderer.RenderedFrame(planes, float("nan"))


def _require_graphics() -> None:
    """Raise an error if Blender cannot use a graphics card."""
    if not bpy.app.background:
        return
    try:
        gpu.init()
    except Exception as error:  # missing before Blender 5.2, or no graphics card
        raise LodgsError(
            "Cannot render in viewport quality: this Blender has no graphics in background.",
            "Render in a window, or with the LODGS engine.",
        ) from error
