"""The Clean Up panel: crops, selection, hidden splats and the remaining splats of each level."""

from __future__ import annotations

import bpy

from ...training.editing.clutter import KINDS
from ..data import cleaning, clutter, crops, roots
from ..data.cleanup_tests import CLUTTER_TESTS, HIDE_TESTS, limit_property
from .parts import TINT_ICONS, LevelsPanel, draw_crop, say, split_column


class LODGS_PT_clean_up(LevelsPanel):
    bl_label = "Clean Up"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        layout, root = self.layout, roots.active_root(context)
        row = layout.row(align=True)
        for shape, icon in (("BOX", "MESH_CUBE"), ("SPHERE", "MESH_UVSPHERE")):
            row.operator("lodgs.add_crop", text=f"Crop {shape.title()}", icon=icon).shape = shape
        column = layout.column(align=True)
        for crop in crops.crops_of(root):
            row = column.row(align=True)
            draw_crop(row, crop)
            row.prop(crop.lodgs_crop, "keep", text="")
            row.operator("lodgs.remove_crop", text="", icon="X").name = crop.name

        _draw_clutter(layout, root)
        layout.label(text="Select in All Levels")
        column, brush = layout.column(align=True), context.scene.lodgs_brush
        row = column.row(align=True)
        row.enabled = context.mode == "OBJECT"
        for name, tool in (("Brush", "lodgs.brush"), ("Lasso", "lodgs.lasso")):
            row.operator("wm.tool_set_by_id", text=name).name = tool
        row = column.row(align=True)
        row.prop(brush, "radius")
        row.prop(brush, "through", toggle=True)
        if count := sum(cleaning.count_selected(root).values()):
            row = column.row(align=True)
            row.operator("lodgs.hide_splats", text=f"Hide {count:,}").test = "SELECTED"
            row.operator("lodgs.select_all_splats", text="Deselect").action = "DESELECT"
            row.operator("lodgs.select_all_splats", text="Invert").action = "INVERT"

        layout.label(text="Hide in All Levels")
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for test in HIDE_TESTS:
            grid.operator("lodgs.hide_splats", text=test.label).test = test.identifier

        column = layout.column(align=True)
        for number, (visible, total) in cleaning.count_remaining(root, context.view_layer.depsgraph).items():
            say(column, f"Level {number}: {visible:,} of {total:,} splats", "NONE")
        lost = {item.number: item.lost for item in root.lodgs.existing_levels if item.lost}
        if lost:
            counts = ", ".join(f"level {number}: {count:,}" for number, count in lost.items())
            say(column, f"These levels were replaced and show their hidden splats again ({counts}).", "INFO")
        column = layout.column(align=True)
        column.operator("lodgs.show_hidden_splats", text="Show All Hidden")
        column.operator("lodgs.delete_hidden_splats", text="Delete Hidden", icon="TRASH")


def _draw_clutter(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    """Draw the preview of clutter: colour, count and limits of each kind, and the buttons that end it."""
    settings = root.lodgs_clutter
    if not settings.preview:
        layout.operator("lodgs.find_clutter", icon="VIEWZOOM")
        return
    counts = clutter.count_by_kind(root)
    if counts is None:
        clutter.refresh_later()
    box = layout.box()
    for test in CLUTTER_TESTS:
        used = getattr(settings, clutter.use_property(test))
        row = box.row()
        row.prop(settings, clutter.use_property(test))
        count = row.row()
        count.alignment = "RIGHT"
        text = f"{counts[test.identifier]:,}" if used and counts is not None else ""
        count.label(text=text, icon=TINT_ICONS[KINDS[test.kind].tint])
        if used:
            column = split_column(box, align=True)
            for name in test.limits:
                column.prop(settings, limit_property(name))
    row = box.row(align=True)
    row.operator("lodgs.hide_clutter", text=f"Hide {clutter.count_clutter(root):,}", icon="HIDE_ON")
    row.operator("lodgs.cancel_clutter", text="Keep", icon="X")


CLASSES = (LODGS_PT_clean_up,)
