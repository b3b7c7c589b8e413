"""Operators of the list of levels."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import detail, roots, scenes
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


class LODGS_OT_reduce_detail(SceneOperator, bpy.types.Operator):
    """Select coarser levels by distance until a share of the finest level's splats is left out"""

    bl_idname = "lodgs.reduce_detail"
    bl_label = "Reduce Detail"
    bl_options = {"REGISTER", "UNDO"}

    share: bpy.props.FloatProperty(
        name="Saved",
        description="Share of the finest level's splats to leave out at the current camera",
        default=0.3,
        min=0.0,
        max=0.95,
        subtype="FACTOR",
    )

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        mode, root.lodgs.mode = root.lodgs.mode, "SELECTIVE"
        context.view_layer.update()
        try:
            saved = detail.reduce_detail(context, root, self.share)
        except LodgsError:
            root.lodgs.mode = mode
            raise
        self.report({"INFO"}, f"By Distance draws {saved:.0%} fewer splats than the finest level")
        return {"FINISHED"}


CLASSES = (LODGS_OT_show_only_level, LODGS_OT_reduce_detail)
