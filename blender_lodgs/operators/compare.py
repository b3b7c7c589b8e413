"""Operators that compare views with their photos."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ...training.methods import METHODS
from ..data import evidence, photographs, roots
from ..render import compare
from ..runs import method_comparison, processes
from .base import CancelOperator, SceneOperator, report_errors, report_result


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
        return report_result(self, measurement.problem)


class LODGS_OT_show_evidence(_ViewsOperator, bpy.types.Operator):
    """Colour the splats by the photos that see them, to find places that need more photos"""

    bl_idname = "lodgs.show_evidence"
    bl_label = "Show Evidence"

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        if evidence.grade_shares(root) is None:
            evidence.show(root)
            context.scene.lodgs_render.show_comparison = False  # it covers the colours
        else:
            evidence.hide()
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


class LODGS_OT_compare_methods(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.compare_methods"
    bl_label = "Compare Methods"
    bl_description = (
        "Train several methods on the photos in the background, and open a page that compares their quality, "
        "splats, speed and images"
    )

    methods: bpy.props.EnumProperty(
        name="Methods",
        description="Methods to train with the preset and image scale of the Training panel",
        items=[(method.name, method.label, method.about) for method in METHODS.values()],
        options={"ENUM_FLAG"},
        default={"flod", "octree", "clod", "3dgs"},
    )

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self, confirm_text="Compare")

    def draw(self, context):
        self.layout.column().prop(self, "methods")

    @report_errors
    def execute(self, context):
        names = [name for name in METHODS if name in self.methods]
        work = method_comparison.compare_methods(roots.active_root(context), names)
        processes.follow(work.step)
        return report_result(self, work.problem, work.message)


class LODGS_OT_cancel_comparing_methods(CancelOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_comparing_methods"
    bl_label = "Cancel"
    bl_description = "Stop the comparison; the same comparison resumes it"
    bl_options = {"INTERNAL"}
    module = method_comparison


CLASSES = (
    LODGS_OT_compare_methods,
    LODGS_OT_cancel_comparing_methods,
    LODGS_OT_show_evidence,
    LODGS_OT_measure_views,
    LODGS_OT_cancel_measuring,
    LODGS_OT_compare_view,
    LODGS_OT_compare_worst,
)
