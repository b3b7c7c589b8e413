"""Buttons of the list of levels."""

from __future__ import annotations

import bpy

from ..data import scenes
from .base import SceneOperator, report_errors


class LODGS_OT_show_only_level(SceneOperator, bpy.types.Operator):
    """Show this level everywhere; where levels add up, with all coarser ones"""

    bl_idname = "lodgs.show_only_level"
    bl_label = "Only This One"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    level: bpy.props.IntProperty(name="Level", description="1 is the coarsest", default=1, min=1)

    @report_errors
    def execute(self, context):
        scenes.show_only(scenes.active_root(context), self.level)
        return {"FINISHED"}


CLASSES = (LODGS_OT_show_only_level,)
