"""Export a splat scene as a bundle, a plain splat file, levels of other programs, or levels for the web."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper

from ...training.editing.export import (
    COMPRESSION_SETTINGS,
    EXPORT_OPTIONS,
    FileOptions,
    export_finest_level,
)
from ...training.errors import LodgsError
from ...training.lod.rule import resolve_rule
from ...training.runs.folder import RunFolder
from ...training.splats.bundle import write_bundle
from ...training.splats.formats import FORMATS, LEVEL_FORMATS, PLY, find_format
from ...training.splats.formats.sog import FORMAT as SOG
from ...training.splats.formats.spz import FORMAT as SPZ
from ...training.splats.level_folder import write_folder
from ...training.splats.levels import Bundle, Level
from ...training.splats.origin import describe_origin
from ...training.splats.splat_format import SplatFormat
from ...training.splats.streamed_levels import STREAMED_FILE
from ..data import metadata, roots, scenes
from ..data.objects import megabytes, sh_degree
from ..data.paths import absolute_path
from ..data.setting_properties import property_of
from ..runs.conversion import compress_steps, convert_steps, page_steps
from ..runs.run_folders import automatic_run
from .base import ReadLevelsOperator, report_errors
from .modal import BackgroundOperator


def _size(context: bpy.types.Context, kind: SplatFormat, level: int = 0) -> str:
    """Estimate the file size of an export of the active scene, as text.

    Args:
        level: number of one level, with the coarser ones if levels add up; 0 for the visible splats, -1 for
            all levels.
    """
    root = roots.active_root(context)
    items = root.lodgs.existing_levels
    if not level:
        count = scenes.count_visible(context, root)[0]
    else:
        items = [
            item
            for item in items
            if level in (-1, item.number) or (root.lodgs.cumulative and item.number < level)
        ]
        count = sum(len(item.object.data.points) for item in items)
    if kind is PLY and level:
        size = 1e6 * sum(megabytes(item.object.data) for item in items)
    else:
        size = kind.size(count, sh_degree(items[0].object.data)) if items else 0
    return f"{size / 1e6:,.1f} MB" if size > 1e5 else f"{size / 1e3:,.0f} kB"


class _ExportOperator(ReadLevelsOperator):
    """Base class with the options of all exports."""

    placed: property_of(EXPORT_OPTIONS["placed"])
    looked: property_of(EXPORT_OPTIONS["looked"])


class _ForeignExport(_ExportOperator):
    """Base class with the options of exports for other programs."""

    antialiased: property_of(EXPORT_OPTIONS["antialiased"])

    def file_options(self) -> FileOptions:
        """Return the options of the dialog; those that it lacks have their defaults."""
        names = (f.name for f in fields(FileOptions))
        return FileOptions(**{name: getattr(self, name) for name in names if hasattr(self, name)})


def _origin_text(bundle: Bundle) -> str:
    """Return a sentence about the local origin of exported splats, after a space; "" without one."""
    return f". {describe_origin(bundle.origin)}" if bundle.origin.any() else ""


class _FileExport(_ExportOperator, ExportHelper):
    """Base class of exports to one file, named after the scene, with the File Browser's overwrite check."""

    filename_ext = ".ply"
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    suffix = ""

    def invoke(self, context, event):
        root = roots.active_root(context)
        name = bpy.path.clean_name(root.name) + self.suffix + self.filename_ext
        self.filepath = str(Path(bpy.data.filepath).parent / name) if bpy.data.filepath else name
        return super().invoke(context, event)

    def _path(self) -> Path:
        return absolute_path(self.filepath)


class _ConvertingExport(BackgroundOperator):
    """Base class of exports that may run the trainer."""

    written = ""
    progress = ""

    def follow(self, messages: Iterable[str]) -> Iterator[None]:
        """Run the trainer step by step and keep its last message."""
        for message in messages:
            self.progress = message
            yield

    def result_text(self, count):
        return self.written

    def status_text(self, context, count):
        return "Exporting, Esc to stop"


class LODGS_OT_export_bundle(_FileExport, bpy.types.Operator):
    """Export all levels to one PLY file; other viewers show its finest level"""

    bl_idname = "lodgs.export_bundle"
    bl_label = "Export Bundle"

    order: bpy.props.EnumProperty(
        name="First",
        description="First level in the file, which other viewers show",
        items=[
            ("finest_first", "Finest Level", "Other viewers show the finest level"),
            ("stream", "Coarsest Level", "A partial download shows a complete coarse scene"),
        ],
    )

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.prop(self, "order")
        self.layout.prop(self, "placed")
        self.layout.prop(self, "looked")
        self.layout.label(text=f"Estimated size: {_size(context, PLY, -1)}")

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        if self.order == "stream" and not root.lodgs.complete:
            raise LodgsError(
                "Cannot write the coarsest level first: it is not a complete scene.",
                "Set First to Finest Level.",
            )
        bundle = scenes.read_levels(root, self.placed, self.looked)
        write_bundle(self._path(), bundle, self.order)
        self.report({"INFO"}, f"{_levels(bundle)} written to {self._path()}{_origin_text(bundle)}")
        return {"FINISHED"}


class LODGS_OT_export_compressed(_FileExport, _ConvertingExport, bpy.types.Operator):
    """Export all levels to a file of a tenth of the size, which only LODGS opens; uses the trainer"""

    bl_idname = "lodgs.export_compressed"
    bl_label = "Export Compressed"
    suffix = "_small"

    prune: property_of(COMPRESSION_SETTINGS["prune"])
    distill_steps: property_of(COMPRESSION_SETTINGS["distill_steps"])
    sh_degree: property_of(COMPRESSION_SETTINGS["sh_degree"])
    codes: property_of(COMPRESSION_SETTINGS["codes"])

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        column = layout.column()
        column.active = self._run(context) is not None
        column.prop(self, "prune")
        column.prop(self, "distill_steps")
        layout.prop(self, "sh_degree")
        layout.prop(self, "codes")
        layout.prop(self, "placed")
        layout.prop(self, "looked")

    def _run(self, context) -> RunFolder | None:
        """Return the run whose views measure the splats; None if they are not at their trained place."""
        return None if self.placed else automatic_run(roots.active_root(context))

    def work(self, context):
        bundle = scenes.read_levels(roots.active_root(context), self.placed, self.looked)
        settings = {name: getattr(self, name) for name in COMPRESSION_SETTINGS}
        steps = compress_steps(bundle, self._path(), settings, self._run(context))
        yield from self.follow(steps)
        self.written = f"{_levels(bundle)} written to {self.progress}{_origin_text(bundle)}"

    def status_text(self, context, count):
        return "Compressing, Esc to stop"


class _FormatExport(_ForeignExport, _FileExport, _ConvertingExport):
    """Base class of exports to one file in a format that the property ``kind`` chooses by its suffix."""

    original_place: property_of(EXPORT_OPTIONS["original_place"])

    def check(self, context):
        """Give the file name the extension of the chosen format."""
        path, self.filepath = self.filepath, _without_suffix(self.filepath) + self.kind
        return path != self.filepath

    def check_place(self) -> None:
        """Raise LodgsError if two places are chosen."""
        if self.placed and self.original_place:
            raise LodgsError(
                "Cannot export at the original place: As Placed uses the place in Blender.",
                "Disable one of them.",
            )

    def draw_original_place(self, context: bpy.types.Context) -> None:
        """Draw the option of scenes that have a local origin."""
        if metadata.origin_of(roots.active_root(context)).any():
            row = self.layout.row()
            row.active = not self.placed
            row.prop(self, "original_place")


class LODGS_OT_export_plain(_FormatExport, bpy.types.Operator):
    """Export one level or the visible splats to a plain splat file for other programs"""

    bl_idname = "lodgs.export_plain"
    bl_label = "Export Splats"
    suffix = "_plain"

    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{kind.suffix}" for kind in FORMATS), options={"HIDDEN"}
    )
    kind: bpy.props.EnumProperty(
        name="Format",
        description="File format; scripts choose it by the file extension",
        items=[(kind.suffix, kind.label, kind.about) for kind in FORMATS],
    )
    source: bpy.props.EnumProperty(
        name="Splats",
        description="Splats to export",
        items=[
            (
                "SHOWN",
                "As Shown",
                "Visible splats with modifiers applied, without instances and regardless of the splat budget",
            ),
            ("LEVEL", "One Level", "All splats of one level, without modifiers"),
        ],
    )
    level: bpy.props.IntProperty(
        name="Level", description="Level to export; 1 is the coarsest", default=1, min=1
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "source")
        if self.source == "LEVEL":
            layout.prop(self, "level")
        layout.prop(self, "placed")
        layout.prop(self, "looked")
        row = layout.row()
        stores_filter = find_format(Path(f"splats{self.kind}")).antialiased
        row.active = roots.active_root(context).lodgs.antialias and not stores_filter
        row.prop(self, "antialiased")
        self.draw_original_place(context)
        layout.label(text="Format and Estimated Size")
        column = layout.column(align=True)
        column.use_property_split = False
        for kind in FORMATS:
            size = _size(context, kind, self.level if self.source == "LEVEL" else 0)
            column.prop_enum(self, "kind", kind.suffix, text=f"{kind.label}   {size}")

    def work(self, context):
        root = roots.active_root(context)
        self.check_place()
        if self.source == "LEVEL":
            splats = scenes.read_level(root, self.level, self.placed, self.looked)
        else:
            splats = scenes.visible_splats(context, root, self.placed, self.looked)
        path = self._path()
        meta = metadata.meta_of(root)
        if self.placed:  # in Blender's coordinates, only these remain true
            meta = {name: meta[name] for name in ("antialias", "focal_px") if name in meta}
            meta["up_rotation"] = np.eye(3).tolist()
        bundle = Bundle("", [Level(1, splats)], meta=meta, tables=scenes.view_tables(root, self.placed))
        if find_format(path).in_trainer:
            yield from self.follow(convert_steps(bundle, "--plain", path, self.file_options()))
        else:
            export_finest_level(path, bundle, self.file_options())
        origin = "" if self.original_place else _origin_text(bundle)
        self.written = f"{len(splats):,} splats written to {path}{origin}"


class LODGS_OT_export_levels(_FormatExport, bpy.types.Operator):
    """Export all levels to one file of USD or glTF for other programs; uses the trainer"""

    bl_idname = "lodgs.export_levels"
    bl_label = "Export Levels"
    suffix = "_levels"
    filename_ext = LEVEL_FORMATS[0].suffix

    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{kind.suffix}" for kind in LEVEL_FORMATS), options={"HIDDEN"}
    )
    kind: bpy.props.EnumProperty(
        name="Format",
        description="File format; scripts choose it by the file extension",
        items=[(kind.suffix, kind.label, kind.about) for kind in LEVEL_FORMATS],
    )

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "kind")
        for name in ("placed", "looked", "antialiased"):
            layout.prop(self, name)
        self.draw_original_place(context)
        layout.label(text=f"Estimated size: {_size(context, find_format(Path(self.kind)), -1)}")

    def work(self, context):
        self.check_place()
        bundle = scenes.read_levels(roots.active_root(context), self.placed, self.looked)
        yield from self.follow(convert_steps(bundle, "--levels", self._path(), self.file_options()))
        self.written = f"{self._path()} written. {self.progress}".rstrip()

    def status_text(self, context, count):
        return "Writing the levels, Esc to stop"


_SUFFIXES = sorted((kind.suffix for kind in FORMATS), key=len, reverse=True)


def _without_suffix(path: str) -> str:
    """Return a path without the suffix of a format."""
    return next((path[: -len(suffix)] for suffix in _SUFFIXES if path.endswith(suffix)), path)


class _FolderExport(_ExportOperator):
    """Base class of exports to a folder."""

    directory: bpy.props.StringProperty(
        name="Folder", description="Folder for the exported files", subtype="DIR_PATH"
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    kind = PLY

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context):
        self.layout.use_property_split = True
        for name in (*EXPORT_OPTIONS, "replace"):
            if hasattr(self, name):
                self.layout.prop(self, name)
        self.layout.label(text=f"Estimated size: {_size(context, self.kind, -1)}")

    def _folder(self) -> Path:
        return absolute_path(self.directory)

    def _bundle(self, context) -> Bundle:
        """Return the levels, each a complete scene."""
        bundle = scenes.read_levels(roots.active_root(context), self.placed, self.looked)
        return resolve_rule(bundle.rule).complete_levels(bundle)


class LODGS_OT_export_folder(_FolderExport, bpy.types.Operator):
    """Export each level as a complete scene to its own PLY file: lod0.ply (the finest), lod1.ply and so on"""

    bl_idname = "lodgs.export_folder"
    bl_label = "Export Folder"

    replace: bpy.props.BoolProperty(
        name="Replace", description="Overwrite levels that are already in the folder", options={"SKIP_SAVE"}
    )

    @report_errors
    def execute(self, context):
        folder = self._folder()
        if not self.replace and any(folder.glob("lod*.ply")):
            raise LodgsError(
                f"Cannot export: {folder} already holds levels.", "Choose another folder or enable Replace."
            )
        bundle = self._bundle(context)
        write_folder(folder, bundle)
        self.report({"INFO"}, f"{_levels(bundle)} written to {folder}{_origin_text(bundle)}")
        return {"FINISHED"}


class LODGS_OT_export_tiles(_ForeignExport, _FolderExport, _ConvertingExport, bpy.types.Operator):
    """Export levels as 3D Tiles for Cesium and other globes; uses the trainer"""

    bl_idname = "lodgs.export_tiles"
    bl_label = "Export 3D Tiles"
    kind = SPZ

    def work(self, context):
        bundle = scenes.read_levels(roots.active_root(context), self.placed, self.looked)
        yield from self.follow(convert_steps(bundle, "--tiles", self._folder(), self.file_options()))
        self.written = f"{self._folder()} written. {self.progress}".rstrip()

    def status_text(self, context, count):
        return "Writing the tiles, Esc to stop"


class LODGS_OT_export_streamed(_ForeignExport, _FolderExport, _ConvertingExport, bpy.types.Operator):
    """Export levels for web viewers that stream detail by distance; uses the trainer"""

    bl_idname = "lodgs.export_streamed"
    bl_label = "Export for Web"
    kind = SOG

    lod_errors: property_of(EXPORT_OPTIONS["lod_errors"])

    def work(self, context):
        bundle = scenes.read_levels(roots.active_root(context), self.placed, self.looked)
        yield from self.follow(convert_steps(bundle, "--streamed", self._folder(), self.file_options()))
        self.written = f"{_levels(bundle)} written: {self._folder() / STREAMED_FILE}{_origin_text(bundle)}"


class LODGS_OT_export_page(_FolderExport, _ConvertingExport, bpy.types.Operator):
    """Export a page that shows the levels in a browser, with a viewer and the cameras; uses the trainer"""

    bl_idname = "lodgs.export_page"
    bl_label = "Export Page"
    kind = SOG

    def work(self, context):
        root = roots.active_root(context)
        bundle = scenes.read_levels(root, self.placed, self.looked)
        yield from self.follow(page_steps(bundle, self._folder(), root.name))
        self.written = f"{self._folder()} written. Upload the folder, or open it with a local server"

    def status_text(self, context, count):
        return "Writing the page, Esc to stop"


def _levels(bundle: Bundle) -> str:
    count = len(bundle.levels)
    return f"{count} level{'s' * (count != 1)}"


def _menu(self, context):
    self.layout.operator(LODGS_OT_export_bundle.bl_idname, text="Splat Level Bundle (.ply)")
    self.layout.operator(LODGS_OT_export_compressed.bl_idname, text="Compressed Level Bundle (.ply)")
    self.layout.operator(
        LODGS_OT_export_plain.bl_idname, text=f"Plain Splats ({', '.join(kind.suffix for kind in FORMATS)})"
    )
    self.layout.operator(
        LODGS_OT_export_levels.bl_idname,
        text=f"Splat Levels ({', '.join(kind.suffix for kind in LEVEL_FORMATS)})",
    )
    self.layout.operator(LODGS_OT_export_folder.bl_idname, text="Splat Level Folder")
    self.layout.operator(LODGS_OT_export_tiles.bl_idname, text="Splat Levels as 3D Tiles (folder)")
    self.layout.operator(LODGS_OT_export_streamed.bl_idname, text="Splat Levels for the Web (folder)")
    self.layout.operator(LODGS_OT_export_page.bl_idname, text="Page with Splat Levels (folder)")


CLASSES = (
    LODGS_OT_export_bundle,
    LODGS_OT_export_compressed,
    LODGS_OT_export_plain,
    LODGS_OT_export_levels,
    LODGS_OT_export_folder,
    LODGS_OT_export_tiles,
    LODGS_OT_export_streamed,
    LODGS_OT_export_page,
)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
