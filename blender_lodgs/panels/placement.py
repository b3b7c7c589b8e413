"""The Placement panel, and its operators in the viewport's menus, so that F3 search lists them."""

from __future__ import annotations

import bpy

from ..data import roots
from .parts import Panel


class LODGS_PT_placement(Panel):
    bl_label = "Placement"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = roots.active_root(context)
        return root is not None and roots.is_local(root)

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.frame_scene", text="Frame Scene", icon="ZOOM_ALL")
        column = layout.column(align=True)
        column.label(text="Ground")
        row = column.row(align=True)
        row.operator("lodgs.set_ground", text="From Selection", icon="SNAP_PERPENDICULAR").by = "SELECTION"
        row.operator("lodgs.set_ground", text="Detect", icon="VIEWZOOM").by = "DETECT"
        column.operator("lodgs.set_scale", text="Set Scale…", icon="DRIVER_DISTANCE")
        column = layout.column(align=True)
        column.label(text="Camera Animation")
        column.operator("lodgs.camera_path", text="Camera Path", icon="CURVE_PATH")
        column.operator("lodgs.turntable", text="Turntable", icon="FILE_REFRESH")


class LODGS_MT_placement(bpy.types.Menu):
    bl_label = "Splat Scene"

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.set_ground", text="Set Ground from Selection").by = "SELECTION"
        layout.operator("lodgs.set_ground", text="Detect Ground").by = "DETECT"
        layout.operator("lodgs.set_scale", text="Set Scale…")
        layout.operator("lodgs.camera_path")
        layout.operator("lodgs.turntable")


def _menu(self, context):
    self.layout.menu("LODGS_MT_placement")


def _view_menu(self, context):
    self.layout.operator("lodgs.frame_scene")


_MENUS = ("VIEW3D_MT_object", "VIEW3D_MT_edit_pointcloud")

CLASSES = (LODGS_PT_placement, LODGS_MT_placement)


def register() -> None:
    for name in _MENUS:
        getattr(bpy.types, name).append(_menu)
    bpy.types.VIEW3D_MT_view.append(_view_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_view.remove(_view_menu)
    for name in _MENUS:
        getattr(bpy.types, name).remove(_menu)
