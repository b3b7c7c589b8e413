"""Operators for a splat scene's ground, scale and moving cameras."""

from __future__ import annotations

import bpy

from ..data import camera_animation, ground, photographs, roots
from .base import SceneOperator, report_errors


class LODGS_OT_frame_scene(SceneOperator, bpy.types.Operator):
    """Move the viewports to show the subject of the splat scene, without far background and outliers"""

    bl_idname = "lodgs.frame_scene"
    bl_label = "Frame Splat Scene"

    def execute(self, context):
        photographs.frame_scene(context, roots.active_root(context))
        return {"FINISHED"}


class LODGS_OT_set_ground(SceneOperator, bpy.types.Operator):
    """Move the splat scene so that its ground lies at Z = 0, and keep the root's location and rotation"""

    bl_idname = "lodgs.set_ground"
    bl_label = "Set Ground"
    bl_options = {"REGISTER", "UNDO"}

    by: bpy.props.EnumProperty(
        name="Ground",
        description="Source of the ground plane",
        items=[
            (
                "SELECTION",
                "Selection",
                "Fit the plane to three or more points selected in Edit Mode, or empties selected in Object "
                "Mode",
            ),
            ("DETECT", "Detect", "Find the plane that holds many points and has few points below it"),
        ],
    )
    flip: bpy.props.BoolProperty(
        name="Flip", description="Turn the scene upside down; enable if the ground faces down"
    )

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        points = ground.picked_positions(context) if self.by == "SELECTION" else None
        degrees = ground.align_to_ground(root, points, self.flip)
        self.report({"INFO"}, f"Ground set to Z = 0: '{root.name}' rotated by {degrees:.1f}°")
        return {"FINISHED"}


class LODGS_OT_set_scale(SceneOperator, bpy.types.Operator):
    """Scale the splat scene by the true distance between two selected points or empties"""

    bl_idname = "lodgs.set_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}

    length: bpy.props.FloatProperty(
        name="Length",
        description="True distance between the two selected points",
        default=1.0,
        min=1e-6,
        soft_max=1e4,
        precision=4,
        unit="LENGTH",
        options={"SKIP_SAVE"},
    )

    @report_errors
    def _measure(self, context):
        self.length = ground.measure_distance(ground.picked_positions(context))
        return {"FINISHED"}

    def invoke(self, context, event):
        if self._measure(context) != {"FINISHED"}:
            return {"CANCELLED"}
        return context.window_manager.invoke_props_dialog(self)

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        factor = self.length / ground.measure_distance(ground.picked_positions(context))
        ground.scale(root, factor)
        unchanged = abs(factor - 1) < 1e-4
        self.report(
            {"INFO"}, f"'{root.name}' unchanged" if unchanged else f"'{root.name}' scaled by {factor:.4g}"
        )
        return {"FINISHED"}


class LODGS_OT_camera_path(SceneOperator, bpy.types.Operator):
    """Add a camera that follows the training cameras on a smooth path over the frame range"""

    bl_idname = "lodgs.camera_path"
    bl_label = "Add Camera Path"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        camera = camera_animation.add_path(context, roots.active_root(context))
        self.report({"INFO"}, f"'{camera.name}' is the active camera")
        return {"FINISHED"}


class LODGS_OT_turntable(SceneOperator, bpy.types.Operator):
    """Add a camera that circles the splat scene once over the frame range"""

    bl_idname = "lodgs.turntable"
    bl_label = "Add Turntable"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        camera = camera_animation.add_turntable(context, roots.active_root(context))
        self.report({"INFO"}, f"'{camera.name}' is the active camera")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_frame_scene,
    LODGS_OT_set_ground,
    LODGS_OT_set_scale,
    LODGS_OT_camera_path,
    LODGS_OT_turntable,
)
