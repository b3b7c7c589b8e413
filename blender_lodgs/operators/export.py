"""Exports of a splat scene: the bundle, one plain PLY, a folder of levels."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.errors import LodgsError
from ...training.lod.paging import is_tree
from ...training.lod.tree import complete_levels
from ...training.splats.bundle import write_bundle, write_folder
from ...training.splats.dialects import comments_of
from ...training.splats.ply import write_ply
from ..data import scenes, selection
from .parts import OnLevels, report_errors


class _AsShown(OnLevels):
    """What all exports can be told."""

    placed: bpy.props.BoolProperty(
        name="As Placed",
        description="Write the splats where the scene stands in Blender: moved, turned and scaled with its "
        "root, ground and size. Otherwise in the scene's own (COLMAP's) coordinates. Copies, and what of the "
        "scene is moved by itself, count in neither",
        default=False,
    )
    looked: bpy.props.BoolProperty(
        name="With Look",
        description="Write the splats in the colours and opacities that the Look panel gives them. Otherwise "
        "as they were trained",
        default=True,
    )


class _Export(_AsShown, ExportHelper):
    """What exports to one PLY have in common: a name after the scene, and the browser's overwrite check."""

    filename_ext = ".ply"
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    suffix = ""

    def invoke(self, context, event):
        root = scenes.active_root(context)
        name = bpy.path.clean_name(root.name) + self.suffix + self.filename_ext
        self.filepath = str(Path(bpy.data.filepath).parent / name) if bpy.data.filepath else name
        return super().invoke(context, event)

    def _path(self) -> Path:
        return Path(bpy.path.abspath(self.filepath))


class LODGS_OT_export_bundle(_Export, bpy.types.Operator):
    """Export all levels as one file, which other viewers open showing the finest level"""

    bl_idname = "lodgs.export_bundle"
    bl_label = "Export Bundle"

    order: bpy.props.EnumProperty(
        name="First",
        description="The level that comes first in the file, which is what other viewers show",
        items=[
            ("finest_first", "Finest Level", "Other viewers show the finest level"),
            (
                "stream",
                "Coarsest Level",
                "For streaming: what has arrived so far is a complete coarser scene",
            ),
        ],
    )

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        if self.order == "stream" and not root.lodgs.complete:
            raise LodgsError(
                "The coarser level of these splats is no scene by itself, which other viewers would show.",
                "Put the finest level first.",
            )
        bundle = scenes.read_levels(root, self.placed, self.looked)
        write_bundle(self._path(), bundle, self.order)
        self.report({"INFO"}, f"{len(bundle.levels)} levels written to {self._path()}")
        return {"FINISHED"}


class LODGS_OT_export_plain(_Export, bpy.types.Operator):
    """Export one level, or the splats that are shown now, as a plain splat file for any viewer"""

    bl_idname = "lodgs.export_plain"
    bl_label = "Export Plain PLY"
    suffix = "_plain"

    source: bpy.props.EnumProperty(
        name="Splats",
        description="What is exported",
        items=[
            (
                "SHOWN",
                "As Shown",
                "The splats of the levels that the viewport shows now, modifiers applied. Copies and the "
                "viewport's limit do not count",
            ),
            ("LEVEL", "One Level", "All splats of one level, modifiers not applied"),
        ],
    )
    level: bpy.props.IntProperty(name="Level", description="1 is the coarsest", default=1, min=1)

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.prop(self, "source")
        if self.source == "LEVEL":
            self.layout.prop(self, "level")
        self.layout.prop(self, "placed")
        self.layout.prop(self, "looked")

    @report_errors
    def execute(self, context):
        root = scenes.active_root(context)
        if self.source == "LEVEL":
            splats = scenes.read_level(root, self.level, self.placed, self.looked)
        else:
            splats = scenes.shown_splats(context, root, self.placed, self.looked)
        write_ply(self._path(), splats, comments_of(selection.read_json(root.lodgs.meta)))
        self.report({"INFO"}, f"{len(splats):,} splats written to {self._path()}")
        return {"FINISHED"}


class LODGS_OT_export_folder(_AsShown, bpy.types.Operator):
    """Export levels as files of their own, whole scenes each; splat-transform streams them for the web"""

    bl_idname = "lodgs.export_folder"
    bl_label = "Export Folder of Levels"

    directory: bpy.props.StringProperty(
        name="Folder",
        description="Folder that receives lod0.ply (the finest), lod1.ply, ...",
        subtype="DIR_PATH",
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    replace: bpy.props.BoolProperty(
        name="Replace", description="Replace levels that are in the folder already", options={"SKIP_SAVE"}
    )

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        folder = Path(bpy.path.abspath(self.directory))
        if not self.replace and any(folder.glob("lod*.ply")):
            raise LodgsError(f"{folder} already holds levels.", "Choose another folder, or tick Replace.")
        root = scenes.active_root(context)
        bundle = scenes.read_levels(root, self.placed, self.looked)
        if is_tree(bundle):
            bundle = complete_levels(bundle)
        command = write_folder(folder, bundle)
        self.report({"INFO"}, f"{len(bundle.levels)} levels written. For the web: {command}")
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(LODGS_OT_export_bundle.bl_idname, text="Splat Levels, Bundle (.ply)")
    self.layout.operator(LODGS_OT_export_plain.bl_idname, text="Splats, Plain (.ply)")
    self.layout.operator(LODGS_OT_export_folder.bl_idname, text="Splat Levels (folder)")


CLASSES = (LODGS_OT_export_bundle, LODGS_OT_export_plain, LODGS_OT_export_folder)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
