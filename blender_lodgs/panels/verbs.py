"""The menu of all verbs, so that Blender's search (F3) finds them; and that of a scene's runs."""

from __future__ import annotations

import bpy

from ...training.methods import method_info
from ..data import scenes
from ..runs import jobs

VERBS = (
    ("lodgs.train", "lodgs.resume_training", "lodgs.cancel_training", "lodgs.open_run", "lodgs.add_region",
     "lodgs.plan_cells", "lodgs.submit_to_flamenco", "lodgs.show_log", "lodgs.show_costs"),
    ("lodgs.look_through", "lodgs.compare_view", "lodgs.compare_worst", "lodgs.measure_views",
     "lodgs.cancel_measuring"),
    ("lodgs.use_engine", "lodgs.render_quick", "lodgs.combine_with_meshes", "lodgs.separate_meshes",
     "lodgs.render_mesh_depth", "lodgs.export_camera"),
    ("lodgs.add_to_scene", "lodgs.capture_scene", "lodgs.import_capture", "lodgs.reset_look",
     "lodgs.remove_paint", "lodgs.remove_scene"),
)  # fmt: skip
"""What the menu has, beside what other menus have: placing, cleaning, File's Import and Export."""


class LODGS_MT_verbs(bpy.types.Menu):
    bl_label = "LODGS"

    def draw(self, context):
        layout = self.layout
        layout.menu("LODGS_MT_runs")
        for group in VERBS:
            layout.separator()
            for name in group:
                layout.operator(name)


class LODGS_MT_runs(bpy.types.Menu):
    bl_label = "Runs of This Scene"
    bl_description = "Show the levels of another run; what is shown now stays in its own folder"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return scenes.active_root(context) is not None

    def draw(self, context):
        root = scenes.active_root(context)
        found = jobs.runs_of(root) if root is not None else []
        current = jobs.run_folder(root) if root is not None else None
        for run in found:
            text = (
                f"{run.folder.path.name}: {method_info(run.job.method).label}, {run.job.preset}, {run.state}"
            )
            shown = current is not None and current.path == run.folder.path
            icon = "RADIOBUT_ON" if shown else "RADIOBUT_OFF"
            operator = self.layout.operator("lodgs.open_run", text=text, icon=icon)
            operator.directory = str(run.folder.path)
        if not found:
            self.layout.label(text="None yet", icon="INFO")


def _menu(self, context):
    self.layout.menu("LODGS_MT_verbs")


CLASSES = (LODGS_MT_runs, LODGS_MT_verbs)


def register() -> None:
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
