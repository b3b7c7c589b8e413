"""The Distances panel: the distance from which each level is shown, and the saved rendering cost."""

from __future__ import annotations

import bpy

from ...training.evaluate.costs import cost_lines
from ..data import metadata, roots
from ..runs import run_folders
from .parts import LevelsPanel, say, scene_length


class LODGS_PT_costs(LevelsPanel):
    bl_label = "Distances"
    bl_parent_id = "LODGS_PT_levels"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        root = roots.root_with_levels(context)
        return root is not None and bool(_lines(context, root))

    def draw(self, context):
        root = roots.active_root(context)
        column = self.layout.column(align=True)
        column.label(text="Splats per Image Tile")
        for line in _lines(context, root):
            say(column, line, "NONE")
        if run_folders.cost_plot(root) is not None:
            self.layout.operator("lodgs.show_costs", icon="GRAPH")


def _lines(context: bpy.types.Context, root: bpy.types.Object) -> list[str]:
    """Return one line per level: its distance in Blender units and its rendering cost."""
    meta = metadata.meta_of(root)
    return cost_lines(meta, lambda value: scene_length(context, root, value))


CLASSES = (LODGS_PT_costs,)
