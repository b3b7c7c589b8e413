"""Rendering with the engine LODGS: choosing it, and taking its camera elsewhere."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.scenes.cameras import write_camera
from .. import cameras, compositing, engine, quick, scenes
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


class LODGS_OT_render_mesh_depth(bpy.types.Operator):
    """Render how far the meshes are with Cycles, and have them hold out the splats behind them"""

    bl_idname = "lodgs.render_mesh_depth"
    bl_label = "Render Mesh Depth"
    bl_options = {"REGISTER", "UNDO"}

    animation: bpy.props.BoolProperty(
        name="Animation", description="Render the depth of every frame of the range", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, context, properties):
        return f"{cls.__doc__}, in every frame of the range" if properties.animation else cls.__doc__

    @saying_errors
    def execute(self, context):
        scene = context.scene
        frames = [scene.frame_current]
        if self.animation:
            frames = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        paths = compositing.render_mesh_depth(scene, frames)
        where = f"in {paths[0].parent}" + ("" if bpy.data.filepath else ", until Blender is closed")
        count = "1 depth" if len(paths) == 1 else f"{len(paths)} depths"
        self.report({"INFO"}, f"{count} of meshes {where}")
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
        camera, near = cameras.view_from(
            scenes.active_root(context), context.evaluated_depsgraph_get(), width, height
        )
        path = Path(bpy.path.abspath(self.filepath))
        write_camera(path, camera, near)
        self.report({"INFO"}, f"Camera written to {path}")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_use_engine,
    LODGS_OT_combine_with_meshes,
    LODGS_OT_render_mesh_depth,
    LODGS_OT_render_quick,
    LODGS_OT_export_camera,
)
