"""The verbs in the viewport's menus, where Blender's search (F3) finds them."""

from __future__ import annotations

import bpy

from ..data import scenes


class LODGS_MT_scene(bpy.types.Menu):
    bl_label = "Splat Scene"

    def draw(self, context):
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        if scenes.active_root(context) is None:
            layout.operator("lodgs.import_colmap", text="Import Photographs (COLMAP)…")
            layout.operator("lodgs.import_splats", text="Import Splats…")
            layout.operator("lodgs.capture_scene")
            layout.operator("lodgs.import_capture")
            return
        for menu in (LODGS_MT_training, LODGS_MT_placement, LODGS_MT_views, LODGS_MT_rendering):
            layout.menu(menu.__name__)
        layout.separator()
        layout.operator("lodgs.remove_scene", text="Remove Splat Scene")


class LODGS_MT_training(bpy.types.Menu):
    bl_label = "Train Splats"

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.train", text="Train Splats")
        layout.operator("lodgs.resume_training", text="Resume Training")
        layout.operator("lodgs.cancel_training", text="Cancel Training")
        layout.separator()
        layout.operator("lodgs.plan_cells")
        layout.operator("lodgs.submit_to_flamenco")
        layout.separator()
        layout.operator("lodgs.open_run", text="Open Run…")
        layout.operator("lodgs.show_log", text="Show Trainer's Log")
        layout.operator("lodgs.show_costs")


class LODGS_MT_placement(bpy.types.Menu):
    bl_label = "Place Splats"

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.frame_scene")
        layout.operator("lodgs.set_ground", text="Ground From Selection").by = "SELECTION"
        layout.operator("lodgs.set_ground", text="Find Ground").by = "FOUND"
        layout.operator("lodgs.set_scale", text="Set Scale…")
        layout.operator("lodgs.camera_path")
        layout.operator("lodgs.turntable")


class LODGS_MT_views(bpy.types.Menu):
    bl_label = "Views and Photographs"

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.look_through", text="Look Through Selected View").step = 0
        layout.operator("lodgs.look_through", text="Look Through Next View").step = 1
        layout.operator("lodgs.look_through", text="Look Through Previous View").step = -1
        layout.separator()
        layout.operator("lodgs.compare_view", text="Compare With Photograph")
        layout.operator("lodgs.compare_worst", text="Compare Worst View")
        layout.operator("lodgs.measure_views", text="Measure Views")


class LODGS_MT_rendering(bpy.types.Menu):
    bl_label = "Render Splats"

    def draw(self, context):
        layout = self.layout
        layout.operator("lodgs.use_engine")
        layout.operator("lodgs.render_quick", text="Render in Viewport Quality").animation = False
        layout.operator("lodgs.combine_with_meshes", text="Combine Splats With Meshes")
        layout.operator("lodgs.separate_meshes", text="Separate Splats From Meshes")
        layout.operator("lodgs.render_mesh_depth").animation = False
        layout.operator("lodgs.export_camera", text="Export Camera…")


def _menu(self, context):
    self.layout.separator()
    self.layout.menu(LODGS_MT_scene.__name__)


def _view_menu(self, context):
    self.layout.operator("lodgs.frame_scene")


_MENUS = ("VIEW3D_MT_object", "VIEW3D_MT_edit_pointcloud")

CLASSES = (
    LODGS_MT_training,
    LODGS_MT_placement,
    LODGS_MT_views,
    LODGS_MT_rendering,
    LODGS_MT_scene,
)


def register() -> None:
    for name in _MENUS:
        getattr(bpy.types, name).append(_menu)
    bpy.types.VIEW3D_MT_view.append(_view_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_view.remove(_view_menu)
    for name in _MENUS:
        getattr(bpy.types, name).remove(_menu)
