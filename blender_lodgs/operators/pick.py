"""Clicking on splats selects their scene, as clicking on a mesh selects that."""

from __future__ import annotations

import bpy
import numpy as np
from bpy_extras import view3d_utils

from .. import viewport
from ..data import picking

_keymaps: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class LODGS_OT_select_clicked(bpy.types.Operator):
    """Select the splat scene that is clicked on, where Blender's own click found nothing or what is behind"""

    bl_idname = "lodgs.select_clicked"
    bl_label = "Select Splat Scene"
    bl_options = {"UNDO", "INTERNAL"}

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and context.region_data is not None

    def invoke(self, context, event):
        chosen = select(context, (event.mouse_region_x, event.mouse_region_y))
        return {"FINISHED"} if chosen else {"CANCELLED", "PASS_THROUGH"}


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
        keymap = keyconfig.keymaps.new(name="Object Mode")
        item = keymap.keymap_items.new(LODGS_OT_select_clicked.bl_idname, "LEFTMOUSE", "CLICK")
        _keymaps.append((keymap, item))


def unregister() -> None:
    for keymap, item in _keymaps:
        keymap.keymap_items.remove(item)
    _keymaps.clear()
