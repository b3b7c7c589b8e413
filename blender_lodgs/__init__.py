"""The Blender side of LODGS, the only package that imports bpy.

Each module lists its Blender classes in ``CLASSES`` and may define ``register()`` and ``unregister()``, for
handlers, menus and properties. Modules register in the order of ``MODULES`` and unregister in reverse.
"""

import bpy

from . import commands, operators, panels, viewport
from .data import (
    changes,
    clutter,
    detail,
    looks,
    older_files,
    paths,
    properties,
    reloading,
    removal,
    scenes,
    updates,
)
from .nodes import building
from .render import compare, compositing, engine, renderer, written_images
from .runs import background_capture, conversion, jobs, method_comparison, photo_preparation
from .viewport import wipe

MODULES = (
    properties,
    looks,
    building,
    updates,
    changes,
    clutter,
    *operators.MODULES,
    *panels.MODULES,
    older_files,
    scenes,
    detail,
    removal,
    reloading,
    conversion,
    paths,
    viewport,
    renderer,
    engine,
    compositing,
    written_images,
    wipe,
    compare,
    jobs,
    background_capture,
    photo_preparation,
    method_comparison,
    commands,
)


def register() -> None:
    """Register the classes, handlers and properties of all modules, in order."""
    for module in MODULES:
        for cls in getattr(module, "CLASSES", ()):
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    """Undo :func:`register` in reverse order."""
    for module in reversed(MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(getattr(module, "CLASSES", ())):
            bpy.utils.unregister_class(cls)
