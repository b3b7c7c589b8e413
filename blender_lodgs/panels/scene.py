"""The Scene panel: bring a scene in, and what the chosen one is."""

from __future__ import annotations

from ..data import photographs, scenes
from .parts import Panel, say, split_column


class LODGS_PT_scene(Panel):
    bl_label = "Scene"
    bl_order = 0

    def draw(self, context):
        layout, root = self.layout, scenes.active_root(context)
        if scenes.shows_splats(context.scene):  # a further one is seldom wanted
            row = layout.row(align=True)
            row.operator("lodgs.import_colmap", text="Photographs…", icon="CAMERA_DATA")
            row.operator("lodgs.import_splats", text="Splats…", icon="POINTCLOUD_DATA")
        else:
            column = layout.column(align=True)
            column.operator("lodgs.import_colmap", text="Import Photographs (COLMAP)…", icon="CAMERA_DATA")
            column.operator("lodgs.import_splats", text="Import Splats…", icon="POINTCLOUD_DATA")
        if scenes.linked(context):
            say(layout, scenes.LINKED, "LINKED")
        if root is None:
            if scenes.roots(context.scene):
                layout.label(text="Select one of the splat scenes", icon="INFO")
            return
        column = split_column(layout)
        row = column.row(align=True)
        row.prop(root, "name", text="Name")
        row.operator("lodgs.remove_scene", text="", icon="TRASH")
        if root.lodgs.scene_folder:
            column.prop(root.lodgs, "scene_folder", text="Photographs")
        if root.lodgs.levels:
            column.prop(root.lodgs, "antialias")
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


CLASSES = (LODGS_PT_scene,)
