"""Outlines of the training cells of a large scene, on its ground in the viewport."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...training.splats.level_colors import level_color
from ..data import cells, roots
from ..data.placement import axes_of
from . import frusta

WIDTH = 2.5
"""Width of outlines in pixels; the active cell's is 1.5 times as wide."""
MARGIN_OPACITY = 0.5
"""Opacity of the outlines of enlarged cells."""
FILL_OPACITY = 0.08
"""Opacity of the active cell's fill."""


def draw(scene: bpy.types.Scene) -> None:
    """Draw displayed cells into the active framebuffer, on top of everything."""
    for root in roots.roots(scene):
        settings = root.lodgs.training
        if not settings.show_cells or not settings.planned_cells:
            continue
        with gpu.matrix.push_pop():  # type: ignore[attr-defined]
            gpu.matrix.multiply_matrix(axes_of(root).matrix_world)
            gpu.state.blend_set("ALPHA")
            for number, cell in enumerate(settings.planned_cells, 1):
                color = level_color(number)
                active = number == settings.active_cell + 1
                corners = np.reshape(cell.outline, (4, 3))
                if active:
                    _draw("TRIS", corners[[0, 1, 2, 0, 2, 3]], (*color, FILL_OPACITY))
                    _draw("LINES", frusta.pyramids(*cells.cell_cameras(root, cell)), (*color, 1.0))
                _draw_lines(_outline(np.reshape(cell.enlarged, (4, 3))), (*color, MARGIN_OPACITY), 1.5)
                _draw_lines(_outline(corners), (*color, 1.0), WIDTH * (1 + active / 2))
            gpu.state.blend_set("NONE")


def _outline(corners: np.ndarray) -> np.ndarray:
    """Return the end points (8, 3) of the lines around four corners."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)


def _draw(kind: str, points: np.ndarray, color: tuple[float, ...]) -> None:
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", color)
    batch_for_shader(shader, kind, {"pos": points.astype(np.float32)}).draw(shader)


def _draw_lines(points: np.ndarray, color: tuple[float, ...], width: float) -> None:
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", color)
    batch_for_shader(shader, "LINES", {"pos": points.astype(np.float32)}).draw(shader)
