"""The operator that submits the training of cells to a render farm."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor, wait

import bpy

from ..data import roots
from ..runs import flamenco
from .base import SceneOperator
from .modal import SteppedOperator


class LODGS_OT_submit_to_flamenco(SceneOperator, SteppedOperator, bpy.types.Operator):
    bl_idname = "lodgs.submit_to_flamenco"
    bl_label = "Submit to Flamenco"
    bl_description = (
        "Train this scene's cells on the render farm set in the preferences; all workers need access to the "
        "scene folder and the run folder"
    )

    folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Run folder that all workers can access; empty for a new folder",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )

    def invoke(self, context, event):
        return self.execute(context) if bpy.app.background else self.start_modal(context)

    def work(self, context):
        self._result = "The manager may have received the job"
        submission = flamenco.prepare(roots.active_root(context), self.folder)
        sender = ThreadPoolExecutor(1, "lodgs-flamenco")
        try:
            sending = sender.submit(submission.send)
            while wait([sending], 0.01).not_done:
                yield
        finally:
            sender.shutdown(wait=False)
        self._result = f"Submitted: {sending.result()}. Run folder: {submission.settings['output']}"

    def status_text(self, context, count):
        return "Submitting to Flamenco, Esc to stop"

    def result_text(self, count):
        return self._result


CLASSES = (LODGS_OT_submit_to_flamenco,)
