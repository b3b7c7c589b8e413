"""The Look panel: colour and opacity of the scene and of regions, and paint."""

from __future__ import annotations

import bpy

from ...training.editing.look import LOOK_SETTINGS
from ..data import crops, lighting, looks, roots
from .parts import LevelsPanel, draw_crop, split_column


class LODGS_PT_look(LevelsPanel):
    bl_label = "Look"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return super().poll(context) and roots.is_local(roots.active_root(context))

    def draw(self, context):
        layout, root = self.layout, roots.active_root(context)
        _draw_look(layout, root)
        if lighting.has_lamps(context):
            layout.operator("lodgs.tint_by_light", icon="LIGHT")
        layout.operator("lodgs.reset_look", icon="LOOP_BACK")


class LODGS_PT_look_paint(LevelsPanel):
    bl_label = "Paint"
    bl_parent_id = "LODGS_PT_look"

    def draw(self, context):
        layout, brush = self.layout, context.scene.lodgs_brush
        row = layout.row()
        row.enabled = context.mode == "OBJECT"
        row.operator("wm.tool_set_by_id", text="Paint Splats", icon="BRUSH_DATA").name = "lodgs.paint"
        column = split_column(layout)
        for name in ("color", "radius", "strength", "hardness", "through"):
            column.prop(brush, name)
        layout.operator("lodgs.remove_paint", icon="LOOP_BACK")


class LODGS_PT_look_regions(LevelsPanel):
    bl_label = "Regions"
    bl_parent_id = "LODGS_PT_look"

    def draw(self, context):
        layout, root = self.layout, roots.active_root(context)
        row = layout.row(align=True)
        for shape, icon in (("BOX", "MESH_CUBE"), ("SPHERE", "MESH_UVSPHERE")):
            operator = row.operator("lodgs.add_crop", text=shape.title(), icon=icon)
            operator.shape, operator.keep = shape, "ALL"
        regions = looks.regions_of(root)
        for crop in crops.crops_of(root):
            if crop in regions or crop == context.active_object:
                box = layout.box()
                row = box.row(align=True)
                draw_crop(row, crop)
                if lighting.has_lamps(context):
                    row.operator("lodgs.tint_by_light", text="", icon="LIGHT").name = crop.name
                row.operator("lodgs.reset_look", text="", icon="LOOP_BACK").name = crop.name
                row.operator("lodgs.remove_crop", text="", icon="X").name = crop.name
                _draw_look(box, crop)
                split_column(box).prop(crop.lodgs_look, "outside")


def _draw_look(layout: bpy.types.UILayout, obj: bpy.types.Object) -> None:
    column = split_column(layout)
    column.use_property_decorate = True  # looks can be animated
    for name in LOOK_SETTINGS:
        column.prop(obj.lodgs_look, name)


CLASSES = (LODGS_PT_look, LODGS_PT_look_paint, LODGS_PT_look_regions)
