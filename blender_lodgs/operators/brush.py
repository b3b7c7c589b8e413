"""Select and paint splats as they are seen, by strokes over the viewport, at every level alike.

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
from ...training.lod.brush import brushed, lassoed
from .. import extension
from ..data import cleaning, painting, scenes
from ..viewport.strokes import Picture
from .base import EditLevelsOperator, report_errors

_POINT_APART = 2.0
"""Pixels that the mouse has to move for a lasso's next corner."""


class StrokeOperator(EditLevelsOperator):
    """An operator that does something to the splats of every level under a stroke over the viewport."""

    through: bpy.props.BoolProperty(
        name="Through", description="Also what other splats hide from the view", options={"SKIP_SAVE"}
    )
    radius: bpy.props.IntProperty(
        name="Radius", description="Of the brush, in pixels", default=40, min=1, max=2000, subtype="PIXEL",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    path: bpy.props.CollectionProperty(
        name="Path", type=bpy.types.OperatorMousePath, options={"HIDDEN", "SKIP_SAVE"}
    )

    as_set = ("radius", "through")
    """What a stroke that is drawn takes from ``Scene.lodgs_brush``, unless it is given."""
    shape = "BRUSH"
    hardness = 1.0
    footprints = False
    """Whether splats are hit as far as a brush covers them, not by their means."""

    def prepare(self, root: bpy.types.Object) -> None:
        """Reads what the stroke changes, before it does."""
        raise NotImplementedError

    def show(self, root: bpy.types.Object, hit: dict[int, np.ndarray]) -> None:
        """Has viewports show what the stroke has hit so far."""
        raise NotImplementedError

    def apply(self, root: bpy.types.Object, hit: dict[int, np.ndarray]) -> str:
        """Does it; what was done, in words."""
        raise NotImplementedError

    def leave(self, root: bpy.types.Object | None) -> None:
        """Has viewports show what is, after a stroke that has ended or was cancelled."""
        raise NotImplementedError

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        self.prepare(root)
        path = np.array([point.loc for point in self.path])
        picture = picture_of(context, root)
        return self._finish(root, self._hit(picture, self._covered(picture, path)))

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
        for name in self.as_set:
            if not self.properties.is_property_set(name):
                setattr(self, name, getattr(settings, name))
        root = scenes.active_root(context)
        self.path.clear()
        self._picture = picture_of(context, root)
        self.prepare(root)
        counts = {item.number: len(item.object.data.points) for item in cleaning.levels(root)}
        self._found = {number: np.zeros(count, np.float32) for number, count in counts.items()}
        self._drawn = np.zeros(self._picture.size[::-1], np.float32)
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
                path = np.array([point.loc for point in self.path])
                self._found = self._hit(self._picture, self._covered(self._picture, path))
            return self._finish(root, self._found)
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def _go_to(self, context, event):
        """Takes the stroke on to the mouse; what a brush hits on the way is shown at once."""
        here = event.mouse_region_x + 0.5, event.mouse_region_y + 0.5
        last = np.array(self.path[-1].loc if self.path else here)
        if self.path and np.linalg.norm(last - here) < _POINT_APART:
            return
        self.path.add().loc = here
        context.region.tag_redraw()
        if self.shape == "BRUSH":
            root = self._same_root(context)
            covered = self._covered(self._picture, np.array([last, here]))
            if self.footprints:  # of which one part of the stroke covers less than all of it
                covered = np.maximum(self._drawn, covered, out=self._drawn)
            for number, hit in self._hit(self._picture, covered).items():
                np.maximum(self._found[number], hit, out=self._found[number])
            self.show(root, self._found)

    def _same_root(self, context):
        """The splat scene, as long as it has the levels with which the stroke began: training may go on."""
        root = scenes.active_root(context)
        there = {item.number: len(item.object.data.points) for item in cleaning.levels(root)}
        if there != {number: len(hit) for number, hit in self._found.items()}:
            raise LodgsError("The levels have been renewed during the stroke.", "Draw it again.")
        return root

    def _covered(self, picture: Picture, path: np.ndarray) -> np.ndarray:
        path = np.reshape(path, (-1, 2))
        if self.shape == "LASSO":
            return lassoed(path, picture.size)
        return brushed(path, self.radius, picture.size, self.hardness)

    def _hit(self, picture: Picture, covered: np.ndarray) -> dict[int, np.ndarray]:
        return picture.hits(covered, self.through, self.footprints)

    def _finish(self, root, hit):
        self.report({"INFO"}, self.apply(root, hit))
        return {"FINISHED"}

    def _stop(self, context):
        self.leave(scenes.active_root(context))
        extension.redraw()
        if self._line is not None:
            context.space_data.draw_handler_remove(self._line, "WINDOW")
            self._line = None


class LODGS_OT_select_splats(StrokeOperator, bpy.types.Operator):
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

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "action")
        if self.shape == "BRUSH":
            layout.prop(self, "radius")
        layout.prop(self, "through")

    def prepare(self, root):
        self._before = {item.number: cleaning.selected(item.object.data) for item in cleaning.levels(root)}

    def show(self, root, hit):
        remove = self.action == "REMOVE"
        cleaning.show_selected(root, {
            number: mask & ~(hit[number] > 0) if remove else mask | (hit[number] > 0)
            for number, mask in self._before.items()
        })  # fmt: skip

    def apply(self, root, hit):
        cleaning.select_also(root, hit, self.action == "REMOVE")
        counts = cleaning.count_selected(root)
        by_level = ", ".join(f"level {number} {count:,}" for number, count in counts.items())
        return f"{sum(counts.values()):,} splats selected: {by_level}"

    def leave(self, root):
        cleaning.show_selected(root, {})


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


class LODGS_OT_paint_splats(StrokeOperator, bpy.types.Operator):
    """Paint a colour over the splats of every level that a stroke over the viewport covers"""

    bl_idname = "lodgs.paint_splats"
    bl_label = "Paint Splats"
    bl_options = {"REGISTER", "UNDO"}

    action: bpy.props.EnumProperty(
        name="Do",
        description="What is done with the splats that are hit",
        items=[("PAINT", "Paint", "Put the colour over theirs"), ("ERASE", "Erase", "Bring back their own")],
        options={"SKIP_SAVE"},
    )
    color: bpy.props.FloatVectorProperty(
        name="Colour", description="What is painted, as the display shows it before the look",
        default=(0.8, 0.1, 0.1), min=0, max=1, size=3, subtype="COLOR_GAMMA", options={"SKIP_SAVE"},
    )  # fmt: skip
    strength: bpy.props.FloatProperty(
        name="Strength", description="How much of the colour the stroke puts over the splats' own",
        default=1.0, min=0, max=1, subtype="FACTOR", options={"SKIP_SAVE"},
    )  # fmt: skip
    hardness: bpy.props.FloatProperty(
        name="Hardness", description="Share of the radius in which the brush has its full strength",
        default=0.5, min=0, max=1, subtype="FACTOR", options={"SKIP_SAVE"},
    )  # fmt: skip

    as_set = ("radius", "through", "color", "strength", "hardness")
    footprints = True

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "action")
        if self.action == "PAINT":
            layout.prop(self, "color")
        for name in ("radius", "strength", "hardness", "through"):
            layout.prop(self, name)

    def prepare(self, root):
        self._before = painting.read(root)

    def show(self, root, hit):
        painting.show(root, self._painted(hit))

    def apply(self, root, hit):
        count = painting.write(root, self._painted(hit))
        return f"{count:,} splats of all levels are painted"

    def leave(self, root):
        painting.show(root, {})

    def _painted(self, hit):
        share = {number: self.strength * each for number, each in hit.items()}
        return painting.over(self._before, share, tuple(self.color) if self.action == "PAINT" else None)


class LODGS_OT_remove_paint(EditLevelsOperator, bpy.types.Operator):
    """Show all splats in their own colours again"""

    bl_idname = "lodgs.remove_paint"
    bl_label = "Remove Paint"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        painted = painting.is_painted(scenes.active_root(context))
        if not painted:
            cls.poll_message_set("Nothing is painted")
        return painted

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        painting.write(root, {number: 0 * there for number, there in painting.read(root).items()})
        return {"FINISHED"}


class LODGS_OT_select_all_splats(EditLevelsOperator, bpy.types.Operator):
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


_DRAG = {"type": "LEFTMOUSE", "value": "PRESS"}


def _selects(shape: str):
    """Drag selects; with Ctrl or Shift it deselects."""
    return tuple(
        ("lodgs.select_splats", _DRAG | held, {"properties": [("shape", shape), ("action", action)]})
        for held, action in (({}, "ADD"), ({"ctrl": True}, "REMOVE"), ({"shift": True}, "REMOVE"))
    )


def _turns(name: str, **held):
    """F and the mouse change a number of the brush."""
    properties = {"properties": [("data_path_primary", f"scene.lodgs_brush.{name}")]}
    return "wm.radial_control", {"type": "F", "value": "PRESS"} | held, properties


def _draw_brush(context, tool, xy) -> None:
    draw_circle_2d(xy, (1, 1, 1, 1), context.scene.lodgs_brush.radius, segments=48)


class SplatBrush(bpy.types.WorkSpaceTool):
    """Drag over splats to select them at every level.

    \u2022 Ctrl or Shift to deselect.
    \u2022 F for the size"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.brush"
    bl_label = "Brush Splats"
    bl_icon = "ops.generic.select_circle"
    bl_keymap = (*_selects("BRUSH"), _turns("radius"))
    draw_cursor = staticmethod(_draw_brush)

    @staticmethod
    def draw_settings(context, layout, tool):
        layout.prop(context.scene.lodgs_brush, "radius")
        layout.prop(context.scene.lodgs_brush, "through")


class SplatLasso(bpy.types.WorkSpaceTool):
    """Draw around splats to select them at every level.

    \u2022 Ctrl or Shift to deselect"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.lasso"
    bl_label = "Lasso Splats"
    bl_icon = "ops.generic.select_lasso"
    bl_keymap = _selects("LASSO")

    @staticmethod
    def draw_settings(context, layout, tool):
        layout.prop(context.scene.lodgs_brush, "through")


class SplatPaint(bpy.types.WorkSpaceTool):
    """Drag over splats to paint them at every level.

    \u2022 Ctrl to erase.
    \u2022 F for the size, Shift F for the strength"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.paint"
    bl_label = "Paint Splats"
    bl_icon = "brush.sculpt.paint"
    bl_keymap = (
        ("lodgs.paint_splats", _DRAG, {"properties": [("action", "PAINT")]}),
        ("lodgs.paint_splats", _DRAG | {"ctrl": True}, {"properties": [("action", "ERASE")]}),
        _turns("radius"),
        _turns("strength", shift=True),
    )
    draw_cursor = staticmethod(_draw_brush)

    @staticmethod
    def draw_settings(context, layout, tool):
        for name in ("color", "radius", "strength", "hardness", "through"):
            layout.prop(context.scene.lodgs_brush, name)


TOOLS = (SplatBrush, SplatLasso, SplatPaint)
CLASSES = (
    LODGS_OT_select_splats, LODGS_OT_select_all_splats, LODGS_OT_paint_splats, LODGS_OT_remove_paint,
)  # fmt: skip


def register() -> None:
    bpy.utils.register_tool(SplatBrush, separator=True, group=True)
    bpy.utils.register_tool(SplatLasso, after={SplatBrush.bl_idname})
    bpy.utils.register_tool(SplatPaint, after={SplatLasso.bl_idname})


def unregister() -> None:
    for tool in reversed(TOOLS):
        bpy.utils.unregister_tool(tool)
