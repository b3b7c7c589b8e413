"""The Compare panel: the views with how alike they are to their photographs, and the wipe."""

from __future__ import annotations

import bpy

from .. import compare, scenes
from .training import say


class LODGS_UL_views(bpy.types.UIList):
    worst_first: bpy.props.BoolProperty(
        name="Worst First", description="List the views that are least like their photographs first"
    )

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        psnr = item.data.lodgs.psnr
        split = layout.split(factor=0.7)
        chosen = item == context.scene.camera
        split.label(text=item.name, icon="VIEW_CAMERA" if chosen else "CAMERA_DATA")
        split.label(text=f"{psnr:.1f} dB" if psnr > 0 else "")

    def draw_filter(self, context, layout):
        row = layout.row(align=True)
        row.prop(self, "filter_name", text="")
        row.prop(self, "worst_first", text="", icon="SORT_ASC")

    def filter_items(self, context, data, propname):
        things, letters = getattr(data, propname), self.filter_name.lower()
        shown = [
            self.bitflag_filter_item * (thing.type == "CAMERA" and letters in thing.name.lower())
            for thing in things
        ]

        def order(index: int):
            psnr = things[index].data.lodgs.psnr if things[index].type == "CAMERA" else 0
            return (psnr or float("inf")) if self.worst_first else 0, things[index].name

        place = [0] * len(things)
        for new, old in enumerate(sorted(range(len(things)), key=order)):
            place[old] = new
        return shown, place


class LODGS_PT_compare(bpy.types.Panel):
    bl_label = "Compare"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"
    bl_order = 6
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = scenes.active_root(context)
        return root is not None and bool(scenes.views(root))

    def draw(self, context):
        layout, root = self.layout, scenes.active_root(context)
        settings, cameras = context.scene.lodgs_render, root.lodgs.cameras
        layout.template_list("LODGS_UL_views", "", cameras, "objects", root.lodgs, "active_view", rows=5)
        measuring = compare.measuring
        if measuring is not None and measuring.running:
            row = layout.row(align=True)
            row.progress(text=f"{measuring.done} of {measuring.of}", factor=measuring.done / measuring.of)
            row.operator("lodgs.cancel_measuring", text="", icon="X")
        else:
            row = layout.row(align=True)
            row.operator("lodgs.measure_views", icon="DRIVER_DISTANCE")
            row.operator("lodgs.compare_view", text="Worst", icon="SORT_ASC").worst = True
            if measuring is not None and measuring.problem:
                say(layout, measuring.problem, "ERROR")
        layout.operator("lodgs.compare_view", icon="IMAGE_ALPHA").worst = False
        found = compare.shown
        if found is not None:
            row = layout.row(align=True)
            row.prop(settings, "show_comparison", text="", icon="SPLIT_VERTICAL")
            row.prop(settings, "wipe", slider=True)
            if context.scene.camera is None or context.scene.camera.session_uid != found.view:
                say(layout, "Press Compare for this view.", "INFO")


CLASSES = (LODGS_UL_views, LODGS_PT_compare)
