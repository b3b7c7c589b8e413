"""Preview of all kinds of clutter in their colours, and their removal in one step."""

from __future__ import annotations

import bpy

from ..data import cleaning, clutter, roots
from ..data.cleanup_tests import CLUTTER_TESTS, unite_masks
from .base import EditLevelsOperator, report_errors


class LODGS_OT_find_clutter(EditLevelsOperator, bpy.types.Operator):
    """Show the clutter of every level in the colours of its kinds, to adjust before it is hidden"""

    bl_idname = "lodgs.find_clutter"
    bl_label = "Find Clutter"
    bl_options = {"REGISTER", "UNDO"}

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        clutter.start(context, root)
        self.report({"INFO"}, _text(clutter.count_by_kind(root) or {}, "found"))
        return {"FINISHED"}


class _PreviewOperator(EditLevelsOperator):
    """Base class of operators that end the preview."""

    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) and roots.active_root(context).lodgs_clutter.preview


class LODGS_OT_hide_clutter(_PreviewOperator, bpy.types.Operator):
    """Hide the coloured splats of every level"""

    bl_idname = "lodgs.hide_clutter"
    bl_label = "Hide Clutter"

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        matches = clutter.refresh(context, root)
        numbers = {name: sum(int(mask.sum()) for mask in masks.values()) for name, masks in matches.items()}
        count = cleaning.hide(root, unite_masks(matches, root))
        clutter.stop(root)
        self.report({"INFO"}, f"{count:,} splats hidden. {_text(numbers, 'hidden')}")
        return {"FINISHED"}


class LODGS_OT_cancel_clutter(_PreviewOperator, bpy.types.Operator):
    """Keep the coloured splats and show their own colours"""

    bl_idname = "lodgs.cancel_clutter"
    bl_label = "Keep Clutter"

    @report_errors
    def execute(self, context):
        clutter.stop(roots.active_root(context))
        return {"FINISHED"}


def _text(counts: dict[str, int], verb: str) -> str:
    labels = {test.identifier: test.label for test in CLUTTER_TESTS}
    parts = [f"{labels[name]} {count:,}" for name, count in counts.items() if count]
    return ", ".join(parts) or f"No clutter {verb}"


CLASSES = (LODGS_OT_find_clutter, LODGS_OT_hide_clutter, LODGS_OT_cancel_clutter)
