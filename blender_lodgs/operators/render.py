"""Operators of the LODGS render engine: select it, combine it with meshes, render and export the camera."""

from __future__ import annotations

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.scenes.cameras import write_camera
from ..data import cameras, metadata, roots
from ..data.paths import absolute_path
from ..render import compositing, engine, mesh_depth, viewport_quality
from .base import SceneOperator, report_errors, show_image
from .modal import FrameOperator


class LODGS_OT_use_engine(bpy.types.Operator):
    """Set the render engine to LODGS and the view transform to Standard, to match the photos' colours"""

    bl_idname = "lodgs.use_engine"
    bl_label = "Use LODGS Engine"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        engine.use(context.scene)
        return {"FINISHED"}


class LODGS_OT_combine_with_meshes(bpy.types.Operator):
    """Render the meshes with Cycles in a second scene, and combine both images by depth in the compositor"""

    bl_idname = "lodgs.combine_with_meshes"
    bl_label = "Combine with Meshes"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        meshes = compositing.combine_with_meshes(context.scene)
        self.report({"INFO"}, f"Scene '{meshes.name}' renders the meshes")
        return {"FINISHED"}


class LODGS_OT_separate_meshes(bpy.types.Operator):
    """Remove the scene that renders the meshes and its compositor nodes, to render splats only"""

    bl_idname = "lodgs.separate_meshes"
    bl_label = "Remove Meshes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if context.scene.lodgs_render.meshes is None:
            cls.poll_message_set("Combine the scene with meshes first")
            return False
        return True

    @report_errors
    def execute(self, context):
        compositing.separate_meshes(context.scene)
        return {"FINISHED"}


class LODGS_OT_add_shadow_catcher(SceneOperator, bpy.types.Operator):
    """Add a plane on the detected ground of the splat scene that shows the shadows of the meshes"""

    bl_idname = "lodgs.add_shadow_catcher"
    bl_label = "Add Shadow Catcher"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        obj = compositing.add_shadow_catcher(roots.active_root(context), context.scene)
        self.report({"INFO"}, f"'{obj.name}' added at the detected ground")
        return {"FINISHED"}


class LODGS_OT_render_mesh_depth(FrameOperator, bpy.types.Operator):
    """Render the depth of the meshes with Cycles, to hold out the splats behind them"""

    bl_idname = "lodgs.render_mesh_depth"
    bl_label = "Render Mesh Depth"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def description(cls, context, properties):
        return f"{cls.__doc__}, for every frame of the range" if properties.animation else cls.__doc__

    def work(self, context):
        return mesh_depth.render_mesh_depth(context.scene, self.frames(context))

    def result_text(self, count):
        folder = mesh_depth.depth_file_pattern(bpy.context.scene).parent
        suffix = "" if bpy.data.filepath else " until Blender is closed"
        return f"{'1 depth image' if count == 1 else f'{count} depth images'} in {folder}{suffix}"


class LODGS_OT_render_quick(FrameOperator, bpy.types.Operator):
    """Render the camera's view on the GPU in viewport quality, for a quick preview without a trainer"""

    bl_idname = "lodgs.render_quick"
    bl_label = "Render Viewport Quality"

    @classmethod
    def description(cls, context, properties):
        return f"{cls.__doc__}, and save every frame of the range" if properties.animation else cls.__doc__

    def work(self, context):
        if self.animation:
            yield from viewport_quality.render_animation(context, self.frames(context))
        else:
            image = viewport_quality.render(context)
            show_image(context, image)
            yield image

    def result_text(self, count):
        if self.animation:
            folder = absolute_path(bpy.context.scene.render.frame_path()).parent
            return f"{'1 frame' if count == 1 else f'{count} frames'} in {folder}"
        return f"Rendered to image '{viewport_quality.IMAGE}'"


class LODGS_OT_export_camera(bpy.types.Operator, ExportHelper):
    """Write the active camera to a file, to render it outside Blender with lodgs render --camera"""

    bl_idname = "lodgs.export_camera"
    bl_label = "Export Camera"

    filename_ext = ".json"
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})

    @classmethod
    def poll(cls, context):
        if roots.active_root(context) is None or context.scene.camera is None:
            cls.poll_message_set("Select a splat scene and add a camera first")
            return False
        return True

    def invoke(self, context, event):
        self.filepath = f"{bpy.path.clean_name(context.scene.camera.name)}.json"
        return super().invoke(context, event)

    @report_errors
    def execute(self, context):
        width, height = engine.render_size(context.scene.render)
        root = roots.active_root(context)
        camera, near = cameras.view_from(root, context.evaluated_depsgraph_get(), width, height)
        path = absolute_path(self.filepath)
        write_camera(path, camera.moved(metadata.origin_of(root)), near)
        self.report({"INFO"}, f"Camera written to {path}")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_use_engine,
    LODGS_OT_combine_with_meshes,
    LODGS_OT_separate_meshes,
    LODGS_OT_add_shadow_catcher,
    LODGS_OT_render_mesh_depth,
    LODGS_OT_render_quick,
    LODGS_OT_export_camera,
)
