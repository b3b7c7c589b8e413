"""Turn splat clouds that Blender or another add-on imported into LODGS scenes."""

from __future__ import annotations

import bpy

from ..data import native, scenes
from ..runs import photo_preparation
from .base import report_errors


class LODGS_OT_add_to_scene(bpy.types.Operator):
    """Turn the selected Gaussian splat objects into LODGS scenes, to edit, train from and export them"""

    bl_idname = "lodgs.add_to_scene"
    bl_label = "Add to LODGS Scene"
    bl_options = {"REGISTER", "UNDO"}

    as_levels: bpy.props.BoolProperty(
        name="As Levels",
        description="Combine the selected objects into one scene, as levels ordered by number of splats",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not native.loose_splats(context):
            cls.poll_message_set("Select a Gaussian splat object that is in no LODGS scene")
            return False
        return True

    @report_errors
    def execute(self, context):
        roots = native.add_to_scene(context, native.loose_splats(context), self.as_levels)
        photo_preparation.clear_result()
        self.report({"INFO"}, "; ".join(f"'{root.name}': {scenes.contents(root)}" for root in roots))
        return {"FINISHED"}


CLASSES = (LODGS_OT_add_to_scene,)
