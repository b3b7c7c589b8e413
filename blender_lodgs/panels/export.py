"""The Export panel."""

from __future__ import annotations

import bpy

from .. import scenes


class LODGS_PT_export(bpy.types.Panel):
    bl_label = "Export"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"
    bl_order = 7

    @classmethod
    def poll(cls, context):
        root = scenes.active_root(context)
        return root is not None and any(item.exists for item in root.lodgs.levels)

    def draw(self, context):
        column = self.layout.column(align=True)
        column.operator("lodgs.export_bundle", text="Bundle, All Levels…", icon="EXPORT")
        column.operator("lodgs.export_plain", text="Plain PLY…")
        column.operator("lodgs.export_folder", text="Folder of Levels…")


CLASSES = (LODGS_PT_export,)
