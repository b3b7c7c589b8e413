"""Operators of the list of levels."""

from __future__ import annotations

import bpy

from ..data import roots, scenes
from .base import SceneOperator, report_errors


class LODGS_OT_show_only_level(SceneOperator, bpy.types.Operator):
    """Show only this level, together with all coarser ones if levels add up"""

    bl_idname = "lodgs.show_only_level"
    bl_label = "Show Only Level"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    level: bpy.props.IntProperty(
        name="Level", description="Level to show; 1 is the coarsest", default=1, min=1
    )

    @report_errors
    def execute(self, context):
        scenes.show_only(roots.active_root(context), self.level)
        return {"FINISHED"}


CLASSES = (LODGS_OT_show_only_level,)
