"""Comparison of photos with renders of the visible splats from the same views.

Images and PSNR come from the renderer, at the size of the training images and with masks, as in
``lodgs evaluate``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import bpy
import numpy as np

from ...training.color import srgb_from_linear
from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from .. import extension
from ..data import cameras, photographs, scenes
from ..data.paths import absolute_path, library_of
from ..viewport import wipe
from ..viewport.wipe import Comparison
from . import engine, renderer


def measurable_views(root: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the views of a splat scene that have an undistorted photo."""
    return [
        view
        for view in photographs.views(root)
        if view.data.lodgs.photograph and not view.data.lodgs.distorted
    ]


def compare_view(
    context: bpy.types.Context,
    root: bpy.types.Object,
    view: bpy.types.Object,
    on_progress: renderer.OnProgress = lambda fraction, text: True,
) -> Comparison | None:
    """Render a view with the camera of its photo and store the PSNR.

    If levels follow the scene's camera, they are selected for this view and image size.

    Args:
        context: context with the scene to render.
        root: scene root.
        view: camera object of the view.
        on_progress: see ``renderer.OnProgress``.

    Returns:
        The comparison, or None if ``on_progress`` cancelled it.

    Raises:
        LodgsError: the view has no photo, or its photo cannot be read, or it cannot be rendered.
    """
    facts = view.data.lodgs
    scene = context.scene
    if not facts.photograph:
        raise LodgsError(f"Cannot compare '{view.name}': it has no photo.", "Choose another view.")
    if facts.distorted:
        raise LodgsError(
            f"Cannot compare '{view.name}': its photo has lens distortion, but splats are trained on "
            "undistorted photos.",
            "Measure the run with lodgs evaluate.",
        )
    full_size = Camera(view.name, facts.width, facts.height, facts.fx, facts.fy, 0, 0, np.eye(4))
    # the value as typed, which the job has: Blender stores it rounded to 32 bits
    scale = float(str(np.float32(root.lodgs.training.image_scale)))
    settings = _render_settings(scene, view, full_size.scaled(scale))
    with scenes.without_native_drawing(context), settings as (width, height):
        depsgraph = context.evaluated_depsgraph_get()
        camera, near = cameras.view_of(view.evaluated_get(depsgraph), depsgraph, width, height)
        frame_view = renderer.FrameView(
            camera,
            near,
            background=(0.0, 0.0, 0.0),
            photograph=absolute_path(facts.photograph, library_of(view.data)),
            mask=absolute_path(facts.mask, library_of(view.data)) if facts.mask else None,
        )
        frame = renderer.draw_frame(engine.placed_splats(depsgraph), frame_view, on_progress)
    if frame is None:
        return None
    facts.psnr = frame.psnr
    photograph, linear = (
        np.stack([frame.planes[f"{name}.{channel}"] for channel in "RGB"], axis=2)
        for name in ("Photograph", "Combined")
    )
    return Comparison(view.session_uid, photograph, srgb_from_linear(linear).astype(np.float32), frame.psnr)


@contextmanager
def _render_settings(
    scene: bpy.types.Scene, view: bpy.types.Object, size: photographs.View
) -> Iterator[tuple[int, int]]:
    """Set the camera, render size and pixel aspect of a scene for a view within the block.

    Level selection depends on the focal length in pixels, and so on the size of the rendered image.
    """
    names = [
        "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y",
    ]  # fmt: skip
    camera = scene.camera
    values = [getattr(scene.render, name) for name in names]
    try:
        scene.camera = view
        photographs.match_render(scene, size)
        yield size.width, size.height
    finally:
        scene.camera = camera
        for name, value in zip(names, values, strict=True):
            setattr(scene.render, name, value)


def show_comparison(context: bpy.types.Context, root: bpy.types.Object, view: bpy.types.Object) -> Comparison:
    """Compare a view, make it the scene's camera and show the comparison as a wipe.

    Raises:
        LodgsError: see :func:`compare_view`.
    """
    comparison = compare_view(context, root, view)
    assert comparison is not None
    photographs.use_view(context, view)
    wipe.show(context, comparison)
    return comparison


def worst_view(root: bpy.types.Object) -> bpy.types.Object | None:
    """Return the view with the lowest measured PSNR, or None if no view is measured."""
    measured = [view for view in photographs.views(root) if view.data.lodgs.psnr > 0]
    return min(measured, key=lambda view: view.data.lodgs.psnr, default=None)


class Measurement:
    """Comparison of all views of a scene, one view per step of ``processes.follow``.

    All results become one undo step at the end. Other undo steps in between do not lose them.

    Attributes:
        done: number of measured views.
        total: number of views to measure.
        problem: reason of a failure. Empty otherwise.
        running: whether the measurement is running.
    """

    def __init__(self, context: bpy.types.Context, root: bpy.types.Object) -> None:
        self._root = root.session_uid
        self._views = [view.session_uid for view in measurable_views(root)]
        if not self._views:
            raise LodgsError(f"Cannot measure '{root.name}': it has no photos.", "Import a COLMAP folder.")
        self.done = 0
        self.total = len(self._views)
        self.problem = ""
        self.running = True
        self._psnr: dict[int, float] = {}  # by session_uid of the view

    def step(self) -> bool:
        """Measure one view. Return whether more views remain."""
        if measurement is not self:  # another file is open, or the extension is disabled
            return False
        objects = {obj.session_uid: obj for obj in bpy.data.objects}
        root = objects.get(self._root)
        try:
            if root is not None and self.running and self.done < self.total:
                view = objects.get(self._views[self.done])
                with _in_scene_of(root):
                    comparison = None if view is None else compare_view(bpy.context, root, view)
                if comparison is not None:
                    self._psnr[comparison.view] = comparison.psnr
                self.done += 1
        except LodgsError as error:
            self.problem = str(error)
            self.running = False
        self.running = self.running and root is not None and self.done < self.total
        if not self.running and self._psnr:
            for uid in self._psnr.keys() & objects.keys():
                objects[uid].data.lodgs.psnr = self._psnr[uid]
            self._psnr.clear()
            extension.undo_step("Measure")
        extension.redraw()
        return self.running

    def cancel(self) -> None:
        """Stop after the current view."""
        self.running = False


def _in_scene_of(root: bpy.types.Object):
    """Return a context manager that makes a Blender scene of a root the current one, if it is not."""
    if root.name in bpy.context.scene.objects or not root.users_scene:
        return nullcontext()
    scene = root.users_scene[0]
    return bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0])


measurement: Measurement | None = None
"""The running or last measurement."""


def measure(context: bpy.types.Context, root: bpy.types.Object) -> Measurement:
    """Create the measurement of all views. The caller steps it.

    Raises:
        LodgsError: the scene has no photos, or a measurement is running.
    """
    global measurement
    if measurement is not None and measurement.running:
        raise LodgsError(
            "Cannot measure the views: they are already being measured.", "Wait for it or cancel it."
        )
    measurement = Measurement(context, root)
    return measurement


@bpy.app.handlers.persistent
def _on_load(*_) -> None:
    global measurement
    measurement = None


def register() -> None:
    bpy.app.handlers.load_post.append(_on_load)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_on_load)
    _on_load()
