"""Clicking on splats selects their scene, as clicking on a mesh selects that."""

from __future__ import annotations

import bpy

from ..data import picking

_keymaps: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class LODGS_OT_select_clicked(bpy.types.Operator):
    """Select the splat scene that is clicked on, where Blender's own click found nothing"""

    bl_idname = "lodgs.select_clicked"
    bl_label = "Select Splat Scene"
    bl_options = {"UNDO", "INTERNAL"}

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and context.region_data is not None

    def invoke(self, context, event):
        nothing = {"CANCELLED", "PASS_THROUGH"}
        if context.selected_objects:  # the press before this click has found them
            return nothing
        return {"FINISHED"} if select(context, (event.mouse_region_x, event.mouse_region_y)) else nothing


def select(context: bpy.types.Context, at: tuple[float, float]) -> bool:
    """Selects the splat scene that the context's viewport shows at a pixel; returns whether there is one.

    Args:
        at: x from the left and y from below.
    """
    region, looks = context.region, context.region_data
    obj = picking.scene_at(
        context.evaluated_depsgraph_get(), context.space_data, looks.view_matrix, looks.window_matrix,
        (region.width, region.height), at,
    )  # fmt: skip
    if obj is None or not obj.visible_get(view_layer=context.view_layer):
        return False
    obj.select_set(True)
    context.view_layer.objects.active = obj
    return True


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
