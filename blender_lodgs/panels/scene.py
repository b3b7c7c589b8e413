"""The Scene panel: import scenes and show the active one."""

from __future__ import annotations

import bpy

from ...training.scenes.check import ERROR, INFO, WARNING
from ...training.splats.origin import format_number
from ..data import metadata, native, photographs, reloading, roots
from ..runs import photo_preparation, scene_check
from .parts import Panel, say, split_column

_ICONS = {ERROR: "CANCEL", WARNING: "ERROR", INFO: "INFO"}


class LODGS_PT_scene(Panel):
    bl_label = "Scene"
    bl_order = 0

    def draw(self, context):
        layout, root = self.layout, roots.active_root(context)
        if native.loose_splats(context):
            layout.operator("lodgs.add_to_scene", icon="ADD")
        _draw_import(layout, another=roots.shows_splats(context.scene))
        if roots.is_linked(context):
            say(layout, roots.LINKED, "LINKED")
        if root is None:
            if roots.roots(context.scene):
                layout.label(text="Select a splat scene", icon="INFO")
            return
        column = split_column(layout)
        row = column.row(align=True)
        row.prop(root, "name", text="Name")
        row.operator("lodgs.remove_scene", text="", icon="TRASH")
        if root.lodgs.scene_folder:
            column.prop(root.lodgs, "scene_folder", text="Folder")
            _draw_check(layout, root)
        if root.lodgs.source.file:
            _draw_source(layout, column, root)
        if root.lodgs.levels:
            column.prop(root.lodgs, "antialias")
        origin = metadata.origin_of(root)
        if origin.any():
            say(layout, f"Local origin {'  '.join(map(format_number, origin))}", "EMPTY_AXIS")
        row = layout.row(align=True)
        for name, part in (("Cameras", root.lodgs.cameras), ("Points", root.lodgs.points)):
            if part is not None:
                row.prop(part, "hide_viewport", text=name, toggle=True, invert_checkbox=True)
        views = photographs.views(root)
        if views:
            row = layout.row(align=True)
            row.operator("lodgs.look_through", text="", icon="TRIA_LEFT").step = -1
            camera = context.scene.camera
            name = camera.name if camera in views else "Look Through"
            row.operator("lodgs.look_through", text=name, icon="OUTLINER_DATA_CAMERA").step = 0
            row.operator("lodgs.look_through", text="", icon="TRIA_RIGHT").step = 1


def _draw_import(layout: bpy.types.UILayout, another: bool) -> None:
    """Draw the import buttons, collapsed once the file has a splat scene."""
    column: bpy.types.UILayout | None = layout.column(align=True)
    _draw_camera_search(column)
    if another:
        header, column = layout.panel("LODGS_import_another", default_closed=True)
        header.label(text="Import Another")
    if column is not None:
        column.operator("lodgs.find_cameras", text="Import Photos…", icon="IMAGE_DATA")
        column.operator("lodgs.import_colmap", text="Import COLMAP Scene…", icon="CAMERA_DATA")
        column.operator("lodgs.import_splats", text="Import Splats…", icon="POINTCLOUD_DATA")


def _draw_source(layout: bpy.types.UILayout, column: bpy.types.UILayout, root: bpy.types.Object) -> None:
    """Draw the file of imported splats, its reload, and the result of the last automatic reload."""
    row = column.row(align=True)
    row.prop(root.lodgs.source, "file")
    row.operator("lodgs.reload_splats", text="", icon="FILE_REFRESH")
    column.prop(root.lodgs.source, "watch")
    watch = reloading.watch_of(root)
    if watch is not None and watch.problem:
        say(layout, watch.problem, "ERROR")
    elif watch is not None and watch.handled == root.lodgs.source.file_version:  # not undone
        for note in watch.notes:
            say(layout, note, "INFO")


def _draw_check(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    """Draw the button of the check before training, and the findings of the last check."""
    layout.operator("lodgs.check_scene", icon="VIEWZOOM")
    findings = scene_check.last_findings(root)
    if findings is not None and all(finding.severity == INFO for finding in findings):
        say(layout, "Nothing found that lowers the quality", "CHECKMARK")
    for finding in findings or ():
        say(layout, str(finding), _ICONS[finding.severity])


def _draw_camera_search(column: bpy.types.UILayout) -> None:
    """Draw the progress or the result of the search for the photos' cameras."""
    work = photo_preparation.current
    if work is None:
        return
    if work.running:
        row = column.row(align=True)
        row.progress(text=work.message, factor=work.fraction)
        row.operator("lodgs.cancel_find_cameras", text="", icon="X")
    else:
        say(column, work.problem or work.message, "ERROR" if work.problem else "INFO")


CLASSES = (LODGS_PT_scene,)
