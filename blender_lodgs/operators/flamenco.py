"""The operator that submits the training of cells to a render farm."""

from __future__ import annotations

import bpy

from ..data import roots
from ..runs import flamenco
from .base import SceneOperator
from .modal import WaitingOperator, wait_for


class LODGS_OT_submit_to_flamenco(WaitingOperator, SceneOperator, bpy.types.Operator):
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

    def work(self, context):
        self._result = "The manager may have received the job"
        submission = flamenco.prepare(roots.active_root(context), self.folder)
        job = yield from wait_for(submission.send)
        self._result = f"Submitted: {job}. Run folder: {submission.settings['output']}"

    def status_text(self, context, count):
        return "Submitting to Flamenco, Esc to stop"

    def result_text(self, count):
        return self._result


CLASSES = (LODGS_OT_submit_to_flamenco,)
