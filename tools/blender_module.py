"""Blender as a Python module with this checkout linked as an extension, for tests and the demo."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

from training.files import cache_folder

REPOSITORY = Path(__file__).resolve().parents[1]
EXTENSION = "bl_ext.user_default.lodgs"
"""Package name of the installed extension."""


@cache
def start_blender():
    """Import bpy, enable the extension in a temporary Blender user folder, and return the module.

    Further calls of the process return the same module. The user's Blender settings are neither read nor
    written. All processes share one folder of compiled code, because compiling takes half a minute.
    """
    resources = Path(tempfile.mkdtemp(prefix="lodgs-blender-"))
    link = resources / "extensions" / "user_default" / "lodgs"
    link.parent.mkdir(parents=True)
    link.symlink_to(REPOSITORY, target_is_directory=True)
    compiled = cache_folder() / "blender-module"
    compiled.mkdir(parents=True, exist_ok=True)
    extension_files = resources / "extensions" / ".user" / "user_default" / "lodgs"
    extension_files.mkdir(parents=True)
    (extension_files / "cache").symlink_to(compiled, target_is_directory=True)
    os.environ["BLENDER_USER_RESOURCES"] = str(resources)

    import bpy  # isort: skip
    import addon_utils  # importable only after bpy

    def fail(error: Exception):
        raise error

    bpy.context.preferences.use_preferences_save = False
    addon_utils.enable(EXTENSION, default_set=True, handle_error=fail)  # type: ignore[arg-type]
    for folder in (resources, bpy.app.tempdir):  # the module leaves its temporary folder behind
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return bpy
