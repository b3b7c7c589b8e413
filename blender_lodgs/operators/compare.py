"""Operators that compare views with their photos."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import photographs, roots
from ..render import compare
from ..runs import processes
from .base import report_errors


class _ViewsOperator:
    """Base class of operators on the views of the active splat scene."""

    @classmethod
    def poll(cls, context):
        root = roots.root_with_levels(context)
        if root is None or not photographs.views_with_photo(root):
            cls.poll_message_set("Select a splat scene with levels and photos first")
            return False
        return True


class LODGS_OT_measure_views(_ViewsOperator, bpy.types.Operator):
    """Render every view with the visible splats and compare it with its photo (PSNR)"""

    bl_idname = "lodgs.measure_views"
    bl_label = "Measure Views"

    @report_errors
    def execute(self, context):
        measurement = compare.measure(context, roots.active_root(context))
        processes.follow(measurement.step)
        if measurement.problem:
            self.report({"ERROR"}, measurement.problem)
            return {"CANCELLED"}
        return {"FINISHED"}


class LODGS_OT_cancel_measuring(bpy.types.Operator):
    """Stop measuring and keep the values measured so far"""

    bl_idname = "lodgs.cancel_measuring"
    bl_label = "Cancel Measuring"

    @classmethod
    def poll(cls, context):
        return compare.measurement is not None and compare.measurement.running

    def execute(self, context):
        compare.measurement.cancel()
        return {"FINISHED"}


class _CompareOperator(_ViewsOperator):
    """Base class of operators that compare a view and look through it."""

    def view(self, context: bpy.types.Context) -> bpy.types.Object | None:
        """Return the camera object to compare."""
        raise NotImplementedError

    @report_errors
    def execute(self, context):
        root, view = roots.active_root(context), self.view(context)
        if view not in photographs.views(root):
            raise LodgsError(
                "Cannot compare: the active camera is not a view of this splat scene.",
                "Choose a view in the list.",
            )
        comparison = compare.show_comparison(context, root, view)
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        suffix = ", held out" if photographs.is_held_out(root, view) else ""
        self.report({"INFO"}, f"{view.name}: {comparison.psnr:.2f} dB{suffix}")
        return {"FINISHED"}


class LODGS_OT_compare_view(_CompareOperator, bpy.types.Operator):
    """Render the active camera's view and compare it with its photo by a wipe"""

    bl_idname = "lodgs.compare_view"
    bl_label = "Compare with Photo"
    bl_options = {"REGISTER", "UNDO"}

    def view(self, context):
        return context.scene.camera


class LODGS_OT_compare_worst(_CompareOperator, bpy.types.Operator):
    """Compare the view with the lowest measured PSNR"""

    bl_idname = "lodgs.compare_worst"
    bl_label = "Compare Worst View"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if compare.worst_view(roots.active_root(context)) is None:
            cls.poll_message_set("Press Measure first")
            return False
        return True

    def view(self, context):
        return compare.worst_view(roots.active_root(context))


CLASSES = (
    LODGS_OT_measure_views,
    LODGS_OT_cancel_measuring,
    LODGS_OT_compare_view,
    LODGS_OT_compare_worst,
)
