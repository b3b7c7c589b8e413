"""Select splats as they are seen, with a brush or a lasso over the viewport, at every level alike.

Each stroke is one operator and one undo step; the tools of the toolbar start it, and Blender's own operator
changes the brush's size.
"""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from gpu_extras.presets import draw_circle_2d

from ...training.errors import LodgsError
from .. import extension
from ..data import cleaning, scenes
from ..viewport.strokes import Picture
from .parts import OnOwnLevels, report_errors

_POINT_APART = 2.0
"""Pixels that the mouse has to move for a lasso's next corner."""


class LODGS_OT_select_splats(OnOwnLevels, bpy.types.Operator):
    """Select the splats of every level that a stroke over the viewport covers"""

    bl_idname = "lodgs.select_splats"
    bl_label = "Select Splats"
    bl_options = {"REGISTER", "UNDO"}

    shape: bpy.props.EnumProperty(
        name="With",
        description="What the stroke is",
        items=[("BRUSH", "Brush", "All along the stroke"), ("LASSO", "Lasso", "What the stroke encloses")],
        options={"SKIP_SAVE"},
    )
    action: bpy.props.EnumProperty(
        name="Do",
        description="What is done with the splats that are hit",
        items=[("ADD", "Select", "Select them as well"), ("REMOVE", "Deselect", "Select them no longer")],
        options={"SKIP_SAVE"},
    )
    radius: bpy.props.IntProperty(
        name="Radius", description="Of the brush, in pixels", default=40, min=1, max=2000, subtype="PIXEL",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    through: bpy.props.BoolProperty(
        name="Through", description="Also what other splats hide from the view", options={"SKIP_SAVE"}
    )
    path: bpy.props.CollectionProperty(
        name="Path", type=bpy.types.OperatorMousePath, options={"HIDDEN", "SKIP_SAVE"}
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "action")
        if self.shape == "BRUSH":
            layout.prop(self, "radius")
        layout.prop(self, "through")

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        self._select(root, picture_of(context, root), np.array([point.loc for point in self.path]))
        return self._finish(root)

    def invoke(self, context, event):
        return self._begin(context, event)

    def modal(self, context, event):
        result = self._go_on(context, event)
        if "RUNNING_MODAL" not in result:
            self._stop(context)
        return result

    def cancel(self, context):
        self._stop(context)

    @report_errors
    def _begin(self, context, event):
        settings = context.scene.lodgs_brush
        for name in ("radius", "through"):
            if not self.properties.is_property_set(name):
                setattr(self, name, getattr(settings, name))
        root = scenes.active_root(context)
        self.path.clear()
        self._picture = picture_of(context, root)
        self._before = {item.number: cleaning.selected(item.object.data) for item in cleaning.levels(root)}
        self._found = {number: np.zeros(len(mask), bool) for number, mask in self._before.items()}
        self._line = None
        if self.shape == "LASSO":
            self._line = context.space_data.draw_handler_add(_draw_path, (self.path,), "WINDOW", "POST_PIXEL")
        self._go_to(context, event)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def _go_on(self, context, event):
        if event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._go_to(context, event)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            root = self._same_root(context)
            if self.shape == "LASSO":
                self._select(root, self._picture, np.array([point.loc for point in self.path]))
            else:
                cleaning.select_also(root, self._found, self.action == "REMOVE")
            return self._finish(root)
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def _go_to(self, context, event):
        """Takes the stroke on to the mouse; what a brush hits on the way is shown as selected at once."""
        here = event.mouse_region_x + 0.5, event.mouse_region_y + 0.5
        last = np.array(self.path[-1].loc if self.path else here)
        if self.path and np.linalg.norm(last - here) < _POINT_APART:
            return
        self.path.add().loc = here
        context.region.tag_redraw()
        if self.shape == "BRUSH":
            root, remove = self._same_root(context), self.action == "REMOVE"
            for number, mask in self._picture.brush([last, here], self.radius, self.through).items():
                self._found[number] |= mask
            cleaning.show_selected(root, {
                number: mask & ~self._found[number] if remove else mask | self._found[number]
                for number, mask in self._before.items()
            })  # fmt: skip

    def _same_root(self, context):
        """The splat scene, as long as it has the levels with which the stroke began: training may go on."""
        root = scenes.active_root(context)
        there = {item.number: len(item.object.data.points) for item in cleaning.levels(root)}
        if there != {number: len(mask) for number, mask in self._before.items()}:
            raise LodgsError("The levels have been renewed during the stroke.", "Draw it again.")
        return root

    def _select(self, root, picture, path):
        select_by_stroke(root, picture, path, self.shape, self.radius, self.through, self.action == "REMOVE")

    def _finish(self, root):
        counts = cleaning.count_selected(root)
        by_level = ", ".join(f"level {number} {count:,}" for number, count in counts.items())
        self.report({"INFO"}, f"{sum(counts.values()):,} splats selected: {by_level}")
        return {"FINISHED"}

    def _stop(self, context):
        cleaning.show_selected(scenes.active_root(context), {})
        extension.redraw()
        if self._line is not None:
            context.space_data.draw_handler_remove(self._line, "WINDOW")
            self._line = None


def picture_of(context: bpy.types.Context, root: bpy.types.Object) -> Picture:
    """What the viewport of a context shows of a splat scene.

    Raises:
        LodgsError: the context has no viewport.
    """
    area, looks = context.area, context.region_data
    region = context.region
    if area is not None and area.type == "VIEW_3D" and region.type != "WINDOW":
        region, looks = (next(r for r in area.regions if r.type == "WINDOW"), area.spaces.active.region_3d)
    if looks is None:
        raise LodgsError("Strokes need a 3D viewport to be drawn over.", "Move the mouse into one.")
    return Picture(
        root, context.evaluated_depsgraph_get(), np.array(looks.view_matrix), np.array(looks.window_matrix),
        (region.width, region.height), context.space_data,
    )  # fmt: skip


def select_by_stroke(
    root: bpy.types.Object,
    picture: Picture,
    path: np.ndarray,
    shape: str = "BRUSH",
    radius: float = 40,
    through: bool = False,
    remove: bool = False,
) -> int:
    """Selects the splats that a stroke hits beside those that are, or no longer; how many are then.

    Args:
        path: (P, 2) in the region's pixels.
        shape: "BRUSH" or "LASSO".
        through: see ``Picture.brush``.
    """
    path = np.reshape(path, (-1, 2))
    found = picture.lasso(path, through) if shape == "LASSO" else picture.brush(path, radius, through)
    return cleaning.select_also(root, found, remove)


class LODGS_OT_select_all_splats(OnOwnLevels, bpy.types.Operator):
    """Deselect the splats of all levels, or select just the others"""

    bl_idname = "lodgs.select_all_splats"
    bl_label = "Select All Splats"
    bl_options = {"REGISTER", "UNDO"}

    action: bpy.props.EnumProperty(
        name="Do",
        description="What is done",
        items=[
            ("DESELECT", "Deselect", "Select none"),
            ("INVERT", "Invert", "Select what is not selected, and deselect the rest"),
        ],
    )

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        invert = self.action == "INVERT"
        cleaning.select(
            root,
            cleaning.find(root, lambda cloud: np.full(len(cloud.points), invert) & ~cleaning.selected(cloud)),
        )
        return {"FINISHED"}


def _draw_path(path) -> None:
    """The line of a lasso, closed."""
    points = [tuple(point.loc) for point in path]
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", 1.5)
    shader.uniform_float("color", (1, 1, 1, 0.9))
    batch_for_shader(shader, "LINE_STRIP", {"pos": [(*point, 0) for point in (*points, *points[:1])]}).draw(
        shader
    )


def _keymap(shape: str):
    """Drag selects; with Ctrl or Shift it deselects."""
    drag = {"type": "LEFTMOUSE", "value": "PRESS"}
    return tuple(
        ("lodgs.select_splats", drag | held, {"properties": [("shape", shape), ("action", action)]})
        for held, action in (({}, "ADD"), ({"ctrl": True}, "REMOVE"), ({"shift": True}, "REMOVE"))
    )


class SplatBrush(bpy.types.WorkSpaceTool):
    """Drag over splats to select them at every level.

    \u2022 Ctrl or Shift to deselect.
    \u2022 F for the size"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.brush"
    bl_label = "Brush Splats"
    bl_icon = "ops.generic.select_circle"
    bl_keymap = (
        *_keymap("BRUSH"),
        (
            "wm.radial_control",
            {"type": "F", "value": "PRESS"},
            {"properties": [("data_path_primary", "scene.lodgs_brush.radius")]},
        ),
    )

    @staticmethod
    def draw_settings(context, layout, tool):
        layout.prop(context.scene.lodgs_brush, "radius")
        layout.prop(context.scene.lodgs_brush, "through")

    @staticmethod
    def draw_cursor(context, tool, xy):
        draw_circle_2d(xy, (1, 1, 1, 1), context.scene.lodgs_brush.radius, segments=48)


class SplatLasso(bpy.types.WorkSpaceTool):
    """Draw around splats to select them at every level.

    \u2022 Ctrl or Shift to deselect"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.lasso"
    bl_label = "Lasso Splats"
    bl_icon = "ops.generic.select_lasso"
    bl_keymap = _keymap("LASSO")

    @staticmethod
    def draw_settings(context, layout, tool):
        layout.prop(context.scene.lodgs_brush, "through")


TOOLS = (SplatBrush, SplatLasso)
CLASSES = (LODGS_OT_select_splats, LODGS_OT_select_all_splats)


def register() -> None:
    bpy.utils.register_tool(SplatBrush, separator=True, group=True)
    bpy.utils.register_tool(SplatLasso, after={SplatBrush.bl_idname})


def unregister() -> None:
    for tool in reversed(TOOLS):
        bpy.utils.unregister_tool(tool)
