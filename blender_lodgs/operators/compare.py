"""Comparing views with their photographs."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import photographs, scenes
from ..render import compare
from ..runs import processes
from .parts import report_errors


class _OnViews:
    """An operator that acts on the views of the active splat scene."""

    @classmethod
    def poll(cls, context):
        root = scenes.root_with_levels(context)
        if root is None or not photographs.views(root):
            cls.poll_message_set("Select a splat scene that has levels and photographs")
            return False
        return True


class LODGS_OT_measure_views(_OnViews, bpy.types.Operator):
    """Render every view and say how alike it is to its photograph (PSNR); the splats are those shown now"""

    bl_idname = "lodgs.measure_views"
    bl_label = "Measure"

    @report_errors
    def execute(self, context):
        measurement = compare.measure(context, scenes.active_root(context))
        processes.follow(measurement.step)
        if measurement.problem:
            self.report({"ERROR"}, measurement.problem)
            return {"CANCELLED"}
        return {"FINISHED"}


class LODGS_OT_cancel_measuring(bpy.types.Operator):
    """Stop measuring; what has been measured stays"""

    bl_idname = "lodgs.cancel_measuring"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        return compare.measurement is not None and compare.measurement.running

    def execute(self, context):
        compare.measurement.cancel()
        return {"FINISHED"}


class LODGS_OT_compare_view(_OnViews, bpy.types.Operator):
    """Put the photograph of the scene's camera over its rendered picture, with a wipe"""

    bl_idname = "lodgs.compare_view"
    bl_label = "Compare"

    worst: bpy.props.BoolProperty(
        name="Worst",
        description="Compare the view that was least like its photograph when measured",
        options={"SKIP_SAVE"},
    )

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        view = compare.worst(root) if self.worst else context.scene.camera
        if view not in photographs.views(root):
            raise LodgsError("The scene's camera is none of the views.", "Choose one in the list.")
        found = compare.show(context, root, view)
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        self.report({"INFO"}, f"{view.name}: {found.psnr:.2f} dB")
        return {"FINISHED"}


CLASSES = (LODGS_OT_measure_views, LODGS_OT_cancel_measuring, LODGS_OT_compare_view)
