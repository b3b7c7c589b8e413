"""Remove a splat scene with all that belongs to it."""

from __future__ import annotations

import bpy

from ..data import removal, scenes
from ..runs.watch import watch_of
from .base import SceneOperator


class LODGS_OT_remove_scene(SceneOperator, bpy.types.Operator):
    """Remove the splat scene: its levels, points, cameras and collections. Files and runs stay"""

    bl_idname = "lodgs.remove_scene"
    bl_label = "Remove Splat Scene"
    bl_options = {"REGISTER", "UNDO"}

    def invoke(self, context, event):
        name = scenes.active_root(context).name
        return context.window_manager.invoke_confirm(
            self, event, title=f"Remove '{name}'?", confirm_text="Remove", icon="WARNING",
            message="Its levels, points and cameras leave this file. Photographs and runs stay on disk.",
        )  # fmt: skip

    def execute(self, context):
        root = scenes.active_root(context)
        name, watch = root.name, watch_of(root)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        removal.remove(root)
        aside = f"; its training goes on in {watch.folder.path}" if watch and watch.running else ""
        self.report({"INFO"}, f"'{name}' is removed{aside}")
        return {"FINISHED"}


CLASSES = (LODGS_OT_remove_scene,)
