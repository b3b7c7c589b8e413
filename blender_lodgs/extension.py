"""What Blender knows of this extension: its name, its folders, its preferences, and its panels on screen."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Protocol, cast

import bpy

FOLDER = Path(__file__).resolve().parent.parent
"""The extension's folder: the trainer runs in it, because ``training`` lies there."""

ID = (__package__ or "").rpartition(".")[0]
"""The module name, such as ``bl_ext.user_default.lodgs``."""


class Settings(Protocol):
    """What the preferences hold.

    Attributes:
        python: path of the trainer's Python; empty for the environment that the extension makes.
        backend: name of the rasterizer's backend, or "auto".
        flamenco: address of the manager of a render farm; empty for none.
    """

    python: str
    backend: str
    flamenco: str


def user_folder(name: str = "") -> Path:
    """A folder of this extension's own in Blender's user folder (nothing is written beside the code)."""
    return Path(bpy.utils.extension_path_user(ID, path=name))


def preferences() -> Settings:
    """The extension's preferences."""
    return cast(Settings, bpy.context.preferences.addons[ID].preferences)


def in_window():
    """A context with a window, which a timer lacks; as it is where there are none (in background)."""
    windows = bpy.context.window_manager.windows
    if bpy.context.window is not None or not windows:
        return nullcontext()
    return bpy.context.temp_override(window=windows[0])


def undo_step(message: str) -> None:
    """Makes what came by itself an undo step, so that undoing the user's next one does not take it away."""
    with in_window():
        bpy.ops.ed.undo_push(message=message)


def redraw() -> None:
    """Has the panels of the extension and the status bar drawn anew, soon."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()
        if not window.modal_operators:  # which may have a text of their own in the status bar
            window.workspace.status_text_set_internal(None)
