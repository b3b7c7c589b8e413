"""Operators that start, stop, resume and open training runs, each by one function of ``jobs``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from ..data import cells, roots
from ..runs import job_settings, jobs, run_folders
from ..runs.watch import Watch, root_by_uid, watch_of
from .base import SceneOperator, report_error, report_errors, show_image
from .modal import WaitingOperator, wait_for


def _follow(operator: bpy.types.Operator, watch: Watch):
    """Follow a run: to its end in background mode, otherwise while Blender stays responsive."""
    jobs.follow(watch)
    if watch.problem:
        report_error(operator, watch.problem)
    return {"FINISHED"} if watch.state in {"running", "done"} else {"CANCELLED"}


class LODGS_OT_train(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.train"
    bl_label = "Train Splats"
    bl_description = "Train splats with levels of detail from the scene's photos in the background"
    bl_options = {"UNDO"}

    folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of the run; empty for a new folder",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )

    @report_errors
    def execute(self, context):
        return _follow(self, jobs.start(roots.active_root(context), self.folder))


class LODGS_OT_resume_training(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.resume_training"
    bl_label = "Resume Training"
    bl_description = "Continue the run from its last checkpoint, with its original settings"
    bl_options = {"UNDO"}

    @report_errors
    def execute(self, context):
        return _follow(self, jobs.resume(roots.active_root(context)))


class LODGS_OT_cancel_training(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_training"
    bl_label = "Cancel Training"
    bl_description = "Save a checkpoint and stop, to resume later; press twice to stop immediately"

    @report_errors
    def execute(self, context):
        jobs.cancel(roots.active_root(context))
        return {"FINISHED"}


class LODGS_OT_plan_cells(WaitingOperator, SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.plan_cells"
    bl_label = "Plan Cells"
    bl_description = "Divide the scene into cells, and estimate the views, splats and memory of each"
    bl_options = {"UNDO"}

    _plan: cells.CellPlan | None = None

    def work(self, context):
        root = roots.active_root(context)
        uid = root.session_uid
        limits = root.lodgs.training.limits
        job = job_settings.make_job(root, run_folders.runs_parent(root), {})
        self._plan = yield from wait_for(partial(cells.plan_cells, job, *limits))
        root = root_by_uid(uid)
        if root is not None:  # undo may have replaced it
            cells.store_plan(root.lodgs.training, self._plan)

    def status_text(self, context, count):
        return "Planning cells, Esc to stop"

    def result_text(self, count):
        if self._plan is None:
            return "No cells planned"
        views = [cell.views for cell in self._plan.planned]
        return f"{len(views)} cells with {min(views)} to {max(views)} views"


class _CellOperator(SceneOperator):
    cell: bpy.props.IntProperty(name="Cell", description="Cell number, from 1", min=1, default=1)


class LODGS_OT_cancel_cell(_CellOperator, bpy.types.Operator):
    bl_idname = "lodgs.cancel_cell"
    bl_label = "Cancel Cell"
    bl_description = "Save this cell's checkpoint and stop it, while the other cells continue"
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context):
        jobs.cancel_cell(roots.active_root(context), self.cell)
        return {"FINISHED"}


class LODGS_OT_resume_cell(_CellOperator, bpy.types.Operator):
    bl_idname = "lodgs.resume_cell"
    bl_label = "Resume Cell"
    bl_description = "Continue this cell from its last checkpoint, along with the cells that are running"
    bl_options = {"INTERNAL"}

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        followed = watch_of(root)
        watch = jobs.resume_cell(root, self.cell)
        return {"FINISHED"} if watch is followed else _follow(self, watch)


class LODGS_OT_open_run(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.open_run"
    bl_label = "Open Training Run"
    bl_description = "Load the levels of a run folder, and follow the run if it is active"
    bl_options = {"UNDO"}

    directory: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of the run to open",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )

    def invoke(self, context, event):
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @report_errors
    def execute(self, context):
        watch = jobs.attach(roots.active_root(context), self.directory)
        jobs.follow(watch)
        return {"FINISHED"}


class LODGS_OT_show_log(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.show_log"
    bl_label = "Show Training Log"
    bl_description = "Show the last lines of the trainer's log, and store the log in a text data-block"

    def invoke(self, context, event):
        result = self.execute(context)
        if result == {"FINISHED"}:
            return context.window_manager.invoke_popup(self, width=900)
        return result

    @report_errors
    def execute(self, context):
        run_folders.log_text(roots.active_root(context))
        return {"FINISHED"}

    def draw(self, context):
        text = bpy.data.texts.get(run_folders.LOG)
        for line in (text.lines if text else [])[-20:]:
            self.layout.label(text=line.body)


class LODGS_OT_show_costs(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.show_costs"
    bl_label = "Show Cost Curve"
    bl_description = "Plot the rendering cost of each level distance in an Image Editor"

    @report_errors
    def execute(self, context):
        plot = run_folders.cost_plot(roots.active_root(context))
        if plot is None:
            raise LodgsError(
                "Cannot show the cost curve: the open run has none.", "Open the run of these levels."
            )
        _show_file(context, plot)
        return {"FINISHED"}


class LODGS_OT_show_levels(SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.show_levels"
    bl_label = "Show Image of Levels"
    bl_description = "Show all levels of the finished run from a held-out view in an Image Editor"

    @report_errors
    def execute(self, context):
        sheet = run_folders.level_sheet(roots.active_root(context))
        if sheet is None:
            raise LodgsError(
                "Cannot show the levels: the open run has no image of them.", "Finish the training first."
            )
        _show_file(context, sheet)
        return {"FINISHED"}


def _show_file(context: bpy.types.Context, path: Path) -> None:
    """Show an image file. Read it again, because a training may have replaced it."""
    image = bpy.data.images.load(str(path), check_existing=True)
    image.reload()
    show_image(context, image)


CLASSES = (
    LODGS_OT_train,
    LODGS_OT_resume_training,
    LODGS_OT_cancel_training,
    LODGS_OT_plan_cells,
    LODGS_OT_cancel_cell,
    LODGS_OT_resume_cell,
    LODGS_OT_open_run,
    LODGS_OT_show_log,
    LODGS_OT_show_costs,
    LODGS_OT_show_levels,
)
