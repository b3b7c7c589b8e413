"""The Training panel: settings, progress and results of training runs."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ...training.evaluate.messages import summary_lines
from ...training.lod.rule import resolve_rule
from ...training.methods import method_info
from .. import extension
from ..data import roots, viewpoints
from ..data.training_settings import (
    COMMON_PARAMETERS,
    PANEL_KEYS,
    has_level_distances,
    hold_out_interval,
    level_distances,
    panel_parameters,
)
from ..runs import environment, job_settings, run_folders, scene_check
from ..runs.messages import measured_on, progress_facts, short_level_line
from ..runs.watch import Watch, watch_of
from .parts import Panel, draw_environment, draw_views, say, scene_length, split_column
from .training_cells import draw_cells


class LODGS_PT_training(Panel):
    bl_label = "Training"
    bl_order = 1

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return roots.active_root(context) is not None

    def draw(self, context: bpy.types.Context) -> None:
        root = roots.active_root(context)
        assert root is not None
        watch = watch_of(root)
        if watch is not None and watch.running:
            _draw_running(self.layout, watch, root)
            return
        if root.lodgs.training.run:
            self.layout.menu("LODGS_MT_runs", icon="FILE_FOLDER")
        if watch is not None:
            _draw_ended(self.layout, watch, root)
        elif root.lodgs.training.run:
            row = self.layout.row()
            row.label(text="Previous run", icon="FILE_FOLDER")
            row.operator("lodgs.open_run", text="Open Run").directory = root.lodgs.training.run
        resumable = watch is not None and watch.state != "done"
        choices: bpy.types.UILayout | None = self.layout
        if roots.root_with_levels(context) is not None and root.lodgs.training.run:
            header, choices = self.layout.panel("LODGS_train_again", default_closed=True)
            header.label(text="Train Again")
        if choices is not None:
            _draw_choices(choices, context, root, resumable)
            if extension.preferences().flamenco and root.lodgs.scene_folder:
                choices.operator("lodgs.submit_to_flamenco", icon="NETWORK_DRIVE")


class LODGS_PT_training_advanced(Panel):
    bl_label = "Advanced"
    bl_parent_id = "LODGS_PT_training"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        root = roots.active_root(context)
        watch = watch_of(root)
        trains = root is not None and (root.lodgs.scene_folder or viewpoints.has_only_splats(root))
        return bool(trains) and not (watch and watch.running)

    def draw(self, context: bpy.types.Context) -> None:
        root = roots.active_root(context)
        assert root is not None
        layout, settings = self.layout, root.lodgs.training
        layout.use_property_split = True
        layout.use_property_decorate = False
        if root.lodgs.scene_folder:
            row = layout.row(align=True)
            row.prop(settings, "region")
            row.operator("lodgs.add_region", text="", icon="ADD")
        for name, key in PANEL_KEYS.items():
            if key.metadata["panel"] == "Advanced":
                layout.prop(settings, name)
        _draw_parameter(layout, settings, "test_every")
        for f in panel_parameters(settings.method):
            if f.name not in COMMON_PARAMETERS or root.lodgs.scene_folder:
                _draw_parameter(layout, settings.parameters, f.name)
        if has_level_distances(settings.method):
            _draw_distances(layout, context, root)
        if root.lodgs.scene_folder:
            layout.prop(settings, "model")
            layout.prop(settings, "images")
        if resolve_rule(method_info(settings.method).rule).paged_file is not None:
            layout.prop(root.lodgs.stream, "budget")
        layout.prop(settings, "output")
        layout.operator("lodgs.open_run", icon="FILE_FOLDER", text="Open Run…")


def _draw_choices(
    layout: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Object, resumable: bool
) -> None:
    settings = root.lodgs.training
    without_photos = viewpoints.has_only_splats(root)
    info = method_info(settings.method)
    if not root.lodgs.scene_folder and not without_photos:
        say(layout, "No photos to train on. Import photos or a COLMAP scene.", "INFO")
        return
    column = split_column(layout)
    column.prop(settings, "method")
    if without_photos and not info.from_base:
        say(layout, f"{info.label} needs photos. Choose another method for splats without photos.", "INFO")
        return
    column.prop(settings, "preset")
    column.prop(settings, "image_scale")
    if without_photos:
        _draw_views(column, context, root)
    elif info.from_base:
        column.prop(settings, "start_from")
        if settings.start_from == "FILE":
            column.prop(settings, "base")
    try:
        say(column, _steps_text(root), "NONE")
        interval = hold_out_interval(root)
    except LodgsError as error:
        say(layout, str(error), "ERROR")
        return
    if interval == 0 and not without_photos:
        say(layout, "No views are held out, so quality is measured on training views.", "INFO")
    if interval == 1:
        say(layout, "No views are left to train on. Set Hold Out Every to 0 or at least 2.", "ERROR")
        return
    try:
        environment.trainer_python()
    except LodgsError as error:
        draw_environment(layout, error.what)
        return
    _draw_train(layout, root, resumable)


def _steps_text(root: bpy.types.Object) -> str:
    """Return the numbers of training steps, levels and cells as text.

    Raises:
        LodgsError: the settings are inconsistent.
    """
    settings = root.lodgs.training
    without_photos = viewpoints.has_only_splats(root)
    parameters = job_settings.current_parameters(settings)
    has_base = method_info(settings.method).from_base and settings.start_from != "POINTS"
    steps = parameters.base_steps if without_photos or has_base else parameters.total_steps
    text = f"{steps:,} steps"
    if parameters.levels > 1:  # 0: the scene decides
        text += f" in {parameters.levels} levels"
    if settings.grid and not without_photos:
        text += f", {settings.columns * settings.rows} cells"
    return text


def _draw_train(layout: bpy.types.UILayout, root: bpy.types.Object, resumable: bool) -> None:
    """Draw the button that trains, the estimate, and the button that makes one."""
    if not bpy.data.is_saved and not root.lodgs.training.output:
        text = f"This file is not saved. The run is written to {run_folders.runs_parent(root)}."
        say(layout, text, "INFO")
    estimate = scene_check.last_estimate(root)
    for number, line in enumerate(estimate):
        say(layout, line, "INFO" if number else "TIME")
    row = layout.row(align=True)
    if resumable:
        row.operator("lodgs.train", text="Train Again", icon="FILE_REFRESH")
    else:
        row.operator("lodgs.train", text="Train", icon="PLAY")
    if not estimate:
        row.operator("lodgs.check_scene", text="", icon="TIME")
    if root.session_uid in scene_check.running:
        say(layout, "Estimating time and memory…", "TIME")


def _draw_views(column: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Draw the settings of the views to render from splats without photos."""
    settings = root.lodgs.training
    column.separator()
    draw_views(column, settings, viewpoints.view_count(settings))
    if settings.views_from == "DOME":
        try:
            _, radii = viewpoints.preview_dome(root)
        except LodgsError as error:
            say(column, str(error), "ERROR")
            return
        near, far = (scene_length(context, root, radius) for radius in radii)
        text = (
            f"Half the views are {near} or {far} from the centre of the splats, half close to their surface."
        )
        say(column, text, "INFO")


def _draw_parameter(layout: bpy.types.UILayout, group: bpy.types.PropertyGroup, name: str) -> None:
    """Draw a checkbox with the artist's value, or with the preset's value greyed out."""
    row = layout.row(align=True, heading=group.bl_rna.properties[name].name)
    row.prop(group, f"use_{name}", text="")
    value = row.row(align=True)
    value.enabled = group.is_property_set(name)
    value.prop(group, name if value.enabled else f"preset_{name}", text="")


def _draw_distances(layout: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Object) -> None:
    """Draw the distance from which each coarser level is shown, unless training finds the distances."""
    settings = root.lodgs.training
    layout.prop(settings, "find_distances")
    if settings.find_distances:
        return
    column = layout.column(align=True)
    for number, index in level_distances(settings):
        column.prop(settings, "distances", index=index, text=f"Level {number} From")
    text = "Unit: median depth of the photos"
    if settings.median_depth:
        text += f" ({scene_length(context, root, settings.median_depth)})"
    say(layout, text, "INFO")


def _draw_running(layout: bpy.types.UILayout, watch: Watch, root: bpy.types.Object) -> None:
    share = watch.fraction
    row = layout.row(align=True)
    message, _, note = watch.message.partition(" (")  # the bar has room for a few words
    row.progress(text=f"{message} · {share:.0%}" if share else message, factor=share)
    row.operator("lodgs.cancel_training", text="", icon="X")
    if note:
        say(layout, note.rstrip(")").capitalize(), "INFO")
    if watch.cancel_requested:
        say(layout, "Cancel again to stop immediately", "INFO")
    elif watch.unresponsive:
        text = "The trainer is not responding. Wait if the computer is busy. Otherwise cancel and resume."
        say(layout, text, "ERROR")
    draw_cells(layout, root, watch)
    facts = progress_facts(watch.progress)
    if facts:
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True)
        for name, value in facts.items():
            grid.label(text=name)
            grid.label(text=value)


def _draw_ended(layout: bpy.types.UILayout, watch: Watch, root: bpy.types.Object) -> None:
    box = layout.box()
    loaded = {item.number for item in root.lodgs.existing_levels}
    say(box, watch.message, "CHECKMARK" if watch.state == "done" else "PAUSE")
    column = box.column(align=True)
    events = [watch.levels[number] for number in sorted(watch.levels.keys() & loaded)]
    if views := next(filter(None, map(measured_on, events)), ""):
        say(column, f"Quality on {views}", "BLANK1")
    for event in events:
        say(column, short_level_line(event), "BLANK1")
    if missing := sorted(watch.levels.keys() - loaded):
        say(box, f"Levels not loaded: {', '.join(map(str, missing))}", "INFO")
        load = box.operator("lodgs.open_run", text="Load Levels", icon="IMPORT")
        load.directory = str(watch.folder.path)
    for line in summary_lines(watch.summary):
        say(box, line, "BLANK1")
    if watch.folder.sheet.is_file():
        box.operator("lodgs.show_levels", icon="IMAGE_DATA")
    if watch.problem:
        say(box, watch.problem, "ERROR")
    for warning in watch.warnings[-3:]:
        say(box, warning, "INFO")
    if watch.state != "done":
        draw_cells(box, root, watch)
        row = box.row()
        row.operator("lodgs.resume_training", text="Resume", icon="PLAY")
        if watch.problem:
            row.operator("lodgs.show_log", text="Show Log", icon="TEXT")


CLASSES = (LODGS_PT_training, LODGS_PT_training_advanced)
