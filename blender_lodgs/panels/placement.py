"""The Placement panel."""

from __future__ import annotations

from ..data import scenes
from .parts import Panel


class LODGS_PT_placement(Panel):
    bl_label = "Placement"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = scenes.active_root(context)
        return root is not None and root.is_editable

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.frame_scene", text="Frame Scene", icon="ZOOM_ALL")
        column = layout.column(align=True)
        column.label(text="Ground at Z = 0")
        row = column.row(align=True)
        row.operator("lodgs.set_ground", text="From Selection", icon="SNAP_PERPENDICULAR").by = "SELECTION"
        row.operator("lodgs.set_ground", text="Find", icon="VIEWZOOM").by = "FOUND"
        column.operator("lodgs.set_scale", text="Set Scale…", icon="DRIVER_DISTANCE")
        column = layout.column(align=True)
        column.label(text="Moving Camera")
        row = column.row(align=True)
        row.operator("lodgs.camera_path", text="Along Photographs", icon="CURVE_PATH")
        row.operator("lodgs.turntable", text="Turntable", icon="FILE_REFRESH")


CLASSES = (LODGS_PT_placement,)
