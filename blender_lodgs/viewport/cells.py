"""The cells that a large scene is trained in, as outlines on its ground in the viewport."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...training.lod.colors import level_color
from ..data import cells, roots
from ..data.placement import axes_of
from . import frusta

WIDTH = 2.5
"""Pixels of an outline; a half more of the chosen cell's."""
FAINT, FILLED = 0.5, 0.08
"""Opacities of what a cell is trained on beyond its own, and of the ground of the chosen one."""


def draw(scene: bpy.types.Scene) -> None:
    """Draws the cells that are to be shown into the active framebuffer, over everything."""
    for root in roots.roots(scene):
        settings = root.lodgs.training
        if not settings.show_cells or not settings.planned_cells:
            continue
        with gpu.matrix.push_pop():  # type: ignore[attr-defined]
            gpu.matrix.multiply_matrix(axes_of(root).matrix_world)
            gpu.state.blend_set("ALPHA")
            for number, cell in enumerate(settings.planned_cells, 1):
                color, chosen = level_color(number), number == settings.active_cell + 1
                corners = np.reshape(cell.outline, (4, 3))
                if chosen:
                    _draw("TRIS", corners[[0, 1, 2, 0, 2, 3]], (*color, FILLED))
                    _draw("LINES", frusta.pyramids(*cells.eyes(root, cell)), (*color, 1.0))
                _draw_lines(_around(np.reshape(cell.enlarged, (4, 3))), (*color, FAINT), 1.5)
                _draw_lines(_around(corners), (*color, 1.0), WIDTH * (1 + chosen / 2))
            gpu.state.blend_set("NONE")


def _around(corners: np.ndarray) -> np.ndarray:
    """The ends (8, 3) of the lines around four corners."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 3)


def _draw(kind: str, places: np.ndarray, color: tuple[float, ...]) -> None:
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", color)
    batch_for_shader(shader, kind, {"pos": places.astype(np.float32)}).draw(shader)


def _draw_lines(places: np.ndarray, color: tuple[float, ...], width: float) -> None:
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", color)
    batch_for_shader(shader, "LINES", {"pos": places.astype(np.float32)}).draw(shader)
