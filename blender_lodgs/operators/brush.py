"""Brush and lasso strokes over the viewport that select or paint the splats of every level.

Each stroke is one operator call and one undo step. Toolbar tools start it; Blender's radial control changes
the brush size.
"""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from gpu_extras.presets import draw_circle_2d

from ...training.editing.brush import brush_coverage, lasso_coverage
from ...training.errors import LodgsError
from .. import extension
from ..data import cleaning, painting, roots
from ..viewport.strokes import StrokeTarget
from .base import EditLevelsOperator, report_errors

_MIN_MOUSE_STEP = 2.0
"""Minimum distance in pixels between two points of a stroke."""


class StrokeOperator(EditLevelsOperator):
    """Base class of operators that change the splats of every level under a stroke over the viewport."""

    through: bpy.props.BoolProperty(
        name="Through",
        description="Include splats that other splats hide from the view",
        options={"SKIP_SAVE"},
    )
    radius: bpy.props.IntProperty(
        name="Radius", description="Radius of the brush", default=40, min=1, max=2000, subtype="PIXEL",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    path: bpy.props.CollectionProperty(
        name="Path", type=bpy.types.OperatorMousePath, options={"HIDDEN", "SKIP_SAVE"}
    )

    brush_settings = ("radius", "through")
    """Properties that a drawn stroke copies from ``Scene.lodgs_brush`` unless they are set."""
    shape = "BRUSH"
    hardness = 1.0
    footprints = False
    """True if a splat is hit in proportion to the brush's cover of its footprint, not by its mean."""

    def prepare(self, root: bpy.types.Object) -> None:
        """Store the state that the stroke changes, before it starts."""
        raise NotImplementedError

    def show(self, root: bpy.types.Object, hits: dict[int, np.ndarray]) -> None:
        """Preview in viewports the splats that the stroke has hit so far."""
        raise NotImplementedError

    def apply(self, root: bpy.types.Object, hits: dict[int, np.ndarray]) -> str:
        """Apply the stroke and return the operator's report."""
        raise NotImplementedError

    def end_preview(self, root: bpy.types.Object | None) -> None:
        """End the preview after a stroke that was finished or cancelled."""
        raise NotImplementedError

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        self.prepare(root)
        path = np.array([point.loc for point in self.path])
        target = stroke_target(context, root)
        return self._finish(root, self._find_hits(target, self._cover(target, path)))

    def invoke(self, context, event):
        return self._start(context, event)

    def modal(self, context, event):
        result = self._handle_event(context, event)
        if "RUNNING_MODAL" not in result:
            self._stop(context)
        return result

    def cancel(self, context):
        self._stop(context)

    @report_errors
    def _start(self, context, event):
        settings = context.scene.lodgs_brush
        for name in self.brush_settings:
            if not self.properties.is_property_set(name):
                setattr(self, name, getattr(settings, name))
        root = roots.active_root(context)
        self.path.clear()
        self._target = stroke_target(context, root)
        self.prepare(root)
        counts = {item.number: len(item.object.data.points) for item in root.lodgs.existing_levels}
        self._hits = {number: np.zeros(count, np.float32) for number, count in counts.items()}
        self._stroke_cover = np.zeros(self._target.size[::-1], np.float32)
        self._lasso_handle = None
        if self.shape == "LASSO":
            self._lasso_handle = context.space_data.draw_handler_add(
                _draw_lasso, (self.path,), "WINDOW", "POST_PIXEL"
            )
        self._extend_path(context, event)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def _handle_event(self, context, event):
        if event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            self._extend_path(context, event)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            root = self._unchanged_root(context)
            if self.shape == "LASSO":
                path = np.array([point.loc for point in self.path])
                self._hits = self._find_hits(self._target, self._cover(self._target, path))
            return self._finish(root, self._hits)
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def _extend_path(self, context, event):
        """Extend the stroke to the mouse and preview the splats that a brush hits on the way."""
        mouse = event.mouse_region_x + 0.5, event.mouse_region_y + 0.5
        last = np.array(self.path[-1].loc if self.path else mouse)
        if self.path and np.linalg.norm(last - mouse) < _MIN_MOUSE_STEP:
            return
        self.path.add().loc = mouse
        context.region.tag_redraw()
        if self.shape == "BRUSH":
            root = self._unchanged_root(context)
            cover = self._cover(self._target, np.array([last, mouse]))
            if self.footprints:  # a footprint can reach beyond this segment of the stroke
                cover = np.maximum(self._stroke_cover, cover, out=self._stroke_cover)
            for number, hit in self._find_hits(self._target, cover).items():
                np.maximum(self._hits[number], hit, out=self._hits[number])
            self.show(root, self._hits)

    def _unchanged_root(self, context):
        """Return the scene root if its levels are unchanged since the stroke began.

        Raises:
            LodgsError: a level was replaced.
        """
        root = roots.active_root(context)
        counts = {item.number: len(item.object.data.points) for item in root.lodgs.existing_levels}
        if counts != {number: len(hit) for number, hit in self._hits.items()}:
            raise LodgsError("Cannot finish the stroke: training replaced the levels.", "Draw it again.")
        return root

    def _cover(self, target: StrokeTarget, path: np.ndarray) -> np.ndarray:
        path = np.reshape(path, (-1, 2))
        if self.shape == "LASSO":
            return lasso_coverage(path, target.size)
        return brush_coverage(path, self.radius, target.size, self.hardness)

    def _find_hits(self, target: StrokeTarget, cover: np.ndarray) -> dict[int, np.ndarray]:
        return target.hits(cover, self.through, self.footprints)

    def _finish(self, root, hits):
        self.report({"INFO"}, self.apply(root, hits))
        return {"FINISHED"}

    def _stop(self, context):
        self.end_preview(roots.active_root(context))
        extension.redraw()
        if self._lasso_handle is not None:
            context.space_data.draw_handler_remove(self._lasso_handle, "WINDOW")
            self._lasso_handle = None


class LODGS_OT_select_splats(StrokeOperator, bpy.types.Operator):
    """Select the splats of every level under a stroke over the viewport"""

    bl_idname = "lodgs.select_splats"
    bl_label = "Select Splats"
    bl_options = {"REGISTER", "UNDO"}

    shape: bpy.props.EnumProperty(
        name="Shape",
        description="Shape of the stroke",
        items=[
            ("BRUSH", "Brush", "Splats within the radius of the stroke"),
            ("LASSO", "Lasso", "Splats enclosed by the stroke"),
        ],
        options={"SKIP_SAVE"},
    )
    action: bpy.props.EnumProperty(
        name="Action",
        description="Action on the splats under the stroke",
        items=[
            ("ADD", "Select", "Add the splats to the selection"),
            ("REMOVE", "Deselect", "Remove the splats from the selection"),
        ],
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
        self._selected = {
            item.number: cleaning.selected_mask(item.object.data) for item in root.lodgs.existing_levels
        }

    def show(self, root, hits):
        remove = self.action == "REMOVE"
        cleaning.preview_selection(root, {
            number: mask & ~(hits[number] > 0) if remove else mask | (hits[number] > 0)
            for number, mask in self._selected.items()
        })  # fmt: skip

    def apply(self, root, hits):
        cleaning.extend_selection(root, hits, self.action == "REMOVE")
        counts = cleaning.count_selected(root)
        by_level = ", ".join(f"level {number} {count:,}" for number, count in counts.items())
        return f"{sum(counts.values()):,} splats selected: {by_level}"

    def end_preview(self, root):
        cleaning.preview_selection(root, {})


def stroke_target(context: bpy.types.Context, root: bpy.types.Object) -> StrokeTarget:
    """Return a splat scene's image in the viewport of a context.

    Raises:
        LodgsError: the context has no viewport.
    """
    area = context.area
    region = context.region
    view = context.region_data
    if area is not None and area.type == "VIEW_3D" and region.type != "WINDOW":
        region = next(r for r in area.regions if r.type == "WINDOW")
        view = area.spaces.active.region_3d
    if view is None:
        raise LodgsError("Cannot draw a stroke: no 3D viewport is active.", "Move the mouse into one.")
    return StrokeTarget(
        root, context.evaluated_depsgraph_get(), np.array(view.view_matrix), np.array(view.window_matrix),
        (region.width, region.height), context.space_data,
    )  # fmt: skip


class LODGS_OT_paint_splats(StrokeOperator, bpy.types.Operator):
    """Paint a colour on the splats of every level under a stroke over the viewport"""

    bl_idname = "lodgs.paint_splats"
    bl_label = "Paint Splats"
    bl_options = {"REGISTER", "UNDO"}

    action: bpy.props.EnumProperty(
        name="Action",
        description="Action on the splats under the stroke",
        items=[
            ("PAINT", "Paint", "Blend the colour over the splats"),
            ("ERASE", "Erase", "Restore the splats' trained colours"),
        ],
        options={"SKIP_SAVE"},
    )
    color: bpy.props.FloatVectorProperty(
        name="Colour", description="Colour to paint, before the scene's look is applied",
        default=(0.8, 0.1, 0.1), min=0, max=1, size=3, subtype="COLOR_GAMMA", options={"SKIP_SAVE"},
    )  # fmt: skip
    strength: bpy.props.FloatProperty(
        name="Strength", description="Opacity of the painted colour over the splats' own",
        default=1.0, min=0, max=1, subtype="FACTOR", options={"SKIP_SAVE"},
    )  # fmt: skip
    hardness: bpy.props.FloatProperty(
        name="Hardness", description="Fraction of the radius at full strength; the rest falls off",
        default=0.5, min=0, max=1, subtype="FACTOR", options={"SKIP_SAVE"},
    )  # fmt: skip

    brush_settings = ("radius", "through", "color", "strength", "hardness")
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
        self._paint = painting.read_paint(root)

    def show(self, root, hits):
        painting.preview_paint(root, self._blend(hits))

    def apply(self, root, hits):
        count = painting.write_paint(root, self._blend(hits))
        return f"{count:,} painted splats in all levels"

    def end_preview(self, root):
        painting.preview_paint(root, {})

    def _blend(self, hits):
        alpha = {number: self.strength * hit for number, hit in hits.items()}
        return painting.blend(self._paint, alpha, tuple(self.color) if self.action == "PAINT" else None)


class LODGS_OT_remove_paint(EditLevelsOperator, bpy.types.Operator):
    """Remove all paint and restore the splats' trained colours"""

    bl_idname = "lodgs.remove_paint"
    bl_label = "Remove Paint"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        painted = painting.is_painted(roots.active_root(context))
        if not painted:
            cls.poll_message_set("No splats are painted")
        return painted

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        painting.write_paint(root, {number: 0 * paint for number, paint in painting.read_paint(root).items()})
        return {"FINISHED"}


class LODGS_OT_select_all_splats(EditLevelsOperator, bpy.types.Operator):
    """Deselect all splats of every level, or invert the selection"""

    bl_idname = "lodgs.select_all_splats"
    bl_label = "Change Splat Selection"
    bl_options = {"REGISTER", "UNDO"}

    action: bpy.props.EnumProperty(
        name="Action",
        description="Change of the selection",
        items=[
            ("DESELECT", "Deselect", "Deselect all splats"),
            ("INVERT", "Invert", "Invert the selection"),
        ],
    )

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        invert = self.action == "INVERT"
        cleaning.select(
            root,
            cleaning.find(
                root, lambda cloud: np.full(len(cloud.points), invert) & ~cleaning.selected_mask(cloud)
            ),
        )
        return {"FINISHED"}


def _draw_lasso(path) -> None:
    """Draw the closed outline of a lasso."""
    points = [tuple(point.loc) for point in path]
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", 1.5)
    shader.uniform_float("color", (1, 1, 1, 0.9))
    batch_for_shader(shader, "LINE_STRIP", {"pos": [(*point, 0) for point in (*points, *points[:1])]}).draw(
        shader
    )


_DRAG = {"type": "LEFTMOUSE", "value": "PRESS"}


def _select_keys(shape: str):
    """Return key map items: drag selects; Ctrl or Shift deselects."""
    return tuple(
        ("lodgs.select_splats", _DRAG | modifiers, {"properties": [("shape", shape), ("action", action)]})
        for modifiers, action in (({}, "ADD"), ({"ctrl": True}, "REMOVE"), ({"shift": True}, "REMOVE"))
    )


def _radial_key(name: str, **modifiers):
    """Return the key map item that changes a brush setting with F and the mouse."""
    properties = {"properties": [("data_path_primary", f"scene.lodgs_brush.{name}")]}
    return "wm.radial_control", {"type": "F", "value": "PRESS"} | modifiers, properties


def _draw_brush(context, tool, xy) -> None:
    draw_circle_2d(xy, (1, 1, 1, 1), context.scene.lodgs_brush.radius, segments=48)


class SplatBrush(bpy.types.WorkSpaceTool):
    """Drag over splats to select them at every level.

    \u2022 Ctrl or Shift to deselect.
    \u2022 F to change the radius"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.brush"
    bl_label = "Brush Splats"
    bl_icon = "ops.generic.select_circle"
    bl_keymap = (*_select_keys("BRUSH"), _radial_key("radius"))
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
    bl_keymap = _select_keys("LASSO")

    @staticmethod
    def draw_settings(context, layout, tool):
        layout.prop(context.scene.lodgs_brush, "through")


class SplatPaint(bpy.types.WorkSpaceTool):
    """Drag over splats to paint them at every level.

    \u2022 Ctrl to erase.
    \u2022 F to change the radius, Shift F the strength"""

    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "lodgs.paint"
    bl_label = "Paint Splats"
    bl_icon = "brush.sculpt.paint"
    bl_keymap = (
        ("lodgs.paint_splats", _DRAG, {"properties": [("action", "PAINT")]}),
        ("lodgs.paint_splats", _DRAG | {"ctrl": True}, {"properties": [("action", "ERASE")]}),
        _radial_key("radius"),
        _radial_key("strength", shift=True),
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
