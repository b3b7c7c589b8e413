"""File > Import > COLMAP Scene."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..data import photographs, scenes
from ..runs import preparing
from .base import report_errors


class LODGS_OT_import_colmap(bpy.types.Operator):
    """Import the cameras, photographs and points of a COLMAP scene"""

    bl_idname = "lodgs.import_colmap"
    bl_label = "Import COLMAP"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    directory: bpy.props.StringProperty(
        name="Folder",
        description="Folder of the COLMAP scene, with photographs and sparse model; or of what nerfstudio, "
        "Polycam, Record3D, Metashape, OpenMVG or Bundler have exported",
        subtype="DIR_PATH",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    upright: bpy.props.BoolProperty(
        name="Upright",
        description="Turn the scene so that up for the cameras is up in Blender; off keeps COLMAP's axes",
        default=True,
    )
    photographs: bpy.props.BoolProperty(
        name="Photographs", description="Show each camera's photograph behind its view", default=True
    )

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        def warn(message: str) -> None:
            self.report({"WARNING"}, message)

        first = not scenes.roots(context.scene)
        root = scenes.import_colmap(
            context,
            Path(bpy.path.abspath(self.directory)),
            upright=self.upright,
            photographs=self.photographs,
            warn=warn,
        )
        preparing.forget()
        preparing.straighten(root, warn)
        if first:  # otherwise the artist is looking at something
            photographs.look_at_scene(context, root, warn)
        self.report({"INFO"}, f"'{root.name}': {scenes.contents(root)}")
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(LODGS_OT_import_colmap.bl_idname, text="COLMAP Scene (folder)")


CLASSES = (LODGS_OT_import_colmap,)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
