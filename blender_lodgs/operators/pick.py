"""Select a splat scene by clicking on its splats in the viewport."""

from __future__ import annotations

import bpy
import numpy as np
from bpy_extras import view3d_utils

from .. import viewport
from ..data import picking
from ..data.shown import is_splats

_PRESS_KEYMAPS = "3D View Tool: Tweak", "3D View Tool: Tweak (fallback)"
"""Tool keymaps in which Blender selects on press; no click event follows a press that changes the selection.
In all others it selects on click, after the extension's keymap."""
_keymaps: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class LODGS_OT_select_clicked(bpy.types.Operator):
    """Select the object or splat scene under the mouse"""

    bl_idname = "lodgs.select_clicked"
    bl_label = "Select"
    bl_options = {"UNDO", "INTERNAL"}

    pressed: bpy.props.BoolProperty(
        name="Pressed",
        description="Blender has already selected on press, so its own click is not repeated",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context):
        has_splats = any(map(is_splats, bpy.data.pointclouds))  # without splats Blender handles every click
        return has_splats and context.mode == "OBJECT" and context.region_data is not None

    def invoke(self, context, event):
        pixel = event.mouse_region_x, event.mouse_region_y
        if self.pressed:
            selected = not _dragged(context, event) and select(context, pixel)
            return {"FINISHED"} if selected else {"CANCELLED", "PASS_THROUGH"}
        if not _left_click_selects(context):
            return {"CANCELLED", "PASS_THROUGH"}
        changed = _blender_click(pixel)
        return {"FINISHED"} if select(context, pixel) or changed else {"CANCELLED"}


def _blender_click(pixel: tuple[int, int]) -> bool:
    """Run Blender's own click and return True if it changes the selection."""
    return "FINISHED" in bpy.ops.view3d.select(deselect_all=True, location=pixel)


def _dragged(context: bpy.types.Context, event: bpy.types.Event) -> bool:
    """Return True if the mouse has moved since its button was pressed."""
    offset = event.mouse_x - event.mouse_prev_press_x, event.mouse_y - event.mouse_prev_press_y
    return max(map(abs, offset)) > context.preferences.inputs.drag_threshold_mouse


def _left_click_selects(context: bpy.types.Context) -> bool:
    settings = context.window_manager.keyconfigs.active.preferences
    return getattr(settings, "select_mouse", "LEFT") == "LEFT"


def select(context: bpy.types.Context, pixel: tuple[float, float]) -> bool:
    """Select the splat scene at a pixel of the context's viewport, after Blender's own click there.

    The scene is selected if Blender's click selected nothing, or one mesh that splats hide.

    Args:
        pixel: x from the left and y from the bottom.

    Returns:
        True if a scene is selected.
    """
    region = context.region
    view = context.region_data
    max_depth = np.inf
    selected = context.selected_objects
    if selected:
        depth = _depth_of_mesh(context, pixel, selected)
        if depth is None:
            return False
        max_depth = depth
    obj = picking.scene_at(
        context.evaluated_depsgraph_get(), context.space_data, view.view_matrix, view.window_matrix,
        (region.width, region.height), pixel, max_depth,
    )  # fmt: skip
    if obj is None or not obj.visible_get(view_layer=context.view_layer):
        return False
    for deselected in selected:
        deselected.select_set(False)
    obj.select_set(True)
    context.view_layer.objects.active = obj
    return True


def _depth_of_mesh(
    context: bpy.types.Context, pixel: tuple[float, float], selected: list[bpy.types.Object]
) -> float | None:
    """Return the depth of the selected object's surface at a pixel, in world units.

    None if several objects are selected, another surface is at the pixel, or the viewport draws no splats.
    """
    if len(selected) > 1 or not viewport.draws_splats(context.scene, context.space_data):
        return None
    region = context.region
    view = context.region_data
    origin = view3d_utils.region_2d_to_origin_3d(region, view, pixel)
    direction = view3d_utils.region_2d_to_vector_3d(region, view, pixel)
    hit, point, *_, obj, _ = context.scene.ray_cast(context.evaluated_depsgraph_get(), origin, direction)
    if not hit or obj != selected[0]:
        return None
    return -(view.view_matrix @ point).z


CLASSES = (LODGS_OT_select_clicked,)


def register() -> None:
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    if keyconfig is not None:  # not in background
        idname = LODGS_OT_select_clicked.bl_idname
        keymap = keyconfig.keymaps.new(name="Object Mode")
        _keymaps.append((keymap, keymap.keymap_items.new(idname, "LEFTMOUSE", "CLICK")))
        for name in _PRESS_KEYMAPS:
            keymap = keyconfig.keymaps.new(name=name, space_type="VIEW_3D", region_type="WINDOW", tool=True)
            item = keymap.keymap_items.new(idname, "LEFTMOUSE", "RELEASE")
            item.properties.pressed = True
            _keymaps.append((keymap, item))


def unregister() -> None:
    for keymap, item in _keymaps:
        keymap.keymap_items.remove(item)
    _keymaps.clear()
