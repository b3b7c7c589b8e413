"""The views that will be placed around splats or in a Blender scene, as small pyramids in the viewport."""

from __future__ import annotations

from contextlib import suppress

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.scenes.cameras import Camera
from ..data import roots, viewpoints
from ..data.placement import axes_of

COLOR = (1.0, 0.75, 0.2, 1.0)
LENGTH = 0.2
"""Of a pyramid, as a share of how far views would be apart that lie in a square as wide as theirs."""


def draw(context: bpy.types.Context) -> None:
    """Draws the views that are to be shown into the active framebuffer, over everything."""
    for root in roots.roots(context.scene):
        if root.lodgs.training.show_views and viewpoints.alone(root):
            with suppress(LodgsError):  # which the panel says
                _draw(viewpoints.placed_of(root), axes_of(root).matrix_world)
    if context.scene.lodgs_capture.show_views:
        with suppress(LodgsError):
            _draw(viewpoints.placed_in_scene(context)[0], Matrix())


def _draw(views: list[Camera], matrix: Matrix) -> None:
    if not views:
        return
    wide = np.linalg.norm(np.ptp([view.center for view in views], axis=0))
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "LINES", {"pos": lines(views, LENGTH * wide / np.sqrt(len(views)))})
    with gpu.matrix.push_pop():  # type: ignore[attr-defined]
        gpu.matrix.multiply_matrix(matrix)
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
    return pyramids(np.array([view.center for view in views]), np.array(corners))


def pyramids(eyes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The ends (16 * V, 3) of the lines from eyes (V, 3) to the corners (V, 4, 3) before them, and around."""
    edges = np.stack([np.broadcast_to(eyes[:, None], corners.shape), corners], axis=2)
    frame = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([edges, frame], axis=1).reshape(-1, 3).astype(np.float32)
