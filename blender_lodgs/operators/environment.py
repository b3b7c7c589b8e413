"""Operators that install and check the trainer's Python environment, for the preferences."""

from __future__ import annotations

import bpy

from ..runs import environment, environment_setup, processes
from .base import CancelOperator, report_error, report_errors, report_result


class LODGS_OT_make_environment(bpy.types.Operator):
    bl_idname = "lodgs.make_environment"
    bl_label = "Install Trainer"
    bl_description = (
        "Download PyTorch and the trainer's other packages into a separate folder; a working environment is "
        "replaced only after the new one passes its test"
    )
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context: bpy.types.Context):
        work = environment_setup.start()
        processes.follow(work.step)
        return report_result(self, work.problem)


class LODGS_OT_cancel_environment(CancelOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_environment"
    bl_label = "Cancel"
    bl_description = "Stop the installation and remove its files"
    bl_options = {"INTERNAL"}
    module = environment_setup


class LODGS_OT_check_environment(bpy.types.Operator):
    bl_idname = "lodgs.check_environment"
    bl_label = "Check Trainer"
    bl_description = "Report missing packages of the trainer's Python, and the devices it can train on"
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context: bpy.types.Context):
        report = environment.check_current()
        if not report.ok:
            report_error(self, "\n".join(report.problems))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Ready to train with PyTorch {report.versions['torch']}")
        return {"FINISHED"}


CLASSES = (LODGS_OT_make_environment, LODGS_OT_cancel_environment, LODGS_OT_check_environment)
