"""File > Import > Gaussian Splats, and dropping such files into the 3D viewport."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import bpy

from ...training.splats.formats import READABLE
from ..data import photographs, scenes
from ..runs import preparing
from .modal import BackgroundOperator


class LODGS_OT_import_splats(BackgroundOperator, bpy.types.Operator):
    """Import a bundle of levels, streamed levels, or any file of Gaussian splats as a single level"""

    bl_idname = "lodgs.import_splats"
    bl_label = "Import Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filepath: bpy.props.StringProperty(
        name="File",
        description="Bundle, or any file of splats: " + ", ".join(READABLE),
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    files: bpy.props.CollectionProperty(
        type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"}
    )
    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{ending}" for ending in READABLE), options={"HIDDEN"}
    )
    upright: bpy.props.BoolProperty(
        name="Upright",
        description="Turn the scene so that the file's -Y, which is up in most splat files, is up in Blender",
        default=True,
    )

    budget: bpy.props.IntProperty(
        name="Splats at Most",
        description="How many splats of a tree are in memory at most. Of a larger one the coarse ones are "
        "imported, and finer ones are read from the file as the eye comes near. 0 is no limit. Files without "
        "a tree are imported whole",
        default=0,
        min=0,
        step=100_000,
    )

    def invoke(self, context, event):
        if self.filepath or any(file.name for file in self.files):  # dropped
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def paths(self) -> list[Path]:
        found = [Path(self.directory, file.name) for file in self.files if file.name]
        return found or [Path(self.filepath)]

    def work(self, context):
        def warn(message: str) -> None:
            self.report({"WARNING"}, message)

        first = not scenes.roots(context.scene)
        reader, self._placed = ThreadPoolExecutor(1, "lodgs-import"), []
        try:
            for path in self.paths():
                read = reader.submit(scenes.read_splats_file, bpy.path.abspath(str(path)), self.budget)
                while self._modal and not read.done():
                    yield
                root = yield from scenes.place_splats(context, read.result(), self.upright, warn)
                yield
                if first:  # otherwise the artist is looking at something
                    photographs.look_at_scene(context, root, warn)
                    first = False
                preparing.forget()
                self._placed.append(f"'{root.name}': {scenes.contents(root)}")
        finally:
            reader.shutdown(wait=False, cancel_futures=True)

    def result_text(self, count):
        return "; ".join(self._placed)

    def status_text(self, context, count):
        return f"Reading {', '.join(path.name for path in self.paths())}; Esc stops"


class LODGS_FH_splats(bpy.types.FileHandler):
    bl_idname = "LODGS_FH_splats"
    bl_label = "Gaussian Splats (LODGS)"
    bl_import_operator = LODGS_OT_import_splats.bl_idname
    bl_file_extensions = ";".join(ending for ending in READABLE if ending.startswith("."))

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(LODGS_OT_import_splats.bl_idname, text="Gaussian Splats (.ply, .spz, .sog, .splat)")


CLASSES = (LODGS_OT_import_splats, LODGS_FH_splats)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
