"""Operators that capture the Blender scene as images, cancel a capture and show its coverage."""

from __future__ import annotations

import bpy

from .. import extension
from ..data import importing, scenes
from ..data.original_place import original_place
from ..runs import background_capture, processes
from ..viewport import coverage
from .base import CancelOperator, report_errors, report_result


class LODGS_OT_capture_scene(bpy.types.Operator):
    bl_idname = "lodgs.capture_scene"
    bl_label = "Capture Scene"
    bl_description = (
        "Render this Blender scene from many views in the background and write a COLMAP scene to train from; "
        "views already in the folder are kept"
    )

    @report_errors
    def execute(self, context):
        work = background_capture.start(context, lambda message: self.report({"WARNING"}, message))
        processes.follow(work.step)
        return report_result(self, work.problem)


class LODGS_OT_cancel_capture(CancelOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_capture"
    bl_label = "Cancel"
    bl_description = "Stop rendering views; Capture resumes with the next view"
    bl_options = {"INTERNAL"}
    module = background_capture


class LODGS_OT_show_coverage(bpy.types.Operator):
    bl_idname = "lodgs.show_coverage"
    bl_label = "Show Coverage"
    bl_description = (
        "Show surfaces as dots: green if three or more views see them, orange for two views, red for one; "
        "the button then shows the share of green dots"
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
    bl_label = "Import Capture"
    bl_description = (
        "Import the captured cameras, images and points to train from, in place; hide the meshes to see the "
        "splats"
    )
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        folder = background_capture.capture_folder(context.scene)
        place = original_place(context.scene)
        root = importing.import_colmap(
            context, folder, upright=False, warn=lambda message: self.report({"WARNING"}, message)
        )
        place.place(root)
        self.report({"INFO"}, f"'{root.name}': {scenes.contents(root)}")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_capture_scene,
    LODGS_OT_cancel_capture,
    LODGS_OT_show_coverage,
    LODGS_OT_import_capture,
)
