"""Base classes and drawing helpers of panels."""

from __future__ import annotations

import re
import textwrap

import bpy

from ..data import roots
from ..data.placement import axes_of
from ..data.view_settings import VIEW_PATTERNS, ViewsSettings
from ..runs import environment_setup

TINT_ICONS = {
    "orange": "COLLECTION_COLOR_02", "yellow": "COLLECTION_COLOR_03", "pink": "COLLECTION_COLOR_07",
    "violet": "COLLECTION_COLOR_06", "red": "COLLECTION_COLOR_01", "green": "COLLECTION_COLOR_04",
}  # fmt: skip
"""Icons by the colour of marked splats."""


class Panel(bpy.types.Panel):
    """A panel of the LODGS tab in the 3D viewport's sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"


class LevelsPanel(Panel):
    """A panel for splat scenes with levels."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return roots.root_with_levels(context) is not None


def split_column(layout: bpy.types.UILayout, heading: str = "", align: bool = False) -> bpy.types.UILayout:
    """Add a column of properties with labels on the left and without animation dots."""
    column = layout.column(heading=heading, align=align)
    column.use_property_split = True
    column.use_property_decorate = False
    return column


def short_count(count: int) -> str:
    """Format a number of splats with at most four characters and a unit, for example "1.2 M"."""
    for unit, size in (("M", 1_000_000), ("k", 1000)):
        if count >= 0.9995 * size:
            return f"{count / size:.{1 if count < 99.95 * size else 0}f} {unit}"
    return str(count)


def sidebar_width() -> float:
    """Return the width of the drawn region in pixels at an interface scale of 1; without a window, any."""
    region = bpy.context.region
    return region.width / bpy.context.preferences.system.ui_scale if region else 300.0


def say(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """Draw a text that wraps to the panel's width."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    margin = 65 if icon == "NONE" else 85  # tabs, borders and icon
    columns = max(int((sidebar_width() - margin) / 5.6), 12)  # letters of the default font
    text = re.sub(r"(\d) (?=([kMG]|s|[cmk]?m|[kMGT]B|dB)\b)", "\\1\u00a0", text)  # keep units on the line
    for number, line in enumerate(textwrap.wrap(text, columns, break_on_hyphens=False)):
        line = line.replace("\u00a0", " ")
        column.label(text=line, icon="BLANK1" if number and icon != "NONE" else icon)  # type: ignore[arg-type]


def draw_views(column: bpy.types.UILayout, settings: ViewsSettings, count: int) -> None:
    """Draw the settings of the views to render as training images.

    Args:
        count: number of cameras or visited views.
    """
    column.prop(settings, "views_from")
    for pattern in VIEW_PATTERNS:
        if pattern.identifier == settings.views_from and pattern.setting:
            column.prop(settings, pattern.setting)
    if settings.views_from == "CAMERAS":
        column.label(text=f"{count} camera{'' if count == 1 else 's'}")
    else:
        column.prop(settings, "views")
    if settings.views_from == "VISITED":
        column.label(text=f"{count} visited view{'' if count == 1 else 's'}")
    column.prop(settings, "view_width")
    if settings.views_from not in ("CAMERAS", "ANIMATION"):  # Blender draws those cameras itself
        column.prop(settings, "show_views")


def scene_length(context: bpy.types.Context, root: bpy.types.Object, value: float) -> str:
    """Format a length given in the splat scene's units, in the units of the Blender scene."""
    units = context.scene.unit_settings
    scale = max(axes_of(root).matrix_world.to_scale())
    return bpy.utils.units.to_string(
        units.system, "LENGTH", value * scale * units.scale_length, precision=3
    ).strip()


def draw_environment(layout: bpy.types.UILayout, missing: str = "") -> None:
    """Draw the installation of the trainer: its progress, or its last result and the button that starts it.

    Args:
        missing: message to show if the trainer is not installed.
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


def draw_crop(row: bpy.types.UILayout, crop: bpy.types.Object) -> None:
    """Draw the checkbox and the name of a crop."""
    used = "CHECKBOX_HLT" if crop.lodgs_crop.use else "CHECKBOX_DEHLT"
    row.prop(crop.lodgs_crop, "use", text="", icon=used)
    row.prop(crop, "name", text="")
