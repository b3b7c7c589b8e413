"""Base classes and helpers of operators: poll conditions, error reports, display of images."""

from __future__ import annotations

import functools
import textwrap
from types import ModuleType

import bpy

from ...training.errors import LodgsError, describe_system_error
from ..data import roots


def report_errors(execute):
    """Wrap an operator's method to report a LodgsError, MemoryError or OSError and cancel the operator."""

    @functools.wraps(execute)
    def wrapper(self, context, *event):
        try:
            return execute(self, context, *event)
        except LodgsError as error:
            report_error(self, f"{error.what}\n{error.remedy}")
        except MemoryError:
            report_error(self, "Out of memory. Close other files and programs.")
        except (OSError, RuntimeError) as error:
            if (described := describe_system_error(error)) is None:
                raise
            report_error(self, f"{described.what}\n{described.remedy}")
        return {"CANCELLED"}

    return wrapper


def report_error(operator: bpy.types.Operator, text: str) -> None:
    """Report an error in short lines, because Blender cuts off lines that are wider than the window."""
    wrap = functools.partial(textwrap.fill, width=180, break_long_words=False, break_on_hyphens=False)
    operator.report({"ERROR"}, "\n".join(map(wrap, text.splitlines())).replace("\n", " \n"))


def report_result(operator: bpy.types.Operator, problem: str, message: str = "") -> set[str]:
    """Report a problem, or a message without one, and return the result of ``execute``."""
    if problem:
        report_error(operator, problem)
        return {"CANCELLED"}
    if message:
        operator.report({"INFO"}, message)
    return {"FINISHED"}


class CancelOperator:
    """Base class of operators that cancel the program that a module runs.

    Attributes:
        module: module of ``runs`` whose ``current`` is the program, or None.
    """

    module: ModuleType

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.module.current is not None and cls.module.current.running

    def execute(self, context: bpy.types.Context):
        self.module.current.cancel()
        return {"FINISHED"}


def show_image(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """Show an image in the open Image Editors; open one where Blender shows renders if there is none."""
    editors = _image_editors(context)
    if not editors and not bpy.app.background:
        bpy.ops.render.view_show("INVOKE_DEFAULT")
        editors = _image_editors(context)
    for editor in editors:
        editor.image = image


def _image_editors(context: bpy.types.Context) -> list[bpy.types.SpaceImageEditor]:
    areas = [area for window in context.window_manager.windows for area in window.screen.areas]
    return [area.spaces.active for area in areas if area.type == "IMAGE_EDITOR"]  # type: ignore[misc]


class SceneOperator:
    """Base class of operators that change the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        root = roots.active_root(context)
        if root is None:
            cls.poll_message_set("Select or import a splat scene first")  # type: ignore[attr-defined]
        elif not roots.is_local(root):
            cls.poll_message_set(roots.LINKED)  # type: ignore[attr-defined]
        return root is not None and roots.is_local(root)


class ReadLevelsOperator:
    """Base class of operators that read the levels of the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _has_levels(cls, context)


class EditLevelsOperator(SceneOperator):
    """Base class of operators that change the levels of the active splat scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and _has_levels(cls, context)


def _has_levels(cls, context: bpy.types.Context) -> bool:
    if roots.root_with_levels(context) is None:
        cls.poll_message_set("Select a splat scene with levels first")
        return False
    return True
