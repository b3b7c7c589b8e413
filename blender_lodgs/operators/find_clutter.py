"""Selection of all kinds of clutter in one step, as a preview of what *Hide* removes."""

from __future__ import annotations

from typing import Any

import bpy

from ..data import cleaning, roots
from ..data.cleanup_tests import (
    CLUTTER_TESTS,
    CleanupTest,
    find_clutter,
    limit_properties,
    limit_property,
    suggest_clutter_limits,
    union,
)
from .base import EditLevelsOperator, report_errors


class LODGS_OT_find_clutter(EditLevelsOperator, bpy.types.Operator):
    """Select fog, floaters and outliers of every level, to look at them before hiding them"""

    bl_idname = "lodgs.find_clutter"
    bl_label = "Find Clutter"
    bl_options = {"REGISTER", "UNDO"}

    def draw(self, context):
        layout = self.layout
        for test in CLUTTER_TESTS:
            row = layout.row()
            row.prop(self, _use_name(test))
            column = layout.column()
            column.use_property_split = True
            if getattr(self, _use_name(test)):
                row.label(text=f"{getattr(self, _count_name(test)):,} splats")
                for name in test.limits:
                    column.prop(self, limit_property(name))

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        for name, value in suggest_clutter_limits(root).items():
            if not self.properties.is_property_set(name):
                setattr(self, name, value)
        tests = [test for test in CLUTTER_TESTS if getattr(self, _use_name(test))]
        matches = {test.label: find_clutter(test, context, root, self) for test in tests}
        counts = {label: sum(int(mask.sum()) for mask in masks.values()) for label, masks in matches.items()}
        for test in tests:
            setattr(self, _count_name(test), counts[test.label])
        total = cleaning.select(root, union(matches, root))
        parts = ", ".join(f"{label.lower()} {count:,}" for label, count in counts.items() if count)
        self.report({"INFO"}, f"{total:,} splats selected{': ' if parts else ''}{parts}")
        return {"FINISHED"}


def _use_name(test: CleanupTest) -> str:
    return test.identifier.lower()


def _count_name(test: CleanupTest) -> str:
    return f"{_use_name(test)}_count"


def _properties() -> dict[str, Any]:
    """Return the operator's properties: use and count of each test, and the limits."""
    result: dict[str, Any] = {}
    for test in CLUTTER_TESTS:
        about = test.about + (", near the subject only" if test.clutter == "near" else "")
        result[_use_name(test)] = bpy.props.BoolProperty(
            name=test.label, description=about, default=test.identifier != "BELOW"
        )
        result[_count_name(test)] = bpy.props.IntProperty(options={"HIDDEN", "SKIP_SAVE"})
    return result | limit_properties(CLUTTER_TESTS)


LODGS_OT_find_clutter.__annotations__ = _properties()

CLASSES = (LODGS_OT_find_clutter,)
