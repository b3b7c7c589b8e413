"""What follows when a property has changed: the functions that ``properties`` looks up by name.

Here, because they need what is built upon the properties.
"""

from __future__ import annotations

import bpy

from .. import extension
from . import photographs, scenes, selection
from .properties import ON_CHANGE, RenderSettings, SplatScene


def _active_view(settings: SplatScene, context: bpy.types.Context) -> None:
    objects = settings.cameras.objects if settings.cameras else ()
    if settings.active_view < len(objects) and objects[settings.active_view].type == "CAMERA":
        photographs.through(context, objects[settings.active_view])


def _eye(settings: SplatScene, context: bpy.types.Context) -> None:
    if settings.eye == "VIEW" and not settings.freeze:  # until a viewport says where it is
        _hold_eye(settings, context)
    selection.update_inputs(settings.id_data)
    settings.id_data.update_tag()


def _freeze(settings: SplatScene, context: bpy.types.Context) -> None:
    if settings.freeze and settings.eye != "VIEW":  # focal_px is still the moving eye's
        _hold_eye(settings, context)
    selection.update_inputs(settings.id_data)
    settings.id_data.update_tag()


def _hold_eye(settings: SplatScene, context: bpy.types.Context) -> None:
    root = settings.id_data
    selection.hold(root, selection.eye_place(root, context.scene), settings.focal_px)


def _ellipsoids(settings: RenderSettings, context: bpy.types.Context) -> None:
    if settings.ellipsoids:
        scenes.offer_ellipsoids(settings.id_data)
    settings.id_data.update_tag()


def register() -> None:
    ON_CHANGE.update(
        redraw=lambda settings, context: extension.redraw(),
        active_view=_active_view,
        eye_input=lambda settings, context: selection.update_inputs(settings.id_data),
        eye=_eye,
        freeze=_freeze,
        ellipsoids=_ellipsoids,
    )


def unregister() -> None:
    ON_CHANGE.clear()
