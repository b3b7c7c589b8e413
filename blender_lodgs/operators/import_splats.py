"""File > Import > Gaussian Splats, and the drop of such files into the 3D viewport."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import bpy

from ...training.splats.formats import FILE_EXTENSIONS, MAIN_FILES
from ..data import importing, photographs, reloading, roots, scenes
from ..data.paths import absolute_path
from ..runs import photo_preparation
from .base import SceneOperator
from .modal import BackgroundOperator

_READABLE = (*FILE_EXTENSIONS, *MAIN_FILES)


class LODGS_OT_import_splats(BackgroundOperator, bpy.types.Operator):
    """Import a bundle, streamed levels, or a plain splat file as a single level"""

    bl_idname = "lodgs.import_splats"
    bl_label = "Import Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}

    filepath: bpy.props.StringProperty(
        name="File",
        description="Bundle or splat file: " + ", ".join(_READABLE),
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    files: bpy.props.CollectionProperty(
        type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"}
    )
    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{ending}" for ending in _READABLE), options={"HIDDEN"}
    )
    upright: bpy.props.BoolProperty(
        name="Upright",
        description="Rotate the scene upright by the file's up axis or by its ground, else by -Y, the up "
        "axis of most splat files. Disable it if the scene lies on its side",
        default=True,
    )

    budget: bpy.props.IntProperty(
        name="Memory Budget",
        description="Maximum number of splats of a tree in memory; set it to stream a file that is larger "
        "than memory. 0 imports the whole file",
        default=0,
        min=0,
        step=100_000,
    )

    _imported: Sequence[str] = ()

    def invoke(self, context, event):
        if self.filepath or any(file.name for file in self.files):  # dropped
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def paths(self) -> list[Path]:
        """Return the chosen or dropped files.

        Raises:
            LodgsError: a path names a device.
        """
        paths = [os.path.join(self.directory, file.name) for file in self.files if file.name]
        return [absolute_path(path) for path in paths or [self.filepath]]

    def work(self, context):
        def warn(message: str) -> None:
            self.report({"WARNING"}, message)

        first = not roots.roots(context.scene)
        reader, stop = ThreadPoolExecutor(1, "lodgs-import"), Event()
        self._imported = imported = []
        try:
            for path in self.paths():
                read = reader.submit(importing.splats_reader(path, self.budget, stop))
                while self._modal and not read.done():
                    yield
                root = yield from importing.place_splats(context, read.result(), self.upright, warn)
                imported.append(f"'{root.name}': {scenes.contents(root)}")
                yield
                if first:  # keep the view if the file already shows a splat scene
                    photographs.look_at_scene(context, root, warn)
                    first = False
                photo_preparation.clear_result()
        finally:
            stop.set()
            reader.shutdown(wait=False, cancel_futures=True)

    def has_changed_data(self):
        return bool(self._imported)

    def result_text(self, count):
        return "; ".join(self._imported)

    def status_text(self, context, count):
        return f"Reading {', '.join(path.name for path in self.paths())}, Esc to stop"


class LODGS_OT_reload_splats(SceneOperator, BackgroundOperator, bpy.types.Operator):
    """Replace the splats by those that the file has now; placement, crops, looks and materials stay"""

    bl_idname = "lodgs.reload_splats"
    bl_label = "Reload Splats"
    bl_options = {"REGISTER", "UNDO"}

    def work(self, context):
        root = roots.active_root(context)
        reader = ThreadPoolExecutor(1, "lodgs-reload")
        self._notes = []
        try:
            read = reader.submit(reloading.read_source(root))
            while self._modal and not read.done():
                yield
            self._notes = reloading.replace_splats(root, read.result())
        finally:
            reader.shutdown(wait=False, cancel_futures=True)
        yield

    def result_text(self, count):
        return " ".join(self._notes)

    def status_text(self, context, count):
        return "Reading the file, Esc to stop"


class LODGS_FH_splats(bpy.types.FileHandler):
    bl_idname = "LODGS_FH_splats"
    bl_label = "Gaussian Splats (LODGS)"
    bl_import_operator = LODGS_OT_import_splats.bl_idname
    # Blender's own importers open dropped glTF and USD files
    bl_file_extensions = ";".join(
        ending for ending in FILE_EXTENSIONS if not ending.startswith((".gl", ".usd"))
    )

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(
        LODGS_OT_import_splats.bl_idname, text=f"Gaussian Splats ({', '.join(FILE_EXTENSIONS)})"
    )


CLASSES = (LODGS_OT_import_splats, LODGS_OT_reload_splats, LODGS_FH_splats)


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
