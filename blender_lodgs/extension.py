"""What Blender knows of this extension: its name, its folders and its preferences."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from .preferences import LodgsPreferences

FOLDER = Path(__file__).resolve().parent.parent
"""The extension's folder: the trainer runs in it, because ``training`` lies there."""

ID = (__package__ or "").rpartition(".")[0]
"""The module name, such as ``bl_ext.user_default.lodgs``."""


def user_folder(name: str = "") -> Path:
    """A folder of this extension's own in Blender's user folder (nothing is written beside the code)."""
    return Path(bpy.utils.extension_path_user(ID, path=name))


def preferences() -> LodgsPreferences:
    """The extension's preferences."""
    return bpy.context.preferences.addons[ID].preferences  # type: ignore[return-value]
