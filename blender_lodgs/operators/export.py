"""Exports of a splat scene: the bundle, one level for other programs, a folder of levels, and for the web."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ...training.errors import LodgsError
from ...training.lod.paging import is_tree
from ...training.lod.tree import complete_levels
from ...training.lod.unfiltered import without_filter
from ...training.splats.bundle import Bundle, Level, write_bundle, write_folder
from ...training.splats.formats import (
    FORMATS,
    PLY,
    STREAMED_FILE,
    SplatFormat,
    find_format,
    write_splats,
    write_streamed_levels,
)
from ..data import scenes, selection
from ..data.objects import megabytes, sh_degree
from .base import ReadLevelsOperator, report_errors
from .modal import BackgroundOperator

_SOG = find_format(Path("level.sog"))


def _size(context: bpy.types.Context, kind: SplatFormat, level: int = 0) -> str:
    """About how large a file of the active scene's splats gets.

    Args:
        level: of one level, with the coarser ones where levels add up; 0: of what is shown; -1: of all.
    """
    root = scenes.active_root(context)
    items = [item for item in root.lodgs.levels if item.exists]
    if not level:
        count = scenes.count_shown(context, root)[0]
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


class _AsShown(ReadLevelsOperator):
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


class _ForOthers(_AsShown):
    """What exports for other programs can be told."""

    antialiased: bpy.props.BoolProperty(
        name="Antialiased",
        description="For programs that draw splats with Mip-Splatting's filter, as LODGS does: leave "
        "opacities as they were trained. Otherwise small splats are as faint as the photographs' views show "
        "them, so that other programs do not draw them too bold. SPZ says which it is, and needs no choice",
        default=False,
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


class _Converting(BackgroundOperator):
    """What exports have in common that another program may have to do with."""

    written = said = ""

    def told(self, work: Iterable[str]) -> Iterator[None]:
        """Goes on with what the program does, and tells what it says."""
        for said in work:
            self.said = said
            yield

    def result_text(self, count):
        return self.written

    def status_text(self, context, count):
        return f"splat-transform: {self.said}; Esc stops"


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

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.prop(self, "order")
        self.layout.prop(self, "placed")
        self.layout.prop(self, "looked")
        self.layout.label(text=f"All levels: {_size(context, PLY, -1)}")

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
        self.report({"INFO"}, f"{_levels(bundle)} written to {self._path()}")
        return {"FINISHED"}


class LODGS_OT_export_plain(_ForOthers, _Export, _Converting, bpy.types.Operator):
    """Export one level, or the splats that are shown now, as a plain file of splats for other programs"""

    bl_idname = "lodgs.export_plain"
    bl_label = "Export Splats"
    suffix = "_plain"

    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{kind.suffix}" for kind in FORMATS), options={"HIDDEN"}
    )
    kind: bpy.props.EnumProperty(
        name="Format",
        description="The kind of file; in a script the file's name says it",
        items=[(kind.suffix, kind.label, kind.about) for kind in FORMATS],
    )
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

    def check(self, context):
        """The name follows the kind that is chosen."""
        path = next(
            (self.filepath[: -len(suffix)] for suffix in _SUFFIXES if self.filepath.endswith(suffix)),
            self.filepath,
        )
        changed = path + self.kind != self.filepath
        self.filepath = path + self.kind
        return changed

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "source")
        if self.source == "LEVEL":
            layout.prop(self, "level")
        layout.prop(self, "placed")
        layout.prop(self, "looked")
        row = layout.row()
        told = find_format(Path(f"splats{self.kind}")).antialiased
        row.active = scenes.active_root(context).lodgs.antialias and not told
        row.prop(self, "antialiased")
        layout.label(text="Format, and about how large:")
        column = layout.column(align=True)
        column.use_property_split = False
        for kind in FORMATS:
            size = _size(context, kind, self.level if self.source == "LEVEL" else 0)
            column.prop_enum(self, "kind", kind.suffix, text=f"{kind.label}   {size}")

    def work(self, context):
        root = scenes.active_root(context)
        if self.source == "LEVEL":
            splats = scenes.read_level(root, self.level, self.placed, self.looked)
        else:
            splats = scenes.shown_splats(context, root, self.placed, self.looked)
        meta, path = selection.read_json(root.lodgs.meta), self._path()
        form = Bundle("", [Level(1, splats)], meta=meta, tables=scenes.view_tables(root, self.placed))
        if not (self.antialiased or find_format(path).antialiased):
            form = without_filter(form)
        yield from self.told(write_splats(path, form.levels[0].rows, form.meta))
        self.written = f"{len(splats):,} splats written to {self._path()}"


_SUFFIXES = sorted((kind.suffix for kind in FORMATS), key=len, reverse=True)


class _IntoFolder(_AsShown):
    """What exports into a folder have in common."""

    directory: bpy.props.StringProperty(
        name="Folder", description="Folder that receives the files", subtype="DIR_PATH"
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    kind = PLY

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context):
        self.layout.use_property_split = True
        for name in ("placed", "looked", "antialiased", "replace"):
            if name in self.bl_rna.properties:
                self.layout.prop(self, name)
        self.layout.label(text=f"About {_size(context, self.kind, -1)} in all")

    def _folder(self) -> Path:
        return Path(bpy.path.abspath(self.directory))

    def _bundle(self, context) -> Bundle:
        """The levels, each a scene by itself."""
        bundle = scenes.read_levels(scenes.active_root(context), self.placed, self.looked)
        return complete_levels(bundle) if is_tree(bundle) else bundle


class LODGS_OT_export_folder(_IntoFolder, bpy.types.Operator):
    """Export levels as PLYs of their own, whole scenes each: lod0.ply (the finest), lod1.ply, ..."""

    bl_idname = "lodgs.export_folder"
    bl_label = "Export Folder of Levels"

    replace: bpy.props.BoolProperty(
        name="Replace", description="Replace levels that are in the folder already", options={"SKIP_SAVE"}
    )

    @report_errors
    def execute(self, context):
        folder = self._folder()
        if not self.replace and any(folder.glob("lod*.ply")):
            raise LodgsError(f"{folder} already holds levels.", "Choose another folder, or tick Replace.")
        bundle = self._bundle(context)
        write_folder(folder, bundle)
        self.report({"INFO"}, f"{_levels(bundle)} written to {folder}")
        return {"FINISHED"}


class LODGS_OT_export_streamed(_ForOthers, _IntoFolder, _Converting, bpy.types.Operator):
    """Export levels that web viewers load piece by piece, by distance. Slow without a graphics card"""

    bl_idname = "lodgs.export_streamed"
    bl_label = "Export for the Web"
    kind = _SOG

    def work(self, context):
        bundle = self._bundle(context)
        bundle = bundle if self.antialiased else without_filter(bundle)
        yield from self.told(write_streamed_levels(self._folder(), bundle))
        self.written = f"{_levels(bundle)} written: {self._folder() / STREAMED_FILE}"


def _levels(bundle: Bundle) -> str:
    count = len(bundle.levels)
    return f"{count} level{'s' * (count != 1)}"


def _menu(self, context):
    self.layout.operator(LODGS_OT_export_bundle.bl_idname, text="Splat Levels, Bundle (.ply)")
    self.layout.operator(LODGS_OT_export_plain.bl_idname, text="Splats, Plain (.ply, .spz, .sog, .splat)")
    self.layout.operator(LODGS_OT_export_folder.bl_idname, text="Splat Levels (folder)")
    self.layout.operator(LODGS_OT_export_streamed.bl_idname, text="Splat Levels for the Web (folder)")


CLASSES = (LODGS_OT_export_bundle, LODGS_OT_export_plain, LODGS_OT_export_folder, LODGS_OT_export_streamed)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
