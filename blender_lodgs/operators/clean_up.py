"""Crop a splat scene, and hide or delete clutter, at every level."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ..data import cleaning, crops, photographs, roots, scenes
from ..data.cleanup_tests import HIDE_TESTS, find_matches, limit_properties, limit_property, suggest_limits
from .base import EditLevelsOperator, SceneOperator, report_errors
from .brush import TOOLS


class LODGS_OT_add_crop(EditLevelsOperator, bpy.types.Operator):
    """Add an object that crops every level of the splat scene; move, rotate and scale it to fit"""

    bl_idname = "lodgs.add_crop"
    bl_label = "Crop Splats"
    bl_options = {"REGISTER", "UNDO"}

    shape: bpy.props.EnumProperty(
        name="Shape",
        description="Shape of the crop",
        items=[
            ("BOX", "Box", "Box"),
            ("SPHERE", "Sphere", "Sphere; scale it unevenly for an ellipsoid"),
        ],
    )
    keep: bpy.props.EnumProperty(
        name="Keep",
        description="Remaining splats",
        items=[
            ("INSIDE", "Inside", "Keep the splats inside the crop"),
            ("OUTSIDE", "Outside", "Keep the splats outside the crop"),
            ("ALL", "All", "Keep all splats, to give those inside the crop their own look"),
        ],
    )

    @report_errors
    def execute(self, context):
        add_crop(context, roots.active_root(context), self.shape, self.keep)
        return {"FINISHED"}


def add_crop(
    context: bpy.types.Context, root: bpy.types.Object, shape: str, keep: str = "INSIDE"
) -> bpy.types.Object:
    """Add a crop around most of a scene's splats and select it.

    Its center is that of the subject. Unless it keeps the inside, the crop is at most a third as large, and
    not larger than the subject.
    """
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    context.view_layer.update()
    low, high = cleaning.bounds(root)
    subject = photographs.central_bounds(root)
    assert subject is not None, "bounds refuses scenes without splats and points"
    middle, diagonal = np.array(subject[0]), subject[1]
    half = np.maximum(high - middle, middle - low)
    if keep != "INSIDE":
        half = np.minimum(half / 3, max(diagonal, 1e-6) / math.sqrt(12))
    if shape == "SPHERE":
        half[:] = half.max()
    obj = crops.new_crop(root, shape, Matrix.LocRotScale(middle, None, half), keep)
    for selected in context.selected_objects:
        selected.select_set(False)
    if _make_active(context, obj):
        obj.select_set(True)
    return obj


def _make_active(context: bpy.types.Context, obj: bpy.types.Object) -> bool:
    """Make an object active. Return False if the view layer excludes its collection."""
    is_included = context.view_layer.objects.get(obj.name) == obj
    if is_included:
        context.view_layer.objects.active = obj
    return is_included


class LODGS_OT_add_region(SceneOperator, bpy.types.Operator):
    """Add a box to train in detail, while everything outside is trained coarsely"""

    bl_idname = "lodgs.add_region"
    bl_label = "Add Region"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        root.lodgs.training.region = add_crop(context, root, "BOX", "ALL")
        return {"FINISHED"}


class LODGS_OT_remove_crop(EditLevelsOperator, bpy.types.Operator):
    """Remove this crop and show the splats that it cut away"""

    bl_idname = "lodgs.remove_crop"
    bl_label = "Remove Crop"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    name: bpy.props.StringProperty(name="Crop", description="Name of the crop's object")

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        for crop in crops.crops_of(root):
            if crop.name == self.name:
                active = context.active_object == crop
                bpy.data.objects.remove(crop)
                if active:
                    _make_active(context, root)
                return {"FINISHED"}
        raise LodgsError(
            f"Cannot remove crop: '{root.name}' has no crop '{self.name}'.",
            "Choose a crop of the Clean Up panel.",
        )


class LODGS_OT_hide_splats(EditLevelsOperator, bpy.types.Operator):
    """Hide the matching splats of every level, or select them for Edit Mode"""

    bl_idname = "lodgs.hide_splats"
    bl_label = "Hide Splats"
    bl_options = {"REGISTER", "UNDO"}

    test: bpy.props.EnumProperty(
        name="Splats",
        description="Splats to match",
        items=[(test.identifier, test.label, test.about) for test in HIDE_TESTS],
    )
    action: bpy.props.EnumProperty(
        name="Action",
        description="Action on the matching splats",
        items=[
            ("HIDE", "Hide", "Hide them in viewports, renders and exports until they are shown again"),
            ("SELECT", "Select", "Select them, to inspect or edit them in Edit Mode"),
        ],
        options={"SKIP_SAVE"},
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "test")
        for name in self._chosen_test().limits:
            layout.prop(self, limit_property(name))
        layout.prop(self, "action")

    def invoke(self, context, event):
        for name, value in suggest_limits(context, roots.active_root(context)).items():
            if not self.properties.is_property_set(name):
                setattr(self, name, value)
        return self.execute(context)

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        matches = find_matches(self._chosen_test(), context, root, self)
        count = sum(int(mask.sum()) for mask in matches.values())
        by_level = ", ".join(f"level {number} {mask.sum():,}" for number, mask in matches.items())
        if self.action == "SELECT":
            cleaning.select(root, matches)
            self.report({"INFO"}, f"{count:,} splats selected: {by_level}")
            return {"FINISHED"}
        if count:
            cleaning.hide(root, matches)
        self.report({"INFO"}, f"{count:,} splats hidden: {by_level}")
        return {"FINISHED"}

    def _chosen_test(self):
        return next(test for test in HIDE_TESTS if test.identifier == self.test)


LODGS_OT_hide_splats.__annotations__ |= limit_properties(HIDE_TESTS)


class LODGS_OT_show_hidden_splats(EditLevelsOperator, bpy.types.Operator):
    """Show all hidden splats of the scene"""

    bl_idname = "lodgs.show_hidden_splats"
    bl_label = "Show Hidden Splats"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        self.report({"INFO"}, f"{cleaning.show_all(roots.active_root(context)):,} hidden splats shown")
        return {"FINISHED"}


class LODGS_OT_delete_hidden_splats(EditLevelsOperator, bpy.types.Operator):
    """Delete all hidden and cropped splats of every level, and remove the crops"""

    bl_idname = "lodgs.delete_hidden_splats"
    bl_label = "Delete Hidden Splats"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        if context.active_object in crops.crops_of(root):
            _make_active(context, root)
        self.report({"INFO"}, f"{scenes.delete_excluded(root):,} splats deleted")
        return {"FINISHED"}


class LODGS_MT_clean_up(bpy.types.Menu):
    bl_idname = "LODGS_MT_clean_up"
    bl_label = "Clean Up Splats"

    def draw(self, context):
        layout = self.layout
        for shape, icon in (("BOX", "MESH_CUBE"), ("SPHERE", "MESH_UVSPHERE")):
            operator = layout.operator("lodgs.add_crop", text=f"Crop Splats to {shape.title()}", icon=icon)
            operator.shape = shape
        layout.separator()
        layout.operator("lodgs.find_clutter")
        for test in HIDE_TESTS:
            layout.operator("lodgs.hide_splats", text=f"Hide {test.noun}").test = test.identifier
        layout.separator()
        for test in HIDE_TESTS:
            if test.limits:
                operator = layout.operator("lodgs.hide_splats", text=f"Select {test.noun}")
                operator.test, operator.action = test.identifier, "SELECT"
        for tool in TOOLS if context.mode == "OBJECT" else ():
            layout.operator("wm.tool_set_by_id", text=tool.bl_label).name = tool.bl_idname
        for action, name in (("DESELECT", "Deselect Splats"), ("INVERT", "Invert Splat Selection")):
            layout.operator("lodgs.select_all_splats", text=name).action = action
        layout.separator()
        layout.operator("lodgs.show_hidden_splats")
        layout.operator("lodgs.delete_hidden_splats")


def _menu(self, context):
    if roots.root_with_levels(context) is not None:
        self.layout.separator()
        self.layout.menu(LODGS_MT_clean_up.bl_idname)


CLASSES = (
    LODGS_OT_add_crop, LODGS_OT_add_region, LODGS_OT_remove_crop, LODGS_OT_hide_splats,
    LODGS_OT_show_hidden_splats, LODGS_OT_delete_hidden_splats, LODGS_MT_clean_up,
)  # fmt: skip

_MENUS = (bpy.types.VIEW3D_MT_object, bpy.types.VIEW3D_MT_edit_pointcloud)


def register() -> None:
    for menu in _MENUS:
        menu.append(_menu)


def unregister() -> None:
    for menu in _MENUS:
        menu.remove(_menu)
