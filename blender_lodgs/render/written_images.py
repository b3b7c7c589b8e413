"""Checks of images that Blender has written, because Blender reports no error on a full disk."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ...training.scenes.image_headers import image_size
from ..data.paths import absolute_path

_PNG_END = b"IEND\xaeB`\x82"
_CHECKED = ".png", ".exr", ".jpg", ".jpeg", ".tif", ".tiff", ".webp"
_problem = ""
"""Sentences about an incomplete image of the present render job, or ""."""
_before: dict[str, tuple[int, int]] = {}
"""Times and sizes of the files of the present frame before it is rendered."""


def is_complete_image(path: Path, size: tuple[int, int] | None = None) -> bool:
    """Return whether an image that Blender has written is readable, and a PNG has its last chunk.

    Args:
        size: required width and height, or None for any.
    """
    try:
        if image_size(path) != size and size is not None:
            return False
    except LodgsError:  # a full disk
        return False
    with path.open("rb") as file:
        is_png = file.read(4) == b"\x89PNG"
        file.seek(max(path.stat().st_size - len(_PNG_END), 0))
        return not is_png or file.read() == _PNG_END


def require_complete_image(path: Path) -> None:
    """Delete an image that Blender has not written completely.

    Raises:
        LodgsError: the image was incomplete.
    """
    if path.suffix.lower() in _CHECKED and not is_complete_image(path):
        with suppress(OSError):
            path.unlink()
        raise LodgsError(
            f"Cannot write {path}: the image is incomplete.", "Free some disk space, then render it again."
        )


def raise_problem() -> None:
    """Raise LodgsError if an earlier image of the present render job is incomplete."""
    if _problem:
        raise LodgsError(_problem)


def _states(scene: bpy.types.Scene) -> dict[str, tuple[int, int]]:
    """Return time and size of each file that a still or an animation may write for the present frame."""
    render = scene.render
    try:
        still = str(absolute_path(render.filepath))
    except LodgsError:  # a device
        return {}
    if render.use_file_extension and not still.lower().endswith(render.file_extension):
        still += render.file_extension
    names = [view.name for view in render.views] if render.use_multiview else [""]
    frames = [render.frame_path(frame=scene.frame_current, view=name) for name in names]
    states = {}
    for path in (still, *frames):
        with suppress(OSError):
            state = os.stat(path)
            states[path] = state.st_mtime_ns, state.st_size
    return states


@bpy.app.handlers.persistent
def _on_job(*_) -> None:
    global _problem
    _problem = ""


@bpy.app.handlers.persistent
def _on_frame(scene: bpy.types.Scene, *_) -> None:
    global _before
    _before = _states(scene)


@bpy.app.handlers.persistent
def _on_write(scene: bpy.types.Scene, *_) -> None:
    """Check the image of a frame: the next frame reports the problem, and ends the animation."""
    global _problem
    if scene.render.engine != "LODGS" or scene.render.is_movie_format:
        return
    for path, state in _states(scene).items():
        if state == _before.get(path):
            continue
        try:
            require_complete_image(Path(path))
        except LodgsError as error:
            _problem = str(error)
            print(f"error: {_problem}", file=sys.stderr, flush=True)
            if not bpy.app.background:  # a still has no next frame
                bpy.app.timers.register(_show_problem, first_interval=0)


def _show_problem() -> None:
    """Show the problem at the mouse pointer."""
    manager, text = bpy.context.window_manager, _problem
    if not text or not manager.windows:
        return

    def draw(menu, context) -> None:
        for sentence in text.split(". "):
            menu.layout.label(text=sentence)

    with bpy.context.temp_override(window=manager.windows[0]):
        manager.popup_menu(draw, title="Render", icon="ERROR")


def register() -> None:
    bpy.app.handlers.render_init.append(_on_job)
    bpy.app.handlers.render_pre.append(_on_frame)
    bpy.app.handlers.render_write.append(_on_write)


def unregister() -> None:
    bpy.app.handlers.render_init.remove(_on_job)
    bpy.app.handlers.render_pre.remove(_on_frame)
    bpy.app.handlers.render_write.remove(_on_write)
