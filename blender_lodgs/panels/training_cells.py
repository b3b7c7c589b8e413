"""The Large Scene panel: plan and progress of training in cells."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ...training.splats.level_colors import level_color
from ..data import cells, roots, viewpoints
from ..runs import job_settings, run_folders
from ..runs.watch import RunPart, Watch, watch_of
from .parts import Panel, say, short_count, split_column

_NUMBER_WIDTH = 0.16
"""Fraction of a row's width for the cell's colour and number."""
_ICONS = {
    "waiting": "SORTTIME",
    "done": "CHECKMARK",
    "cancelled": "PAUSE",
    "stopped": "PAUSE",
    "failed": "ERROR",
}


class LODGS_UL_cells(bpy.types.UIList):
    """List of planned cells."""

    def draw_item(
        self, context, layout, data, item, icon, active_data, active_property, index: int = 0, flt_flag=0
    ):
        row = _numbered(layout, index + 1)
        _columns(row, str(item.views), short_count(item.splats), _memory(item.megabytes))


class LODGS_UL_blocks(bpy.types.UIList):
    """List of cells in training, with their progress."""

    def draw_item(
        self, context, layout, data, item, icon, active_data, active_property, index: int = 0, flt_flag=0
    ):
        watch = watch_of(data.id_data)
        number = index + 1
        part = watch.part(number) if watch else None
        if watch is not None and part is not None:
            row = _numbered(layout, number).row(align=True)
            stopping = (part.kind, number) in watch.stopping
            _draw_part(row, part, stopping)
            if watch.running and part.state == "waiting" and stopping:
                row.label(icon="BLANK1")
            elif watch.running and part.state in ("waiting", "running"):
                row.operator("lodgs.cancel_cell", text="", icon="X", emboss=False).cell = number
            elif part.state != "done":
                row.operator("lodgs.resume_cell", text="", icon="PLAY", emboss=False).cell = number


def _draw_part(layout: bpy.types.UILayout, part: RunPart, stopping: bool = False) -> None:
    share = f"{part.fraction:.0%}"
    if stopping and part.state == "waiting":  # the run reports it only when it reaches this cell
        layout.label(text="Cancelled", icon=_ICONS["cancelled"])
    elif stopping:
        layout.label(text=f"Stopping at {share}", icon="SORTTIME")
    elif part.state == "running":
        layout.progress(text=f"Borders, {share}" if part.kind == "seam" else share, factor=part.fraction)
    else:
        suffix = f" at {share}" if part.fraction and part.state != "done" else ""
        layout.label(text=f"{part.state.capitalize()}{suffix}", icon=_ICONS[part.state])


class LODGS_PT_training_cells(Panel):
    bl_label = "Large Scene"
    bl_parent_id = "LODGS_PT_training"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = roots.active_root(context)
        if root is None or not root.lodgs.scene_folder or viewpoints.has_only_splats(root):
            return False
        watch = watch_of(root)  # while it runs, only a plan has something to show
        return bool(root.lodgs.training.planned_for) or not (watch and watch.running)

    def draw(self, context):
        root = roots.active_root(context)
        layout, settings, watch = self.layout, root.lodgs.training, watch_of(root)
        if not (watch and watch.running):
            _draw_settings(layout, root)
        if settings.planned_for:
            layout.prop(settings, "show_cells", toggle=True)


def _draw_settings(layout: bpy.types.UILayout, root: bpy.types.Object) -> None:
    settings = root.lodgs.training
    column = split_column(layout)
    column.prop(settings, "divide_by", text="Cells")
    if settings.divide_by == "GRID":
        row = column.row(align=True)
        row.prop(settings, "columns", text="Columns, Rows")
        row.prop(settings, "rows", text="")
    else:
        column.prop(settings, "cell_splats" if settings.divide_by == "SPLATS" else "cell_memory")
    if settings.divide_by == "GRID" and not settings.grid:
        say(layout, "One cell trains the scene as a whole.", "INFO")
        return
    column.prop(settings, "at_once")
    column.prop(settings, "polish")
    try:
        job = job_settings.make_job(root, run_folders.runs_parent(root), {})
    except LodgsError as error:
        say(layout, str(error), "ERROR")
        return
    layout.operator("lodgs.plan_cells", icon="MESH_GRID")
    if settings.planned_for:
        current = cells.is_planned(settings, job)
        if not current:
            say(layout, "The settings have changed. Plan the cells again.", "INFO")
        column = layout.column()
        column.active = current
        _draw_plan(column, settings)


def _draw_plan(layout, settings):
    head = layout.row()
    _columns(_numbered(head, None), "Views", "Splats", "Memory")
    rows = min(max(len(settings.planned_cells), 3), 8)
    layout.template_list("LODGS_UL_cells", "", settings, "planned_cells", settings, "active_cell", rows=rows)
    cell = settings.planned_cells[settings.active_cell]
    say(layout, f"{cell.points:,} initial points, {cell.steps:,} steps", "NONE")


def draw_cells(layout: bpy.types.UILayout, root: bpy.types.Object, watch: Watch) -> None:
    """Draw the progress of each cell of a run, with a button to cancel or resume it."""
    settings = root.lodgs.training
    coarse = watch.part(0)
    if coarse is not None and coarse.state != "done":
        row = layout.split(factor=0.4)
        row.label(text="Coarse levels")
        _draw_part(row, coarse)
    if len(settings.planned_cells) == watch.cells > 0:  # a newer plan has other cells
        rows = min(max(len(settings.planned_cells), 3), 8)
        layout.template_list(
            "LODGS_UL_blocks", "", settings, "planned_cells", settings, "active_cell", rows=rows
        )


def _numbered(layout: bpy.types.UILayout, number: int | None) -> bpy.types.UILayout:
    """Start a row with a cell's colour and number, or an empty space, and return the rest of the row."""
    split = layout.split(factor=_NUMBER_WIDTH)
    row = split.row(align=True)
    if number is not None:
        row.template_node_socket(color=(*level_color(number), 1.0))
    row.label(text=str(number or ""))
    return split


def _columns(row: bpy.types.UILayout, *texts: str) -> None:
    grid = row.grid_flow(row_major=True, columns=len(texts), even_columns=True, align=True)
    for text in texts:
        grid.label(text=text)


def _memory(megabytes: float) -> str:
    return f"{megabytes / 1000:.1f} GB" if megabytes >= 100 else f"{megabytes:.0f} MB"


CLASSES = (LODGS_UL_cells, LODGS_UL_blocks, LODGS_PT_training_cells)
