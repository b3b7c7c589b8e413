"""Photographs beside what the splats show from the same place: how alike they are.

Pictures and PSNR come from the renderer, at the size of the training images, as ``training evaluate`` has
them, masks included; what is compared are the splats that the scene shows now.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from ...training.scenes.color import srgb_from_linear
from .. import extension
from ..data import cameras, photographs
from ..viewport import wipe
from ..viewport.wipe import Comparison
from . import engine, renderer


def measurable(root: bpy.types.Object) -> list[bpy.types.Object]:
    """The views of a splat scene that have a photograph that a pinhole camera can be compared with."""
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
    """Renders one view as its photograph was taken, and keeps its PSNR; None where ``on_progress`` ended it.

    Levels by distance are chosen from this view and for the picture's size, where they follow the scene's
    camera.

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
    whole = Camera(view.name, facts.width, facts.height, facts.fx, facts.fy, 0, 0, np.eye(4))
    # as typed, and as a job has it: Blender keeps the nearest number of 32 bits
    scale = float(str(np.float32(root.lodgs.training.image_scale)))
    with _rendered_as(scene, view, whole.scaled(scale)) as (width, height):
        depsgraph = context.evaluated_depsgraph_get()
        camera, near = cameras.view_of(view.evaluated_get(depsgraph), depsgraph, width, height)
        drawn = renderer.frame(
            engine.placed_splats(depsgraph), camera, near, on_progress, background=(0.0, 0.0, 0.0),
            photograph=Path(bpy.path.abspath(facts.photograph)),
            mask=Path(bpy.path.abspath(facts.mask)) if facts.mask else None,
        )  # fmt: skip
    if drawn is None:
        return None
    facts.psnr = drawn.psnr
    photograph, linear = (
        np.stack([drawn.planes[f"{name}.{channel}"] for channel in "RGB"], axis=2)
        for name in ("Photograph", "Combined")
    )
    return Comparison(view.session_uid, photograph, srgb_from_linear(linear).astype(np.float32), drawn.psnr)


@contextmanager
def _rendered_as(
    scene: bpy.types.Scene, view: bpy.types.Object, size: photographs.View
) -> Iterator[tuple[int, int]]:
    """Has a scene look through a view, and its render of that size and focal length, in the block.

    Distances count in pixels of the picture that is drawn, whatever was rendered last.
    """
    names = [
        "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y",
    ]  # fmt: skip
    camera, before = scene.camera, [getattr(scene.render, name) for name in names]
    try:
        scene.camera = view
        photographs.match_render(scene, size)
        yield size.width, size.height
    finally:
        scene.camera = camera
        for name, value in zip(names, before, strict=True):
            setattr(scene.render, name, value)


def show(context: bpy.types.Context, root: bpy.types.Object, view: bpy.types.Object) -> Comparison:
    """Compares a view, and shows it with the wipe: the viewport looks through it.

    Raises:
        LodgsError: as :func:`compare_view`.
    """
    found = compare_view(context, root, view)
    assert found is not None
    photographs.through(context, view)
    wipe.show(context, found)
    return found


def worst(root: bpy.types.Object) -> bpy.types.Object | None:
    """The view that was least like its photograph when measured; None where none was."""
    measured = [view for view in photographs.views(root) if view.data.lodgs.psnr > 0]
    return min(measured, key=lambda view: view.data.lodgs.psnr, default=None)


class Measurement:
    """All views compared one after the other; ``processes.follow`` steps through them.

    What was measured is one undo step at the end, and undoing something else meanwhile loses none of it.

    Attributes:
        done, total: views measured, and to measure.
        problem: why it ended early; empty when it did not.
        running: whether it is still at work.
    """

    def __init__(self, context: bpy.types.Context, root: bpy.types.Object) -> None:
        self._root, self._views = root.session_uid, [view.session_uid for view in measurable(root)]
        if not self._views:
            raise LodgsError(f"'{root.name}' has no photographs to measure on.", "Import a COLMAP folder.")
        self.done, self.total, self.problem, self.running = 0, len(self._views), "", True
        self._found: dict[int, float] = {}

    def step(self) -> bool:
        """Measure one view; return whether there are more."""
        objects = {obj.session_uid: obj for obj in bpy.data.objects}
        root = objects.get(self._root)
        try:
            if root is not None and self.running and self.done < self.total:
                view = objects.get(self._views[self.done])
                found = None if view is None else compare_view(bpy.context, root, view)
                if found is not None:
                    self._found[found.view] = found.psnr
                self.done += 1
        except LodgsError as error:
            self.problem, self.running = str(error), False
        self.running = self.running and root is not None and self.done < self.total
        if not self.running and self._found:
            for uid in self._found.keys() & objects.keys():
                objects[uid].data.lodgs.psnr = self._found[uid]
            self._found.clear()
            extension.undo_step("Measure")
        extension.redraw()
        return self.running

    def cancel(self) -> None:
        """Stop after the view that is being measured."""
        self.running = False


measurement: Measurement | None = None
"""The measuring that is at work, or was last."""


def measure(context: bpy.types.Context, root: bpy.types.Object) -> Measurement:
    """Begin to measure every view; the caller follows it.

    Raises:
        LodgsError: there are no photographs, or it is at work already.
    """
    global measurement
    if measurement is not None and measurement.running:
        raise LodgsError("The views are being measured.", "Wait for it or cancel it.")
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
