"""The views that training will place around splats, as small pyramids in the viewport."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...training.errors import LodgsError
from ..data import scenes, viewpoints
from ..data.placement import axes_of

COLOR = (1.0, 0.75, 0.2, 1.0)
LENGTH = 0.12
"""Of a pyramid, as a share of how far the nearer views are from the middle."""


def draw(scene: bpy.types.Scene) -> None:
    """Draws the domes that are to be shown into the active framebuffer, over everything."""
    for root in scenes.roots(scene):
        settings = root.lodgs.training
        if settings.show_views and settings.views_from == "DOME" and viewpoints.alone(root):
            try:
                views, shells = viewpoints.dome_of(root)
            except LodgsError:  # which the panel says
                continue
            shader = gpu.shader.from_builtin("UNIFORM_COLOR")
            batch = batch_for_shader(shader, "LINES", {"pos": lines(views, LENGTH * shells[0])})
            with gpu.matrix.push_pop():  # type: ignore[attr-defined]
                gpu.matrix.multiply_matrix(axes_of(root).matrix_world)
                shader.bind()
                shader.uniform_float("color", COLOR)
                batch.draw(shader)


def lines(views: list, length: float) -> np.ndarray:
    """The ends (16 * V, 3) of the lines that show V cameras, in the splats' own space."""
    corners = []
    for view in views:
        x, y = np.array([0, view.width]) - view.cx, np.array([0, view.height]) - view.cy
        ahead = [(x[i] / view.fx, y[j] / view.fy, 1.0) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        corners.append(view.center + length * np.array(ahead) @ view.world_to_camera[:3, :3])
    eyes, corners = np.array([view.center for view in views])[:, None], np.array(corners)
    edges = np.stack([np.broadcast_to(eyes, corners.shape), corners], axis=2)
    frame = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([edges, frame], axis=1).reshape(-1, 3).astype(np.float32)
