"""Operator that checks a scene before training."""

from __future__ import annotations

from threading import Event

import bpy

from ...training.scenes.check import INFO, Finding
from .. import extension
from ..data import roots
from ..runs import scene_check
from ..runs.watch import root_by_uid
from .base import SceneOperator
from .modal import WaitingOperator, wait_for


class LODGS_OT_check_scene(WaitingOperator, SceneOperator, bpy.types.Operator):
    bl_idname = "lodgs.check_scene"
    bl_label = "Check Scene"
    bl_description = (
        "Find problems of the photos and cameras that lower the quality of training, and estimate its time, "
        "memory and disk space"
    )

    _findings: list[Finding] | None = None

    @classmethod
    def poll(cls, context):
        if scene_check.running:
            cls.poll_message_set("A check is running")
            return False
        return super().poll(context)

    def work(self, context):
        root = roots.active_root(context)
        uid, key = root.session_uid, scene_check.settings_key(root)
        stop = Event()
        scene_check.running.add(uid)
        extension.redraw()
        try:
            self._findings = yield from wait_for(scene_check.read_findings(root, stop))
        finally:
            stop.set()
            scene_check.running.discard(uid)
            extension.redraw()
        root = root_by_uid(uid)
        if root is not None:  # undo may have replaced it
            scene_check.store_findings(root, key, self._findings)

    def status_text(self, context, count):
        return "Checking the scene, Esc to stop"

    def result_text(self, count):
        if self._findings is None:
            return "Scene not checked"
        lines = [str(finding) for finding in self._findings]
        if all(finding.severity == INFO for finding in self._findings):
            lines.append("Nothing found that lowers the quality")
        return "\n".join(lines)


CLASSES = (LODGS_OT_check_scene,)
