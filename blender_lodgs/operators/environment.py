"""Operators for the trainer's environment, offered in the preferences."""

from __future__ import annotations

import bpy

from ..runs import environment, making, processes
from .base import report_errors


class LODGS_OT_make_environment(bpy.types.Operator):
    bl_idname = "lodgs.make_environment"
    bl_label = "Make Environment"
    bl_description = (
        "Download PyTorch and what else training needs into a folder of its own. The environment that is "
        "there serves until the new one has been tried"
    )
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context: bpy.types.Context):
        work = making.make()
        processes.follow(work.step)
        if work.problem:
            self.report({"ERROR"}, work.problem)
            return {"CANCELLED"}
        return {"FINISHED"}


class LODGS_OT_cancel_environment(bpy.types.Operator):
    bl_idname = "lodgs.cancel_environment"
    bl_label = "Cancel"
    bl_description = "Stop making the environment and remove what is there of it"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return making.current is not None and making.current.running

    def execute(self, context: bpy.types.Context):
        if making.current is not None:
            making.current.cancel()
        return {"FINISHED"}


class LODGS_OT_check_environment(bpy.types.Operator):
    bl_idname = "lodgs.check_environment"
    bl_label = "Check"
    bl_description = "Say what the trainer's Python lacks, if anything, and what this computer can train on"
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context: bpy.types.Context):
        report = environment.check_now()
        if not report.ok:
            self.report({"ERROR"}, "\n".join(report.problems))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Ready to train with PyTorch {report.versions['torch']}.")
        return {"FINISHED"}


CLASSES = (LODGS_OT_make_environment, LODGS_OT_cancel_environment, LODGS_OT_check_environment)
