"""Where a splat scene stands, on which ground and how large; and where to stand, to see it."""

from __future__ import annotations

import bpy

from ..data import flights, ground, photographs, scenes
from .base import SceneOperator, report_errors


class LODGS_OT_frame_scene(SceneOperator, bpy.types.Operator):
    """Have most of the splat scene in sight of the viewports, whatever far outliers it has"""

    bl_idname = "lodgs.frame_scene"
    bl_label = "Frame Splat Scene"

    def execute(self, context):
        photographs.frame(context, scenes.active_root(context))
        return {"FINISHED"}


class LODGS_OT_set_ground(SceneOperator, bpy.types.Operator):
    """Lay the splat scene on its ground, which is at Z = 0 then. The root keeps its location and angles"""

    bl_idname = "lodgs.set_ground"
    bl_label = "Set Ground"
    bl_options = {"REGISTER", "UNDO"}

    by: bpy.props.EnumProperty(
        name="Ground",
        description="What says where the ground is",
        items=[
            (
                "SELECTION",
                "Selection",
                "Three or more points that are selected in Edit Mode, or empties in Object Mode: a plane "
                "through three, the one that fits best of more",
            ),
            ("FOUND", "Found", "The plane that many points are on and hardly any are below"),
        ],
    )
    flip: bpy.props.BoolProperty(name="Flip", description="Turn the scene upside down")

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        places = ground.picked(context) if self.by == "SELECTION" else None
        degrees = ground.lay_on_ground(root, places, self.flip)
        self.report({"INFO"}, f"Its ground is at Z = 0 now: '{root.name}' was turned by {degrees:.1f}°")
        return {"FINISHED"}


class LODGS_OT_set_scale(SceneOperator, bpy.types.Operator):
    """Give the splat scene its size, by the length between two points or empties that are selected"""

    bl_idname = "lodgs.set_scale"
    bl_label = "Set Scale"
    bl_options = {"REGISTER", "UNDO"}

    length: bpy.props.FloatProperty(
        name="Length",
        description="How far the two selected places are apart in truth",
        default=1.0,
        min=1e-6,
        soft_max=1e4,
        precision=4,
        unit="LENGTH",
        options={"SKIP_SAVE"},
    )

    @report_errors
    def _measure(self, context):
        self.length = ground.measured(ground.picked(context))
        return {"FINISHED"}

    def invoke(self, context, event):
        if self._measure(context) != {"FINISHED"}:
            return {"CANCELLED"}
        return context.window_manager.invoke_props_dialog(self)

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        factor = self.length / ground.measured(ground.picked(context))
        ground.scale(root, factor)
        same = abs(factor - 1) < 1e-4
        size = "as large as it was" if same else f"{factor:.4g} times as large"
        self.report({"INFO"}, f"'{root.name}' is {size}")
        return {"FINISHED"}


class LODGS_OT_camera_path(SceneOperator, bpy.types.Operator):
    """Add a camera that goes along the photographs by name, smoothed, in the scene's frames"""

    bl_idname = "lodgs.camera_path"
    bl_label = "Add Camera Path"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        camera = flights.path(context, scenes.active_root(context))
        self.report({"INFO"}, f"'{camera.name}' is the scene's camera")
        return {"FINISHED"}


class LODGS_OT_turntable(SceneOperator, bpy.types.Operator):
    """Add a camera that goes once around the splat scene in the scene's frames"""

    bl_idname = "lodgs.turntable"
    bl_label = "Add Turntable"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        camera = flights.turntable(context, scenes.active_root(context))
        self.report({"INFO"}, f"'{camera.name}' is the scene's camera")
        return {"FINISHED"}


CLASSES = (
    LODGS_OT_frame_scene,
    LODGS_OT_set_ground,
    LODGS_OT_set_scale,
    LODGS_OT_camera_path,
    LODGS_OT_turntable,
)
