"""What operators share: how they report errors, and what they need to be possible."""

from __future__ import annotations

import functools

import bpy

from ...training.errors import LodgsError
from ..data import scenes


def report_errors(execute):
    """Wraps an operator's execute, or what its other methods call: a LodgsError becomes a report of its
    sentences, and it cancels.

    So does a lack of memory.
    """

    @functools.wraps(execute)
    def wrapper(self, context, *event):
        try:
            return execute(self, context, *event)
        except LodgsError as error:
            self.report({"ERROR"}, str(error))
        except MemoryError:
            self.report({"ERROR"}, "There is not enough memory for this. Close other files and programs.")
        return {"CANCELLED"}

    return wrapper


def show_image(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Shows an image where Blender shows renders, unless an Image Editor is open already."""
    editors = _image_editors(context)
    if not editors and not bpy.app.background:
        bpy.ops.render.view_show("INVOKE_DEFAULT")
        editors = _image_editors(context)
    for editor in editors:
        editor.image = image


def _image_editors(context: bpy.types.Context) -> list[bpy.types.SpaceImageEditor]:
    areas = [area for window in context.window_manager.windows for area in window.screen.areas]
    return [area.spaces.active for area in areas if area.type == "IMAGE_EDITOR"]  # type: ignore[misc]


class OnScene:
    """An operator that acts on the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        root = scenes.active_root(context)
        if root is None:
            cls.poll_message_set("Select a splat scene, or import one first")  # type: ignore[attr-defined]
        elif not root.is_editable:
            cls.poll_message_set(scenes.LINKED)  # type: ignore[attr-defined]
        return root is not None and root.is_editable


class OnLevels:
    """An operator that acts on the levels of the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_levels(cls, context)


class OnOwnLevels(OnScene):
    """An operator that changes the levels of the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and _has_levels(cls, context)


def _has_levels(cls, context: bpy.types.Context) -> bool:
    if scenes.root_with_levels(context) is None:
        cls.poll_message_set("Select a splat scene that has levels")
        return False
    return True
