"""File > Import > Photographs: their cameras are found first."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...training.scenes.reconstruct import PRESETS
from ..runs import preparing, processes
from .base import report_errors

_LENSES = (
    ("AUTO", "Automatic", "One lens, where all photographs are of one size; else each its own"),
    ("one", "One for All", "The same camera at the same focal length took all photographs"),
    ("folder", "One a Folder", "Each folder is of another camera"),
    ("each", "Each Its Own", "Photographs from anywhere, or zoomed"),
)


class LODGS_OT_find_cameras(bpy.types.Operator):
    bl_idname = "lodgs.find_cameras"
    bl_label = "Import Photographs"
    bl_description = (
        "Find from where a folder of photographs, or a video, was taken, while you work on, and import them "
        "as a scene. It takes minutes; stopped, it goes on from there"
    )
    bl_options = {"REGISTER", "PRESET"}

    filepath: bpy.props.StringProperty(
        name="Video", description="A video, instead of a folder of photographs", subtype="FILE_PATH"
    )
    directory: bpy.props.StringProperty(
        name="Folder", description="Folder of the photographs, and of folders of them", subtype="DIR_PATH"
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    filter_movie: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    out: bpy.props.StringProperty(
        name="Scene",
        description="Folder that becomes the COLMAP scene; empty for one beside the photographs' folder",
        subtype="DIR_PATH",
    )
    preset: bpy.props.EnumProperty(
        name="Preset",
        description="How closely photographs are looked at",
        items=[
            (name, name.title(), f"Up to {features:,} features of each, found at {size} pixels")
            for name, (size, features) in PRESETS.items()
        ],
    )
    ordered: bpy.props.BoolProperty(
        name="In Order",
        description="By name photographs follow the way that was walked, as frames of a video do: neighbours "
        "are compared, which takes less time",
    )
    lens: bpy.props.EnumProperty(name="Lens", description="Which photographs one lens took", items=_LENSES)

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        photos = Path(bpy.path.abspath(self.directory)).resolve()
        video = Path(bpy.path.abspath(self.filepath)).resolve() if self.filepath else photos
        if video.is_file() and video.suffix.lower() in bpy.path.extensions_movie:
            photos = video
        beside = photos.with_name(f"{photos.stem if photos.is_file() else photos.name}_scene")
        out = Path(bpy.path.abspath(self.out)).resolve() if self.out else beside
        lens = "" if self.lens == "AUTO" else self.lens
        work = preparing.find_cameras(photos, out, self.preset, self.ordered, lens)
        processes.follow(work.step)
        for message in work.warnings:
            self.report({"WARNING"}, message)
        if work.problem:
            self.report({"ERROR"}, work.problem)
            return {"CANCELLED"}
        self.report({"INFO"}, work.message)
        return {"FINISHED"}


class LODGS_OT_cancel_find_cameras(bpy.types.Operator):
    bl_idname = "lodgs.cancel_find_cameras"
    bl_label = "Cancel"
    bl_description = "Stop finding cameras; the same import goes on from there"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return preparing.current is not None and preparing.current.running

    def execute(self, context):
        assert preparing.current is not None
        preparing.current.cancel()
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(LODGS_OT_find_cameras.bl_idname, text="Photographs (folder) or Video")


CLASSES = (LODGS_OT_find_cameras, LODGS_OT_cancel_find_cameras)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
