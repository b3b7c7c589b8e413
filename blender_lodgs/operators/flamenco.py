"""The operator that has a render farm train cells."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor, wait

import bpy

from ..data import scenes
from ..runs import flamenco
from .base import SceneOperator
from .modal import SteppedOperator


class LODGS_OT_submit_to_flamenco(SceneOperator, SteppedOperator, bpy.types.Operator):
    bl_idname = "lodgs.submit_to_flamenco"
    bl_label = "Submit to Flamenco"
    bl_description = (
        "Have the render farm of the preferences train this scene in cells, with the settings of this panel. "
        "Its workers have to see the scene's and the run's folder"
    )

    folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder of the run, which all workers see; empty: a new one where the settings say",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )

    def invoke(self, context, event):
        return self.execute(context) if bpy.app.background else self.start_modal(context)

    def work(self, context):
        self._said = "The manager may have the job nevertheless"
        submission = flamenco.prepare(scenes.active_root(context), self.folder)
        sender = ThreadPoolExecutor(1, "lodgs-flamenco")
        try:
            sending = sender.submit(submission.send)
            while wait([sending], 0.01).not_done:
                yield
        finally:
            sender.shutdown(wait=False)
        self._said = f"Submitted: {sending.result()}. The run will be in {submission.settings['output']}"

    def status_text(self, context, count):
        return "Submitting to Flamenco; Esc stops"

    def result_text(self, count):
        return self._said


CLASSES = (LODGS_OT_submit_to_flamenco,)
