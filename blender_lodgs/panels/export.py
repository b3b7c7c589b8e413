"""The Export panel."""

from __future__ import annotations

from .parts import LevelsPanel


class LODGS_PT_export(LevelsPanel):
    bl_label = "Export"
    bl_order = 7
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context):
        column = self.layout.column(align=True)
        column.operator("lodgs.export_bundle", text="Level Bundle…", icon="EXPORT")
        column.operator("lodgs.export_compressed", text="Compressed Bundle…")
        column.operator("lodgs.export_plain", text="Plain Splats…")
        column.operator("lodgs.export_levels", text="Levels as USD, glTF…")
        column.operator("lodgs.export_folder", text="Level Folder…")
        column.operator("lodgs.export_tiles", text="Levels as 3D Tiles…")
        column.operator("lodgs.export_streamed", text="Levels for Web…")
        column.operator("lodgs.export_page", text="Page to Share…")


CLASSES = (LODGS_PT_export,)
