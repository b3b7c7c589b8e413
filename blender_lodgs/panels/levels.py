"""The Levels, Detail and Streaming panels."""

from __future__ import annotations

from itertools import accumulate

import bpy

from ...training.lod.rule import find_rule
from ...training.lod.selection import unknown_rule_error
from ..data import detail, metadata, objects, roots, scenes, streams
from ..nodes.camera_choices import find_choice
from ..viewport import sources
from .parts import LevelsPanel, say, sidebar_width, split_column

MIN_SAVED = 0.05
"""Share of splats below which the panel offers a coarser setting."""
_WIDTHS = 34, 52, 34, 46
"""Widths of the columns of the table of levels in pixels, at an interface scale of 1."""
_TABLE_MARGIN = 107
"""Width of a sidebar without these columns."""


def _columns(row: bpy.types.UILayout, *texts: str) -> None:
    """Draw texts in columns: those that fit the sidebar, at least the first one."""
    fitting = sum(end <= sidebar_width() - _TABLE_MARGIN for end in accumulate(_WIDTHS))
    texts = texts[: max(fitting, 1)]
    for number, text in enumerate(texts[:-1]):
        row = row.split(factor=_WIDTHS[number] / sum(_WIDTHS[number : len(texts)]))
        row.label(text=text)
    row.label(text=texts[-1])


def _short(value: float, digits: int = 0) -> str:
    """Format a number for a narrow column: 682,973; 3.97 M; 79.2; 344."""
    if value >= 1e6:
        return f"{value / 1e6:.3g} M" if value < 1e9 else f"{value / 1e9:.3g} G"
    return f"{value:,.{digits if value < 100 else 0}f}"


class LODGS_UL_levels(bpy.types.UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        row.prop(item, "show", text="", icon="HIDE_OFF" if item.show else "HIDE_ON", emboss=False)
        cloud = item.object.data
        facts = " ".join(
            f"{value:.2g}" if value else "all"  # 0: no splat is too small
            for value in metadata.read_facts(item.facts).values()
        )
        _columns(row, str(item.number), _short(len(cloud.points)), _short(objects.megabytes(cloud), 1), facts)
        solo = data.mode == "SINGLE" and data.single_level == item.number
        row = row.row(align=True)
        row.enabled = data.complete or item.number == data.levels[-1].number
        operator = row.operator(
            "lodgs.show_only_level", text="", icon="SOLO_ON" if solo else "SOLO_OFF", emboss=False
        )
        operator.level = item.number

    def filter_items(self, context, data, propname):
        return [self.bitflag_filter_item * item.exists for item in getattr(data, propname)], []


class LODGS_PT_levels(LevelsPanel):
    bl_label = "Levels"
    bl_order = 2

    def draw(self, context):
        settings = roots.active_root(context).lodgs
        rule = find_rule(settings.rule)
        row = self.layout.row(align=True)
        row.label(text="", icon="BLANK1")
        _columns(row, "Level", "Added" if settings.cumulative else "Splats", "MB",
                 "Detail" if rule and rule.level_facts else "")  # fmt: skip
        row.label(text="", icon="BLANK1")
        rows = min(max(len(settings.levels), 3), 10)
        self.layout.template_list(
            "LODGS_UL_levels", "", settings, "levels", settings, "active_level", rows=rows
        )
        if not settings.complete and len(settings.levels) > 1:
            text = f"Only level {settings.levels[-1].number} is a complete scene."
            say(self.layout, text, "INFO")


class LODGS_PT_detail(LevelsPanel):
    bl_label = "Detail"
    bl_order = 3

    def draw(self, context):
        root = roots.active_root(context)
        settings, layout = root.lodgs, self.layout
        rule = find_rule(settings.rule)
        row = layout.row()
        row.enabled = rule is not None
        row.prop(settings, "mode", expand=True)
        if rule is None:
            problem, remedy = unknown_rule_error(settings.rule)
            say(layout, f"{problem} {remedy}" if settings.rule else problem, "INFO")
        elif rule.weights_full_detail and settings.mode == "SINGLE":
            text = "These splats are trained for By Distance. As one level they look too opaque."
            say(layout, text, "INFO")

        column = layout.column()
        column.use_property_split = True
        if settings.mode == "SINGLE":
            row = column.row()
            row.enabled = settings.complete
            row.prop(settings, "single_level")
        else:
            query = detail.current_query(context, root)
            inactive = query.inactive_controls() if query else {}
            for control in rule.controls if rule else ():
                row = column.row()
                row.active = control.name not in inactive
                row.prop(settings.controls, control.name, slider=control.soft is not None)
            for reason in dict.fromkeys(inactive.values()):
                say(column, reason, "INFO")
            _draw_camera(layout, column, context, settings)
        for item in settings.tables:
            if item.collection and len(item.collection.objects) > 1:  # the first object holds the rows
                text, spheres = f"Show {item.name.title()}", item.collection
                layout.prop(spheres, "hide_viewport", text=text, toggle=True, invert_checkbox=True)
        _draw_counts(layout, context, root)


def _draw_camera(
    layout: bpy.types.UILayout,
    column: bpy.types.UILayout,
    context: bpy.types.Context,
    settings: bpy.types.PropertyGroup,
) -> None:
    """Draw the choice of the camera from which distances are measured, and warnings below the column."""
    row = column.row(align=True)
    row.prop(settings, "camera_choice")
    row.prop(settings, "freeze", text="", icon="FREEZE")
    camera = find_choice(settings.camera_choice)
    if camera.object:
        column.prop(settings, camera.object)
        if getattr(settings, camera.object) is None:  # distances are then measured from the origin
            layout.label(text="No object", icon="ERROR")
    elif camera.position and not camera.viewport:
        column.prop(settings, camera.position, text="Position")
    if context.scene.camera is None and not camera.viewport:
        layout.label(text="No active camera", icon="ERROR")


def _draw_counts(layout: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Draw the camera's chunk and the numbers of visible and loaded splats."""
    query = detail.current_query(context, root) if root.lodgs.mode == "SELECTIVE" else None
    column = layout.column(align=True)
    region = query.region_label() if query else ""
    if region:
        column.label(text=region)
    if not root.lodgs.stream.file:  # when streaming, viewports draw more splats than the levels hold
        visible, total = scenes.count_visible(context, root)
        say(column, f"{visible:,} of {total:,} splats shown", "NONE")
        if query:
            saved = detail.saved_share(context, root)
            say(column, f"{saved:.0%} fewer than the finest level", "NONE")
            if saved < MIN_SAVED and len(root.lodgs.levels) > 1:
                say(column, "By Distance saves almost nothing at this camera.", "INFO")
                column.operator("lodgs.reduce_detail")
    if query and region:
        splats, megabytes = detail.count_loaded(root, query)
        say(column, f"{splats:,} loaded, {megabytes:.1f} MB", "NONE")


class LODGS_PT_stream(LevelsPanel):
    bl_label = "Streaming"
    bl_parent_id = "LODGS_PT_detail"

    @classmethod
    def poll(cls, context):
        root = roots.root_with_levels(context)
        return root is not None and bool(root.lodgs.stream.file)

    def draw(self, context):
        root, layout = roots.active_root(context), self.layout
        stream = sources.stream(root)
        settings = root.lodgs.stream
        resident = settings.scene_splats + (stream.splats if stream is not None and stream.ready else 0)
        resident = min(resident, settings.total)  # streamed pages repeat the splats of the scene
        say(layout, f"{_short(resident)} of {_short(settings.total)} splats in memory", "NONE")
        if streams.is_edited(root):
            say(layout, "These splats no longer match the file, so streaming is off.", "INFO")
        elif root.lodgs.mode != "SELECTIVE":
            say(layout, "Choose By Distance to stream finer splats.", "INFO")
        elif stream is not None and stream.problem:
            say(layout, f"{stream.problem} Only the splats in memory are drawn.", "ERROR")
        elif stream is None:  # no viewport draws splats
            say(layout, "Streams when the viewport draws splats", "INFO")
        elif stream.busy:
            say(layout, "Loading finer splats…", "SORTTIME")
        elif stream.short:
            say(layout, "Limit reached for this view", "INFO")
        else:
            say(layout, "Full detail for this view", "CHECKMARK")
        column = split_column(layout)
        column.prop(settings, "file")
        column.prop(settings, "budget")


CLASSES = (LODGS_UL_levels, LODGS_PT_levels, LODGS_PT_detail, LODGS_PT_stream)
