"""Clicking on splats selects their scene, as clicking on a mesh selects that."""

from __future__ import annotations

import bpy
import numpy as np
from bpy_extras import view3d_utils

from .. import viewport
from ..data import picking
from ..data.shown import is_splats

_PRESSED = "3D View Tool: Tweak", "3D View Tool: Tweak (fallback)"
"""Keymaps of tools in which Blender selects when the button is pressed: no click comes where that changes
something. In all others it does so by a click, and a keymap of an extension's is asked before."""
_keymaps: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class LODGS_OT_select_clicked(bpy.types.Operator):
    """Select what is clicked on, splat scenes too"""

    bl_idname = "lodgs.select_clicked"
    bl_label = "Select"
    bl_options = {"UNDO", "INTERNAL"}

    pressed: bpy.props.BoolProperty(
        name="Pressed",
        description="Blender has selected what is there when the button was pressed; otherwise it does now",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context):
        there = any(map(is_splats, bpy.data.pointclouds))  # without splats all is Blender's
        return there and context.mode == "OBJECT" and context.region_data is not None

    def invoke(self, context, event):
        at = event.mouse_region_x, event.mouse_region_y
        if self.pressed:
            clicked = not _dragged(context, event) and select(context, at)
            return {"FINISHED"} if clicked else {"CANCELLED", "PASS_THROUGH"}
        if not _selects_by_left(context):
            return {"CANCELLED", "PASS_THROUGH"}
        changed = _blenders_own(at)
        return {"FINISHED"} if select(context, at) or changed else {"CANCELLED"}


def _blenders_own(at: tuple[int, int]) -> bool:
    """What Blender's own click does; whether that changes what is selected."""
    return "FINISHED" in bpy.ops.view3d.select(deselect_all=True, location=at)


def _dragged(context: bpy.types.Context, event: bpy.types.Event) -> bool:
    """Whether the mouse has moved since its button was pressed."""
    ways = event.mouse_x - event.mouse_prev_press_x, event.mouse_y - event.mouse_prev_press_y
    return max(map(abs, ways)) > context.preferences.inputs.drag_threshold_mouse


def _selects_by_left(context: bpy.types.Context) -> bool:
    settings = context.window_manager.keyconfigs.active.preferences
    return getattr(settings, "select_mouse", "LEFT") == "LEFT"


def select(context: bpy.types.Context, at: tuple[float, float]) -> bool:
    """Selects the splat scene that the context's viewport shows at a pixel, after Blender's own click there:
    in place of nothing, or of the one mesh that it found although splats hide it.

    Args:
        at: x from the left and y from below.

    Returns:
        Whether there is such a scene.
    """
    region, looks, before = context.region, context.region_data, np.inf
    others = context.selected_objects
    if others:
        depth = _depth_of_mesh(context, at, others)
        if depth is None:
            return False
        before = depth
    obj = picking.scene_at(
        context.evaluated_depsgraph_get(), context.space_data, looks.view_matrix, looks.window_matrix,
        (region.width, region.height), at, before,
    )  # fmt: skip
    if obj is None or not obj.visible_get(view_layer=context.view_layer):
        return False
    for other in others:
        other.select_set(False)
    obj.select_set(True)
    context.view_layer.objects.active = obj
    return True


def _depth_of_mesh(
    context: bpy.types.Context, at: tuple[float, float], selected: list[bpy.types.Object]
) -> float | None:
    """Depth in the world of the surface at a pixel; None where it is none of the one selected object, or the
    viewport draws no splats that could hide it."""
    if len(selected) > 1 or not viewport.draws_splats(context.scene, context.space_data):
        return None
    region, view = context.region, context.region_data
    eye = view3d_utils.region_2d_to_origin_3d(region, view, at)
    ahead = view3d_utils.region_2d_to_vector_3d(region, view, at)
    hit, place, *_, obj, _ = context.scene.ray_cast(context.evaluated_depsgraph_get(), eye, ahead)
    if not hit or obj != selected[0]:
        return None
    return -(view.view_matrix @ place).z


CLASSES = (LODGS_OT_select_clicked,)


def register() -> None:
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    if keyconfig is not None:  # not in background
        verb = LODGS_OT_select_clicked.bl_idname
        keymap = keyconfig.keymaps.new(name="Object Mode")
        _keymaps.append((keymap, keymap.keymap_items.new(verb, "LEFTMOUSE", "CLICK")))
        for name in _PRESSED:
            keymap = keyconfig.keymaps.new(name=name, space_type="VIEW_3D", region_type="WINDOW", tool=True)
            item = keymap.keymap_items.new(verb, "LEFTMOUSE", "RELEASE")
            item.properties.pressed = True
            _keymaps.append((keymap, item))


def unregister() -> None:
    for keymap, item in _keymaps:
        keymap.keymap_items.remove(item)
    _keymaps.clear()
