"""The operator that removes a splat scene and its objects."""

from __future__ import annotations

import bpy

from ..data import removal, roots
from ..runs.watch import watch_of
from .base import SceneOperator


class LODGS_OT_remove_scene(SceneOperator, bpy.types.Operator):
    """Remove the splat scene with its levels, points and cameras from this file; files on disk are kept"""

    bl_idname = "lodgs.remove_scene"
    bl_label = "Remove Splat Scene"
    bl_options = {"REGISTER", "UNDO"}

    def invoke(self, context, event):
        name = roots.active_root(context).name
        return context.window_manager.invoke_confirm(
            self, event, title=f"Remove '{name}'?", confirm_text="Remove", icon="WARNING",
            message="Its levels, points and cameras are deleted. Photos and runs stay on disk.",
        )  # fmt: skip

    def execute(self, context):
        root = roots.active_root(context)
        name = root.name
        watch = watch_of(root)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        removal.remove(root)
        suffix = f"; its training continues in {watch.folder.path}" if watch and watch.running else ""
        self.report({"INFO"}, f"Removed '{name}'{suffix}")
        return {"FINISHED"}


CLASSES = (LODGS_OT_remove_scene,)
