"""The training panel: what to train, how far it is, how it ended."""

from __future__ import annotations

import textwrap

import bpy

from ...training.errors import LodgsError
from ...training.methods.parameters import override, preset
from .. import environment, jobs, scenes


class LODGS_PT_training(bpy.types.Panel):
    bl_label = "Training"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"
    bl_order = 1

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return scenes.active_root(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        root = scenes.active_root(context)
        assert root is not None
        watch = jobs.watch_of(root)
        if watch is not None and watch.running:
            _draw_running(self.layout, watch)
            return
        if watch is not None:
            _draw_ended(self.layout, watch)
        elif root.lodgs.training.run:
            row = self.layout.row()
            row.label(text="There was a run", icon="FILE_FOLDER")
            row.operator("lodgs.open_run").directory = root.lodgs.training.run
        _draw_choices(self.layout, root)


class LODGS_PT_training_advanced(bpy.types.Panel):
    bl_label = "Advanced"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LODGS"
    bl_parent_id = "LODGS_PT_training"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        root = scenes.active_root(context)
        watch = jobs.watch_of(root)
        return bool(root and root.lodgs.scene_folder) and not (watch and watch.running)

    def draw(self, context: bpy.types.Context) -> None:
        root = scenes.active_root(context)
        assert root is not None
        layout, settings = self.layout, root.lodgs.training
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings, "seed")
        layout.prop(settings, "test_every")
        for name in jobs.offered(settings.method):
            layout.prop(settings, name)
        layout.prop(settings, "model")
        layout.prop(settings, "images")
        layout.prop(settings, "output")
        layout.operator("lodgs.open_run", icon="FILE_FOLDER", text="Open Run…")


def _draw_choices(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    settings = root.lodgs.training
    if not root.lodgs.scene_folder:
        layout.label(text="Not imported from photographs: nothing to train on", icon="INFO")
        return
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "method")
    column.prop(settings, "preset")
    column.prop(settings, "image_scale")
    try:
        parameters = override(preset(settings.method, settings.preset), jobs.changes(settings))
        levels = parameters.levels  # 0: the scene decides
        text = f" in {levels} level{'s'[: levels > 1]}" if levels else ""
        column.label(text=f"{parameters.total_steps:,} steps{text}")
    except LodgsError as error:
        say(layout, str(error), "ERROR")
        return
    try:
        environment.trainer_python()
    except LodgsError as error:
        draw_environment(layout, error.what)
        return
    layout.operator("lodgs.train", icon="PLAY")


def draw_environment(layout: bpy.types.UILayout, missing: str) -> None:
    """The way to a trainer, where there is none: what is missing, a button, and how far it is."""
    making = environment.making
    if making is not None and making.running:
        row = layout.row(align=True)
        row.progress(text=making.message, factor=making.fraction)
        row.operator("lodgs.cancel_environment", text="", icon="X")
        return
    say(layout, (making and making.problem) or missing, "ERROR")
    layout.operator("lodgs.make_environment", icon="IMPORT")


def _draw_running(layout: bpy.types.UILayout, watch: jobs.Watch) -> None:
    progress = watch.progress
    share = progress.get("step", 0) / max(progress.get("of", 0), 1)
    row = layout.row(align=True)
    message, _, aside = watch.message.partition(" (")  # the bar has room for a few words
    row.progress(text=f"{message} · {share:.0%}" if progress else message, factor=share)
    row.operator("lodgs.cancel_training", text="", icon="X")
    if aside:
        say(layout, aside.rstrip(")").capitalize(), "INFO")
    if watch.asked:
        layout.label(text="Cancel again to end it at once", icon="INFO")
    elif watch.silent:
        say(layout, "The trainer has not answered for a while. Cancel it, then resume.", "ERROR")
    facts = progress_facts(progress)
    if facts:
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True)
        for name, value in facts.items():
            grid.label(text=name)
            grid.label(text=value)


def _draw_ended(layout: bpy.types.UILayout, watch: jobs.Watch) -> None:
    box = layout.box()
    box.label(text=watch.message, icon="CHECKMARK" if watch.state == "done" else "PAUSE")
    column = box.column(align=True)
    column.scale_y = 0.8
    for number in sorted(watch.levels):
        column.label(text=level_line(watch.levels[number]), icon="BLANK1")
    if watch.problem:
        say(box, watch.problem, "ERROR")
    for warning in watch.warnings[-3:]:
        say(box, warning, "INFO")
    if watch.state != "done":
        row = box.row()
        row.operator("lodgs.resume_training", icon="PLAY")
        if watch.problem:
            row.operator("lodgs.show_log", icon="TEXT")


def progress_facts(progress: dict) -> dict[str, str]:
    """What a ``progress`` event tells, by name, for people."""
    if not progress:
        return {}
    return {
        "Level": f"{progress['level']} of {progress['levels']}",
        "Step": f"{progress['step']:,} of {progress['of']:,}",
        "Loss": f"{progress['loss']:.4f}",
        "PSNR": f"{progress['psnr']:.1f} dB",
        "Splats": f"{progress['splats']:,}",
        "Speed": f"{progress['steps_per_s']:.1f} steps/s",
        "Time left": duration(progress["eta_s"]),
    }


def level_line(event: dict) -> str:
    """What a ``level`` event tells, for people."""
    quality = f", {event['psnr']:.1f} dB" if isinstance(event.get("psnr"), float) else ""
    return f"Level {event['level']}: {event['splats']:,} splats{quality}"


def duration(seconds: float) -> str:
    """Seconds as a person would say them: 40 s, 3 min, 2 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def say(layout: bpy.types.UILayout, text: str, icon: str) -> None:
    """A sentence in as many lines as the panel needs for it."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    width = bpy.context.region.width / bpy.context.preferences.system.ui_scale
    letters = max(int((width - 85) / 5.6), 24)  # of the default font, beside the icon and the tabs
    for number, line in enumerate(textwrap.wrap(text, letters)):
        column.label(text=line, icon="BLANK1" if number else icon)  # type: ignore[arg-type]


CLASSES = (LODGS_PT_training, LODGS_PT_training_advanced)
