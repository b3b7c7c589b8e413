"""Update callbacks of properties, see ``property_callbacks``.

They are in a module of their own because they need modules that import the properties.
"""

from __future__ import annotations

import bpy

from .. import extension
from ..nodes.camera_choices import find_choice
from . import photographs, scenes, selection
from .properties import RenderSettings
from .property_callbacks import ON_CHANGE
from .scene_properties import SplatScene


def _active_view(settings: SplatScene, context: bpy.types.Context) -> None:
    objects = settings.cameras.objects if settings.cameras else ()
    if settings.active_view < len(objects) and objects[settings.active_view].type == "CAMERA":
        photographs.use_view(context, objects[settings.active_view])


def _camera_changed(settings: SplatScene, context: bpy.types.Context) -> None:
    if settings.follows_viewport:  # until a viewport reports its position
        _store_camera(settings, context)
    selection.update_inputs(settings.id_data)
    settings.id_data.update_tag()


def _freeze(settings: SplatScene, context: bpy.types.Context) -> None:
    if (
        settings.freeze and not find_choice(settings.camera_choice).viewport
    ):  # focal_px still belongs to the moving camera
        _store_camera(settings, context)
    selection.update_inputs(settings.id_data)
    settings.id_data.update_tag()


def _store_camera(settings: SplatScene, context: bpy.types.Context) -> None:
    root = settings.id_data
    selection.store_camera(root, selection.camera_position(root, context.scene), settings.focal_px)


def _ellipsoids(settings: RenderSettings, context: bpy.types.Context) -> None:
    if settings.ellipsoids:
        scenes.attach_ellipsoids(settings.id_data)
    settings.id_data.update_tag()


def register() -> None:
    ON_CHANGE.update(
        redraw=lambda settings, context: extension.redraw(),
        active_view=_active_view,
        camera_input=lambda settings, context: selection.update_inputs(settings.id_data),
        camera_choice=_camera_changed,
        freeze=_freeze,
        ellipsoids=_ellipsoids,
    )


def unregister() -> None:
    ON_CHANGE.clear()
