"""File > Import > COLMAP Scene: import cameras, photos and points."""

from __future__ import annotations

import bpy

from ...training.scenes.formats import FORMAT_NAMES
from ..data import importing, photographs, roots, scenes
from ..data.paths import absolute_path
from ..runs import photo_preparation
from .base import report_errors


class LODGS_OT_import_colmap(bpy.types.Operator):
    """Import the cameras, photos and points of a COLMAP scene or another photogrammetry export"""

    bl_idname = "lodgs.import_colmap"
    bl_label = "Import COLMAP Scene"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    directory: bpy.props.StringProperty(
        name="Folder",
        description=f"Folder of a COLMAP scene with its photos, or of an export: {FORMAT_NAMES}",
        subtype="DIR_PATH",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    upright: bpy.props.BoolProperty(
        name="Upright",
        description="Rotate the scene so that the cameras' up direction is Z; disable to keep COLMAP's axes",
        default=True,
    )
    photographs: bpy.props.BoolProperty(
        name="Photos", description="Show each camera's photo as its background image", default=True
    )

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        def warn(message: str) -> None:
            self.report({"WARNING"}, message)

        first = not roots.roots(context.scene)
        root = importing.import_colmap(
            context,
            absolute_path(self.directory),
            upright=self.upright,
            photographs=self.photographs,
            warn=warn,
        )
        photo_preparation.clear_result()
        photo_preparation.undistort_photos(root, warn)
        if first:  # keep the view if the file already shows a splat scene
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
