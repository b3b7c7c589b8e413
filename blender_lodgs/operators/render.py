"""Rendering with the engine LODGS: choosing it, and taking its camera elsewhere."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.scenes.cameras import write_camera
from .. import compositing, engine, quick, scenes, views
from .reporting import saying_errors


class LODGS_OT_use_engine(bpy.types.Operator):
    """Render this scene with LODGS, in the colours of the photographs (view transform Standard)"""

    bl_idname = "lodgs.use_engine"
    bl_label = "Render With LODGS"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        engine.use(context.scene)
        return {"FINISHED"}


class LODGS_OT_combine_with_meshes(bpy.types.Operator):
    """Render the meshes with Cycles in a second scene, and join both pictures by depth in the compositor"""

    bl_idname = "lodgs.combine_with_meshes"
    bl_label = "Combine With Meshes"
    bl_options = {"REGISTER", "UNDO"}

    @saying_errors
    def execute(self, context):
        meshes = compositing.combine_with_meshes(context.scene)
        self.report({"INFO"}, f"The meshes are rendered by the scene '{meshes.name}'")
        return {"FINISHED"}


class LODGS_OT_render_quick(bpy.types.Operator):
    """Draw what the camera sees as the viewport does, on the graphics card: quick, and without a trainer"""

    bl_idname = "lodgs.render_quick"
    bl_label = "Viewport Quality"

    animation: bpy.props.BoolProperty(
        name="Animation", description="Draw and save every frame of the range", options={"SKIP_SAVE"}
    )

    @saying_errors
    def execute(self, context):
        if self.animation:
            count = quick.render_animation(context)
            self.report({"INFO"}, f"{count} frames saved")
        else:
            image = quick.render(context)
            self.report({"INFO"}, f"Drawn into the image '{image.name}'; the Image Editor shows it")
        return {"FINISHED"}


class LODGS_OT_export_camera(bpy.types.Operator, ExportHelper):
    """Write the scene's camera as a file, for the same picture without Blender (training render --camera)"""

    bl_idname = "lodgs.export_camera"
    bl_label = "Export Camera"

    filename_ext = ".json"
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})

    @classmethod
    def poll(cls, context):
        if scenes.active_root(context) is None or context.scene.camera is None:
            cls.poll_message_set("Select a splat scene, and give the scene a camera")
            return False
        return True

    def invoke(self, context, event):
        self.filepath = f"{bpy.path.clean_name(context.scene.camera.name)}.json"
        return super().invoke(context, event)

    @saying_errors
    def execute(self, context):
        width, height = engine.size(context.scene.render)
        camera, near = views.view_from(
            scenes.active_root(context), context.evaluated_depsgraph_get(), width, height
        )
        path = Path(bpy.path.abspath(self.filepath))
        write_camera(path, camera, near)
        self.report({"INFO"}, f"Camera written to {path}")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_use_engine,
    LODGS_OT_combine_with_meshes,
    LODGS_OT_render_quick,
    LODGS_OT_export_camera,
)
