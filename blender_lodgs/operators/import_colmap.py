"""File > Import > COLMAP Scene, and the drop of its files: import cameras, photos and points."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...training.scenes.formats import FORMAT_NAMES, scene_of_file
from ...training.splats.formats import MAIN_FILES
from ..data import importing, photographs, roots, scenes
from ..data.paths import absolute_path
from ..runs import photo_preparation
from .base import report_errors


class _PhotoSceneImport:
    """Settings and execution of operators that import a photo scene."""

    upright: bpy.props.BoolProperty(
        name="Upright",
        description="Rotate the scene so that the cameras' up direction is Z; disable to keep COLMAP's axes",
        default=True,
    )
    photographs: bpy.props.BoolProperty(
        name="Photos", description="Show each camera's photo as its background image", default=True
    )

    def import_folder(self, context, folder: Path | str, model: Path | None = None) -> set[str]:
        """Import the scene in a folder and show it, if it is the first one in the file."""

        def warn(message: str) -> None:
            self.report({"WARNING"}, message)

        first = not roots.roots(context.scene)
        root = importing.import_colmap(
            context, folder, model=model, upright=self.upright, photographs=self.photographs, warn=warn
        )
        photo_preparation.clear_result()
        photo_preparation.undistort_photos(root, warn)
        if first:  # keep the view if the file already shows a splat scene
            photographs.look_at_scene(context, root, warn)
        self.report({"INFO"}, f"'{root.name}': {scenes.contents(root)}")
        return {"FINISHED"}


class LODGS_OT_import_colmap(_PhotoSceneImport, bpy.types.Operator):
    """Import the cameras, photos and points of a COLMAP scene or another photogrammetry export"""

    bl_idname = "lodgs.import_colmap"
    bl_label = "Import Scene"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    directory: bpy.props.StringProperty(
        name="Folder",
        description=f"Folder of a COLMAP scene with its photos, or of an export: {FORMAT_NAMES}",
        subtype="DIR_PATH",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        return self.import_folder(context, absolute_path(self.directory))


class LODGS_OT_drop_photo_scene(_PhotoSceneImport, bpy.types.Operator):
    """Import the scene of a file that was dropped into the viewport"""

    bl_idname = "lodgs.drop_photo_scene"
    bl_label = "Import Scene File"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    filepath: bpy.props.StringProperty(
        name="File",
        description="File of a COLMAP model or of another export",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    @report_errors
    def execute(self, context):
        path = absolute_path(self.filepath)
        if path.name in MAIN_FILES:
            return bpy.ops.lodgs.import_splats("INVOKE_DEFAULT", filepath=str(path))
        return self.import_folder(context, *scene_of_file(path))


class LODGS_FH_photo_scene(bpy.types.FileHandler):
    bl_idname = "LODGS_FH_photo_scene"
    bl_label = "COLMAP Scene (LODGS)"
    bl_import_operator = LODGS_OT_drop_photo_scene.bl_idname
    # Blender cannot drop folders, and matches files by their extension only
    bl_file_extensions = ".bin;.txt;.json;.xml;.csv;.out"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(LODGS_OT_import_colmap.bl_idname, text="COLMAP Scene (folder)")


CLASSES = (LODGS_OT_import_colmap, LODGS_OT_drop_photo_scene, LODGS_FH_photo_scene)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
