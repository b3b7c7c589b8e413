"""The operator that looks through the cameras of a scene."""

from __future__ import annotations

import bpy

from ..data import photographs, roots
from .base import report_errors


class LODGS_OT_look_through(bpy.types.Operator):
    """Look through a training camera, with its photo in the background and the render size to match"""

    bl_idname = "lodgs.look_through"
    bl_label = "Look Through Photo"
    bl_options = {"REGISTER", "UNDO"}

    step: bpy.props.IntProperty(
        name="Step",
        description="Number of views to move on by name from the active camera; 0 for the selected camera",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context):
        root = roots.active_root(context)
        return root is not None and bool(photographs.views(root))

    @report_errors
    def execute(self, context):
        photographs.look_through(context, roots.active_root(context), self.step)
        if context.region_data is not None:
            context.region_data.view_perspective = "CAMERA"
        return {"FINISHED"}


CLASSES = (LODGS_OT_look_through,)
