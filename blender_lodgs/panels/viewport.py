"""Viewport panel of the LODGS tab, and splat settings in the viewport's Overlays popover."""

from __future__ import annotations

import bpy

from ...training.lod.rule import resolve_rule
from ...training.splats.level_colors import level_color
from .. import compat, viewport
from ..data import roots
from ..viewport import view_state, views
from .parts import Panel, say, short_count, split_column


class LODGS_PT_viewport(Panel):
    bl_label = "Viewport"
    bl_order = 4

    @classmethod
    def poll(cls, context):
        return roots.shows_levels(context.scene)

    def draw(self, context):
        layout, settings = self.layout, context.scene.lodgs_viewport
        root = roots.active_root(context)
        column = split_column(layout)
        column.prop(settings, "splats")
        if settings.splats and compat.NATIVE_SPLATS:
            column.row(align=True).prop(settings, "drawn_by", expand=True)
        if settings.native:
            say(
                layout,
                "Blender draws all splats of visible levels, without splat budget, streaming, level colours "
                "and selection overlay.",
                "INFO",
            )
        elif settings.splats:
            column.prop(settings, "budget")
            column.prop(settings, "moving", slider=True)
        if root is not None and not settings.native:
            column = layout.column(align=True)
            column.active = len(root.lodgs.levels) != 1  # a single level has a single colour
            column.label(text="Colours")
            row = column.row(align=True)
            rule = resolve_rule(root.lodgs.rule)
            for colors in ("OWN", "LEVELS", "BANDS", *(["CHUNKS"] if rule.tables else [])):
                row.prop_enum(root.lodgs, "colors", colors)
            if root.lodgs.colors in ("LEVELS", "BANDS") and column.active and rule.color_legend:
                say(layout, rule.color_legend, "COLOR")
            elif root.lodgs.colors in ("LEVELS", "BANDS") and column.active:
                _legend(layout, [item.number for item in root.lodgs.existing_levels])
        if viewport.problem:
            text = f"Cannot draw splats: {viewport.problem}. Disable Gaussian Splats to draw points."
            say(layout, text, "ERROR")
        if settings.splats and not settings.native:
            _draw_speed(layout)


def _draw_speed(layout: bpy.types.UILayout) -> None:
    """Draw how many splats views draw, if fewer than all, and a budget for quick redraws."""
    if counts := views.reduced_counts():
        say(layout, _budget_text(*counts), "INFO")
    if suggestion := view_state.suggest_budget():
        count, seconds, budget = suggestion
        text = f"A redraw at rest takes {seconds:.1f} s for {short_count(count)} splats. "
        say(layout, text + f"For quick redraws, set Splat Budget to {budget:,}.", "INFO")
    if simplified := view_state.simplified_counts():
        moving, resting = map(short_count, simplified)
        say(layout, f"A moving view draws {moving} of {resting} splats, the small ones enlarged.", "INFO")


def _header_text(drawn: int, full: int) -> str:
    """Return the number of drawn splats so that it fits into the header of a small window."""
    return f"Budget: {short_count(drawn)} of {short_count(full)}"


def _budget_text(drawn: int, full: int) -> str:
    """Return the number of drawn splats, for example "1.2 M of 3.0 M splats (budget)"."""
    return f"{short_count(drawn)} of {short_count(full)} splats (budget)"


def _header(self, context):
    """Draw the number of splats that the budget leaves, in the header of the viewport."""
    settings = context.scene.lodgs_viewport
    regions = [region for region in context.area.regions if region.type == "WINDOW"]
    counts = views.reduced_counts(regions[-1]) if regions else None
    if settings.splats and not settings.native and counts:
        self.layout.label(text=_header_text(*counts))


def _legend(layout: bpy.types.UILayout, numbers: list[int]) -> None:
    """Draw the colour of each level, coarse to fine."""
    grid = layout.grid_flow(row_major=True, columns=min(len(numbers), 6), align=True)
    for number in numbers:
        entry = grid.row(align=True)
        entry.template_node_socket(color=(*level_color(number), 1.0))
        entry.label(text=str(number))


def _overlays(self, context):
    if not roots.shows_splats(context.scene):
        return
    self.layout.label(text="LODGS")
    row = self.layout.row()
    row.prop(context.scene.lodgs_viewport, "splats")
    root = roots.active_root(context)
    if root is not None and root.lodgs.cameras is not None:
        row.prop(
            root.lodgs.cameras, "hide_viewport", text="Training Cameras", toggle=True, invert_checkbox=True
        )


CLASSES = (LODGS_PT_viewport,)


def register() -> None:
    bpy.types.VIEW3D_PT_overlay.append(_overlays)
    bpy.types.VIEW3D_HT_header.append(_header)


def unregister() -> None:
    bpy.types.VIEW3D_HT_header.remove(_header)
    bpy.types.VIEW3D_PT_overlay.remove(_overlays)
