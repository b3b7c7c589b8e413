"""Selection of all kinds of clutter in one step, as a preview of what *Hide* removes."""

from __future__ import annotations

from typing import Any

import bpy

from ..data import cleaning, clutter, roots
from .base import EditLevelsOperator, report_errors

_LABELS = {
    "size": ("Size", "Splats with a larger standard deviation are selected"),
    "distance": ("Distance", "Splats farther than this from the centre of the subject are selected"),
    "gap": ("Gap", "Clusters closer than this count as one; 0 uses the density of the splats"),
    "share": ("Largest Cluster", "Clusters with more than this share of all splats are not selected"),
    "depth": ("Depth", "Splats deeper than this below the ground are selected"),
}


class LODGS_OT_find_clutter(EditLevelsOperator, bpy.types.Operator):
    """Select fog, floaters and outliers of every level, to look at them before hiding them"""

    bl_idname = "lodgs.find_clutter"
    bl_label = "Find Clutter"
    bl_options = {"REGISTER", "UNDO"}

    def draw(self, context):
        layout = self.layout
        for kind in clutter.KINDS:
            row = layout.row()
            row.prop(self, kind.identifier)
            column = layout.column()
            column.use_property_split = True
            if getattr(self, kind.identifier):
                row.label(text=f"{getattr(self, _count_name(kind.identifier)):,} splats")
                for name in kind.limits:
                    column.prop(self, name)

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        for name, value in clutter.suggest_limits(root).items():
            if not self.properties.is_property_set(name):
                setattr(self, name, value)
        kinds = [kind.identifier for kind in clutter.KINDS if getattr(self, kind.identifier)]
        limits = {name: getattr(self, name) for name in _LABELS}
        matches = clutter.find_clutter(context, root, kinds, limits)
        counts = {name: sum(int(mask.sum()) for mask in masks.values()) for name, masks in matches.items()}
        for name, count in counts.items():
            setattr(self, _count_name(name), count)
        total = cleaning.select(root, clutter.union(matches, root))
        labels = {kind.identifier: kind.label.lower() for kind in clutter.KINDS}
        parts = ", ".join(f"{labels[name]} {count:,}" for name, count in counts.items() if count)
        self.report({"INFO"}, f"{total:,} splats selected{': ' if parts else ''}{parts}")
        return {"FINISHED"}


def _count_name(kind: str) -> str:
    return f"{kind}_count"


def _properties() -> dict[str, Any]:
    """Return the operator's properties: use and count of each kind, and the limits."""
    result: dict[str, Any] = {}
    for kind in clutter.KINDS:
        result[kind.identifier] = bpy.props.BoolProperty(
            name=kind.label, description=kind.about, default=kind.identifier != "below"
        )
        result[_count_name(kind.identifier)] = bpy.props.IntProperty(options={"HIDDEN", "SKIP_SAVE"})
    for name, (label, about) in _LABELS.items():
        subtype = "PERCENTAGE" if name == "share" else "DISTANCE"
        result[name] = bpy.props.FloatProperty(
            name=label, description=about, min=0.0, subtype=subtype, options={"SKIP_SAVE"}
        )
    return result


LODGS_OT_find_clutter.__annotations__ = _properties()

CLASSES = (LODGS_OT_find_clutter,)
