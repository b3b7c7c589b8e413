"""Operators that capture the Blender scene, stop that, and show how well its views cover it."""

from __future__ import annotations

import bpy

from .. import extension
from ..data import scenes
from ..runs import capturing, processes
from ..viewport import coverage
from .base import report_errors


class LODGS_OT_capture_scene(bpy.types.Operator):
    bl_idname = "lodgs.capture_scene"
    bl_label = "Capture This Blender Scene"
    bl_description = (
        "Render this Blender scene from many views with its own engine, while you work on, and make a COLMAP "
        "scene of them to train from. What its folder holds already is not rendered again"
    )

    @report_errors
    def execute(self, context):
        work = capturing.start(context)
        processes.follow(work.step)
        if work.problem:
            self.report({"ERROR"}, work.problem)
            return {"CANCELLED"}
        return {"FINISHED"}


class LODGS_OT_cancel_capture(bpy.types.Operator):
    bl_idname = "lodgs.cancel_capture"
    bl_label = "Cancel"
    bl_description = "Stop rendering views; Capture goes on from there"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return capturing.current is not None and capturing.current.running

    def execute(self, context):
        assert capturing.current is not None
        capturing.current.cancel()
        return {"FINISHED"}


class LODGS_OT_show_coverage(bpy.types.Operator):
    bl_idname = "lodgs.show_coverage"
    bl_label = "Show Coverage"
    bl_description = (
        "Show as dots what the views will see: green where three of them or more do, orange where two, red "
        "where one alone, and bare where none does. Press again to hide the dots"
    )
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"

    @report_errors
    def execute(self, context):
        if coverage.current(context.scene):
            coverage.clear()
        else:
            coverage.measure(context)
        extension.redraw()
        return {"FINISHED"}


class LODGS_OT_import_capture(bpy.types.Operator):
    bl_idname = "lodgs.import_capture"
    bl_label = "Import What Was Captured"
    bl_description = (
        "Import the captured cameras, pictures and points, to train from. They lie where this Blender scene "
        "is: hide its meshes to see splats in their place"
    )
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        folder = capturing.folder_of(context.scene)
        root = scenes.import_colmap(
            context, folder, upright=False, warn=lambda message: self.report({"WARNING"}, message)
        )
        self.report({"INFO"}, f"'{root.name}': {scenes.contents(root)}")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_capture_scene,
    LODGS_OT_cancel_capture,
    LODGS_OT_show_coverage,
    LODGS_OT_import_capture,
)
