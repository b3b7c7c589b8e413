"""What operators share: how they report errors, and what they need to be possible."""

from __future__ import annotations

import functools

import bpy

from ...training.errors import LodgsError
from ..data import scenes


def report_errors(execute):
    """Wraps an operator's execute: a LodgsError becomes a report of its sentences, and it cancels.

    So does a lack of memory.
    """

    @functools.wraps(execute)
    def wrapper(self, context):
        try:
            return execute(self, context)
        except LodgsError as error:
            self.report({"ERROR"}, str(error))
        except MemoryError:
            self.report({"ERROR"}, "There is not enough memory for this. Close other files and programs.")
        return {"CANCELLED"}

    return wrapper


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
        if scenes.root_with_levels(context) is None:
            cls.poll_message_set("Select a splat scene that has levels")  # type: ignore[attr-defined]
            return False
        return True
