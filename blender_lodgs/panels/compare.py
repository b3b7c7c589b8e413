"""The Compare panel: measured quality of the views, and the wipe between render and photo."""

from __future__ import annotations

import bpy

from ...training.scenes.splat_evidence import GRADES
from ..data import evidence, photographs, roots
from ..render import compare
from ..runs import method_comparison
from ..viewport import wipe
from .parts import TINT_ICONS, Panel, say

HELD_OUT = "HIDE_ON"
"""Icon of held-out views."""


class LODGS_UL_views(bpy.types.UIList):
    worst_first: bpy.props.BoolProperty(
        name="Worst First", description="Sort the views by PSNR, lowest first"
    )

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        psnr = item.data.lodgs.psnr
        root, is_camera = roots.active_root(context), item == context.scene.camera
        held_out = root is not None and photographs.is_held_out(root, item)
        has_quality = psnr > 0 or held_out
        row = layout.split(factor=0.62) if has_quality else layout
        row.label(text=item.name, icon="VIEW_CAMERA" if is_camera else "CAMERA_DATA")
        if has_quality:
            quality = f"{psnr:.1f} dB" if psnr > 0 else ""
            row.label(text=quality, icon=HELD_OUT if held_out else "BLANK1")

    def draw_filter(self, context, layout):
        row = layout.row(align=True)
        row.prop(self, "filter_name", text="")
        row.prop(self, "worst_first", text="", icon="SORT_ASC")

    def filter_items(self, context, data, propname):
        objects = getattr(data, propname)
        query = self.filter_name.lower()
        flags = [
            self.bitflag_filter_item * (obj.type == "CAMERA" and query in obj.name.lower()) for obj in objects
        ]

        def sort_key(index: int):
            psnr = objects[index].data.lodgs.psnr if objects[index].type == "CAMERA" else 0
            return (psnr or float("inf")) if self.worst_first else 0, objects[index].name

        order = [0] * len(objects)
        for new, old in enumerate(sorted(range(len(objects)), key=sort_key)):
            order[old] = new
        return flags, order


class LODGS_PT_compare(Panel):
    bl_label = "Compare"
    bl_order = 6
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = roots.active_root(context)
        return root is not None and bool(photographs.views_with_photo(root))

    def draw(self, context):
        layout, root = self.layout, roots.active_root(context)
        settings, cameras = context.scene.lodgs_render, root.lodgs.cameras
        layout.template_list("LODGS_UL_views", "", cameras, "objects", root.lodgs, "active_view", rows=5)
        measurement = compare.measurement
        if measurement is not None and measurement.running:
            row = layout.row(align=True)
            done, total = measurement.done, measurement.total
            row.progress(text=f"{done} of {total}", factor=done / total)
            row.operator("lodgs.cancel_measuring", text="", icon="X")
        else:
            row = layout.row(align=True)
            row.operator("lodgs.measure_views", text="Measure", icon="DRIVER_DISTANCE")
            row.operator("lodgs.compare_worst", text="Worst View", icon="SORT_ASC")
            if measurement is not None and measurement.problem:
                say(layout, measurement.problem, "ERROR")
        _draw_means(layout, root)
        layout.operator("lodgs.compare_view", text="Compare", icon="IMAGE_ALPHA")
        comparison = wipe.comparison
        if comparison is not None:
            row = layout.row(align=True)
            row.prop(settings, "show_comparison", text="", icon="SPLIT_VERTICAL")
            row.prop(settings, "wipe", slider=True)
            if context.scene.camera is None or context.scene.camera.session_uid != comparison.view:
                say(layout, "Press Compare to compare this view.", "INFO")
        _draw_evidence(layout, root)
        _draw_methods(layout)


def _draw_evidence(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    """Draw the button of the heat map, and its legend with the share of the splats of each grade."""
    shares = evidence.grade_shares(root)
    icon = "HIDE_ON" if shares is None else "HIDE_OFF"
    layout.operator("lodgs.show_evidence", icon=icon, depress=shares is not None)
    if shares is None:
        return
    column = layout.column(align=True)
    for tint, grade, share in zip(evidence.TINTS, GRADES, shares, strict=True):
        say(column, f"{grade}: {share:.0%}", TINT_ICONS[tint])


def _draw_methods(layout: bpy.types.UILayout) -> None:
    """Draw the comparison of methods, or its progress."""
    work = method_comparison.current
    if work is None or not work.running:
        layout.operator("lodgs.compare_methods", text="Compare Methods…", icon="GRAPH")
        if work is not None:
            say(layout, work.problem or work.message, "ERROR" if work.problem else "INFO")
        return
    row = layout.row(align=True)
    row.progress(text=f"{work.fraction:.0%}", factor=work.fraction)
    row.operator("lodgs.cancel_comparing_methods", text="", icon="X")
    say(layout, work.message, "TIME")  # too long for the bar


def _draw_means(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    """Draw mean PSNRs, separately for held-out views: only they measure quality between training views."""
    held_out = set(photographs.held_out(root))
    measured = [view for view in photographs.views(root) if view.data.lodgs.psnr > 0]
    column = layout.column(align=True)
    for name, icon, views in (
        ("Training" if held_out else "Mean", "BLANK1", [view for view in measured if view not in held_out]),
        ("Held out", HELD_OUT, [view for view in measured if view in held_out]),
    ):
        if views:
            mean = sum(view.data.lodgs.psnr for view in views) / len(views)
            text = f"{name}: {mean:.1f} dB ({len(views)} view{'s' * (len(views) != 1)})"
            say(column, text, icon)


CLASSES = (LODGS_UL_views, LODGS_PT_compare)
