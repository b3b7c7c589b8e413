"""Rendering with the engine LODGS: choosing it, and taking its camera elsewhere."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.scenes.cameras import write_camera
from ..data import cameras, scenes
from ..render import compositing, engine, quick
from .base import report_errors, show_image
from .modal import FrameOperator


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

    @report_errors
    def execute(self, context):
        meshes = compositing.combine_with_meshes(context.scene)
        self.report({"INFO"}, f"The meshes are rendered by the scene '{meshes.name}'")
        return {"FINISHED"}


class LODGS_OT_separate_meshes(bpy.types.Operator):
    """Render without the meshes again: remove their scene and the nodes that join both pictures"""

    bl_idname = "lodgs.separate_meshes"
    bl_label = "Render Without Meshes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if context.scene.lodgs_render.meshes is None:
            cls.poll_message_set("The scene is not combined with meshes")
            return False
        return True

    @report_errors
    def execute(self, context):
        compositing.separate_meshes(context.scene)
        return {"FINISHED"}


class LODGS_OT_render_mesh_depth(FrameOperator, bpy.types.Operator):
    """Render how far the meshes are with Cycles, and have them hold out the splats behind them"""

    bl_idname = "lodgs.render_mesh_depth"
    bl_label = "Render Mesh Depth"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def description(cls, context, properties):
        return f"{cls.__doc__}, in every frame of the range" if properties.animation else cls.__doc__

    def work(self, context):
        return compositing.render_mesh_depth(context.scene, self.frames(context))

    def result_text(self, count):
        where = f"in {compositing.depth_files(bpy.context.scene).parent}"
        where += "" if bpy.data.filepath else ", until Blender is closed"
        return f"{'1 depth' if count == 1 else f'{count} depths'} of meshes {where}"


class LODGS_OT_render_quick(FrameOperator, bpy.types.Operator):
    """Draw what the camera sees as the viewport does, on the graphics card: quick, and without a trainer"""

    bl_idname = "lodgs.render_quick"
    bl_label = "Render in Viewport Quality"

    @classmethod
    def description(cls, context, properties):
        return f"{cls.__doc__}; saves every frame of the range" if properties.animation else cls.__doc__

    def work(self, context):
        if self.animation:
            yield from quick.render_animation(context, self.frames(context))
        else:
            image = quick.render(context)
            show_image(context, image)
            yield image

    def result_text(self, count):
        if self.animation:
            return f"{'1 frame' if count == 1 else f'{count} frames'} saved"
        return f"Drawn into the image '{quick.IMAGE}'; the Image Editor shows it"


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

    @report_errors
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
    LODGS_OT_separate_meshes,
    LODGS_OT_render_mesh_depth,
    LODGS_OT_render_quick,
    LODGS_OT_export_camera,
)
