"""What panels share: their place in the sidebar, sentences that wrap, and the way to a trainer."""

from __future__ import annotations

import textwrap

import bpy

from ..data import scenes
from ..data.placement import axes_of
from ..data.viewpoints import ViewsSettings
from ..runs import environment_setup


class Panel(bpy.types.Panel):
    """A panel of the LODGS tab in the 3D viewport's sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"


class LevelsPanel(Panel):
    """One that needs a splat scene with levels."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return scenes.root_with_levels(context) is not None


def split_column(layout: bpy.types.UILayout, heading: str = "", align: bool = False) -> bpy.types.UILayout:
    """A column of properties with their names on the left, without dots for animation."""
    column = layout.column(heading=heading, align=align)
    column.use_property_split = True
    column.use_property_decorate = False
    return column


def say(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """A sentence in as many lines as the panel needs for it."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    width = bpy.context.region.width / bpy.context.preferences.system.ui_scale
    letters = max(int((width - 85) / 5.6), 24)  # of the default font, beside the icon and the tabs
    for number, line in enumerate(textwrap.wrap(text, letters, break_on_hyphens=False)):
        column.label(text=line, icon="BLANK1" if number else icon)  # type: ignore[arg-type]


def draw_views(column: bpy.types.UILayout, settings: ViewsSettings, count: int) -> None:
    """From where pictures are drawn that take the place of photographs.

    Args:
        count: how many cameras there are.
    """
    column.prop(settings, "views_from")
    if settings.views_from == "CURVE":
        column.prop(settings, "curve")
    if settings.views_from == "GRID":
        column.prop(settings, "height")
    if settings.views_from == "CAMERAS":
        column.label(text=f"{count} cameras")
    else:
        column.prop(settings, "views")
    column.prop(settings, "view_width")
    if settings.views_from not in ("CAMERAS", "ANIMATION"):  # which Blender shows
        column.prop(settings, "show_views")


def scene_length(context: bpy.types.Context, root: bpy.types.Object, value: float) -> str:
    """A length of a splat scene, in its own units, as Blender says it in the scene's."""
    units, scale = context.scene.unit_settings, max(axes_of(root).matrix_world.to_scale())
    return bpy.utils.units.to_string(
        units.system, "LENGTH", value * scale * units.scale_length, precision=3
    ).strip()


def draw_environment(layout: bpy.types.UILayout, missing: str = "") -> None:
    """The trainer's environment: a button that makes one and what is wrong, or how far the making is.

    Args:
        missing: what one lacks without it, as a sentence.
    """
    work = environment_setup.current
    if work is not None and work.running:
        row = layout.row(align=True)
        row.progress(text=work.message, factor=work.fraction)
        row.operator("lodgs.cancel_environment", text="", icon="X")
        return
    problem = (work and work.problem) or missing
    if problem:
        say(layout, problem, "ERROR")
    elif work is not None:
        say(layout, work.message, "INFO")
    layout.operator("lodgs.make_environment", icon="IMPORT")
