"""The LODGS menu of all operators, so that F3 search lists them, and the menu of a scene's training runs."""

from __future__ import annotations

import bpy

from ...training.methods import method_info
from ..data import roots
from ..runs import run_folders

OPERATORS = (
    ("lodgs.check_scene", "lodgs.train", "lodgs.resume_training", "lodgs.cancel_training", "lodgs.open_run",
     "lodgs.add_region", "lodgs.plan_cells", "lodgs.submit_to_flamenco", "lodgs.show_log",
     "lodgs.show_costs", "lodgs.show_levels", "lodgs.reduce_detail"),
    ("lodgs.look_through", "lodgs.compare_view", "lodgs.compare_worst", "lodgs.measure_views",
     "lodgs.cancel_measuring", "lodgs.show_evidence", "lodgs.compare_methods"),
    ("lodgs.use_engine", "lodgs.render_quick", "lodgs.combine_with_meshes", "lodgs.separate_meshes",
     "lodgs.add_shadow_catcher", "lodgs.render_mesh_depth", "lodgs.export_camera"),
    ("lodgs.reload_splats", "lodgs.add_to_scene", "lodgs.capture_scene", "lodgs.import_capture",
     "lodgs.reset_look", "lodgs.tint_by_light", "lodgs.remove_paint", "lodgs.remove_scene"),
)  # fmt: skip
"""Operators of the menu, without those that other menus list: placement, clean-up, import and export."""


class LODGS_MT_verbs(bpy.types.Menu):
    bl_label = "LODGS"

    def draw(self, context):
        layout = self.layout
        layout.menu("LODGS_MT_runs")
        for group in OPERATORS:
            layout.separator()
            for name in group:
                layout.operator(name)


class LODGS_MT_runs(bpy.types.Menu):
    bl_label = "Training Runs"
    bl_description = "Load the levels of another run of this scene; all runs stay in their folders"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return roots.active_root(context) is not None

    def draw(self, context):
        root = roots.active_root(context)
        runs = run_folders.find_runs(root) if root is not None else []
        current = run_folders.automatic_run(root) if root is not None else None
        for run in runs:
            text = (
                f"{run.folder.path.name}: {method_info(run.job.method).label}, {run.job.preset}, {run.state}"
            )
            is_current = current is not None and current.path == run.folder.path
            icon = "RADIOBUT_ON" if is_current else "RADIOBUT_OFF"
            operator = self.layout.operator("lodgs.open_run", text=text, icon=icon)
            operator.directory = str(run.folder.path)
        if not runs:
            self.layout.label(text="No runs yet", icon="INFO")


def _menu(self, context):
    self.layout.menu("LODGS_MT_verbs")


CLASSES = (LODGS_MT_runs, LODGS_MT_verbs)


def register() -> None:
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
