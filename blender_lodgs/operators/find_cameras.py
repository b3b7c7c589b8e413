"""File > Import > Photos: find the cameras of photos or of a video, and import them as a scene."""

from __future__ import annotations

import bpy

from ...training.scenes.reconstruct import PRESETS
from ..data.paths import absolute_path
from ..runs import photo_preparation, processes
from .base import CancelOperator, report_errors, report_result

_LENSES = (
    ("AUTO", "Automatic", "One lens if all photos have the same size, otherwise one lens per photo"),
    ("one", "Single Lens", "All photos were taken with one camera at one focal length"),
    ("folder", "Lens per Folder", "Each folder holds the photos of one camera"),
    ("each", "Lens per Photo", "Photos from different cameras, or with zoom"),
)


class LODGS_OT_find_cameras(bpy.types.Operator):
    bl_idname = "lodgs.find_cameras"
    bl_label = "Import Photos"
    bl_description = (
        "Find the camera positions of a folder of photos or of a video in the background, and import the "
        "scene; a cancelled import resumes with the same files"
    )
    bl_options = {"REGISTER", "PRESET"}

    filepath: bpy.props.StringProperty(
        name="Video", description="Video to use instead of a folder of photos", subtype="FILE_PATH"
    )
    directory: bpy.props.StringProperty(
        name="Folder", description="Folder with photos, also in subfolders", subtype="DIR_PATH"
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    filter_movie: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    out: bpy.props.StringProperty(
        name="Scene Folder",
        description="Folder for the COLMAP scene; empty for a new folder next to the photos",
        subtype="DIR_PATH",
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="Accuracy of the feature search",
        items=[
            (name, name.title(), f"Up to {features:,} features per photo, at {size} pixels")
            for name, (size, features) in PRESETS.items()
        ],
    )
    ordered: bpy.props.BoolProperty(
        name="Sequential",
        description="Match only neighbouring photos, which is faster; enable for photos named in the order "
        "of a walk, such as video frames",
    )
    lens: bpy.props.EnumProperty(name="Lens", description="Photos that share a lens", items=_LENSES)

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        photos = absolute_path(self.directory).resolve()
        video = absolute_path(self.filepath).resolve() if self.filepath else photos
        if video.is_file() and video.suffix.lower() in bpy.path.extensions_movie:
            photos = video
        default_out = photos.with_name(f"{photos.stem if photos.is_file() else photos.name}_scene")
        out = absolute_path(self.out).resolve() if self.out else default_out
        lens = "" if self.lens == "AUTO" else self.lens
        work = photo_preparation.find_cameras(photos, out, self.preset, self.ordered, lens)
        processes.follow(work.step)
        for message in work.warnings:
            self.report({"WARNING"}, message)
        return report_result(self, work.problem, work.message)


class LODGS_OT_cancel_find_cameras(CancelOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_find_cameras"
    bl_label = "Cancel"
    bl_description = "Stop the import; importing the same photos resumes it"
    bl_options = {"INTERNAL"}
    module = photo_preparation


def _menu(self, context):
    self.layout.operator(LODGS_OT_find_cameras.bl_idname, text="Photos (folder) or Video")


CLASSES = (LODGS_OT_find_cameras, LODGS_OT_cancel_find_cameras)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
