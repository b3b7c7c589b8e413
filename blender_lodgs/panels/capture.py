"""The Capture Scene panel: render the Blender scene as training images while no splat scene is active."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import roots, viewpoints
from ..render.capture import noise_warning
from ..runs import background_capture, environment
from ..viewport import coverage
from .parts import Panel, draw_environment, draw_views, say, split_column


class LODGS_PT_capture(Panel):
    bl_label = "Capture Scene"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return roots.active_root(context) is None and not roots.is_linked(context)

    def draw(self, context: bpy.types.Context) -> None:
        layout, work = self.layout, background_capture.current
        if work is not None and work.running:
            row = layout.row(align=True)
            row.progress(text=work.message, factor=work.fraction)
            row.operator("lodgs.cancel_capture", text="", icon="X")
            return
        if work is not None and work.problem:
            say(layout, work.problem, "ERROR")
        elif work is not None:
            say(layout, work.message, "CHECKMARK" if work.fraction == 1 else "PAUSE")
        _draw_settings(layout, context)
        try:
            environment.trainer_python()
        except LodgsError:
            draw_environment(layout, "Capturing a scene requires the trainer.")
            return
        layout.operator("lodgs.capture_scene", text="Capture", icon="RENDER_STILL")
        try:
            folder = background_capture.capture_folder(context.scene)
        except LodgsError as error:
            say(layout, str(error), "INFO")
            return
        if (folder / "sparse").is_dir():
            layout.operator("lodgs.import_capture", icon="IMPORT")


def _draw_settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    settings = context.scene.lodgs_capture
    column = split_column(layout)
    draw_views(column, settings, viewpoints.capture_view_count(context.scene))
    if settings.views_from in ("DOME", "GRID"):
        count = len(viewpoints.selected_subjects(context))
        objects = f"{count} selected object{'' if count == 1 else 's'}" if count else "all objects"
        say(column, f"Views cover {objects}.", "INFO")
    width, height = viewpoints.image_size(context.scene, settings)
    measured = coverage.current(context.scene)
    text = f"Coverage: {measured.covered:.0%}" if measured else "Show Coverage"
    column.operator(
        "lodgs.show_coverage", text=text, icon="HIDE_OFF" if measured else "HIDE_ON", depress=bool(measured)
    )
    say(layout, f"Renders images of {width} × {height} px with the scene's render engine.", "INFO")
    if warning := noise_warning(context.scene):
        say(layout, warning, "ERROR")
    split_column(layout).prop(settings, "folder")


CLASSES = (LODGS_PT_capture,)
