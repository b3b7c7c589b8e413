"""The extension's name, folders and preferences, and helpers for undo and redraw."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol, cast

import bpy

FOLDER = Path(__file__).resolve().parent.parent
"""The extension's folder, which holds ``training``; the trainer runs in it."""

ID = (__package__ or "").rpartition(".")[0]
"""The module name, such as ``bl_ext.user_default.lodgs``."""


class PreferenceValues(Protocol):
    """The extension's preferences.

    Attributes:
        python: path of the trainer's Python; empty for the installed environment.
        backend: name of the rasterizer backend, or "auto".
        flamenco: address of the Flamenco Manager; empty without a render farm.
        notices: show a notice of the operating system when a training ends.
    """

    python: str
    backend: str
    flamenco: str
    notices: bool


_DEFAULTS = SimpleNamespace(python="", backend="auto", flamenco="", notices=False)
"""Preferences without stored values, as of a Blender that was started with ``--addons``."""


def user_folder(name: str = "") -> Path:
    """Return the extension's writable folder in Blender's user folder, or a subfolder of it."""
    return Path(bpy.utils.extension_path_user(ID, path=name))


def preferences() -> PreferenceValues:
    """Return the extension's preferences."""
    addon = bpy.context.preferences.addons.get(ID)
    return cast(PreferenceValues, _DEFAULTS if addon is None else addon.preferences)


def in_window():
    """Return a context manager that sets a window, which timers lack; it does nothing in background mode."""
    windows = bpy.context.window_manager.windows
    if bpy.context.window is not None or not windows:
        return nullcontext()
    return bpy.context.temp_override(window=windows[0])


def undo_step(message: str) -> None:
    """Push an undo step for a change made by a timer, so that the user's next undo does not revert it."""
    with in_window():
        bpy.ops.ed.undo_push(message=message)


def redraw() -> None:
    """Redraw the extension's panels and the status bar."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                area.tag_redraw()
        if not window.modal_operators:  # modal operators may show their own status text
            window.workspace.status_text_set_internal(None)
