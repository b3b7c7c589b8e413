"""The panel that turns the Blender scene into photographs, where there is no splat scene yet."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import scenes, viewpoints
from ..render.capture import noise
from ..runs import background_capture, environment
from ..viewport import coverage
from .parts import Panel, draw_environment, draw_views, say, split_column


class LODGS_PT_capture(Panel):
    bl_label = "Capture This Blender Scene"
    bl_order = 1
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return scenes.active_root(context) is None and not scenes.linked(context)

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
            layout.label(text=work.message, icon="CHECKMARK" if work.fraction == 1 else "PAUSE")
        _draw_settings(layout, context)
        try:
            environment.trainer_python()
        except LodgsError:
            draw_environment(layout, "Capturing needs the trainer's environment.")
            return
        layout.operator("lodgs.capture_scene", text="Capture", icon="RENDER_STILL")
        try:
            folder = background_capture.folder_of(context.scene)
        except LodgsError as error:
            say(layout, str(error), "INFO")
            return
        if (folder / "sparse").is_dir():
            layout.operator("lodgs.import_capture", icon="IMPORT")


def _draw_settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    settings = context.scene.lodgs_capture
    column = split_column(layout)
    draw_views(column, settings, viewpoints.count_of_scene(context.scene))
    if settings.views_from in ("DOME", "GRID"):
        count = len(viewpoints.chosen(context))
        selected = f"Of what is selected: {count} object{'' if count == 1 else 's'}."
        say(column, selected if count else "Of everything: nothing is selected.", "INFO")
    width, height = viewpoints.size(context.scene, settings)
    measured = coverage.current(context.scene)
    text = f"{measured.enough:.0%} Seen by {coverage.ENOUGH} or More" if measured else "Show Coverage"
    column.operator(
        "lodgs.show_coverage", text=text, icon="HIDE_OFF" if measured else "HIDE_ON", depress=bool(measured)
    )
    say(layout, f"Pictures of {width} × {height}, as the scene's own engine renders them.", "INFO")
    if noisy := noise(context.scene):
        say(layout, noisy, "ERROR")
    split_column(layout).prop(settings, "folder")


CLASSES = (LODGS_PT_capture,)
