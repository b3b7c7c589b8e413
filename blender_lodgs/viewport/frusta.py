"""Previews of training and capture views as small pyramids in the viewport."""

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
"""Length of pyramids as a fraction of the mean distance of views, if they filled a square of their extent."""


def draw(context: bpy.types.Context) -> None:
    """Draw previewed views into the active framebuffer, on top of everything."""
    for root in roots.roots(context.scene):
        if root.lodgs.training.show_views and viewpoints.has_only_splats(root):
            with suppress(LodgsError):  # the panel shows it
                _draw(viewpoints.preview_views(root), axes_of(root).matrix_world)
    if context.scene.lodgs_capture.show_views and roots.active_root(context) is None:  # as the Capture panel
        with suppress(LodgsError):
            _draw(viewpoints.placed_capture_views(context)[0], Matrix())


def _draw(views: list[Camera], matrix: Matrix) -> None:
    if not views:
        return
    extent = np.linalg.norm(np.ptp([view.center for view in views], axis=0))
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "LINES", {"pos": lines(views, LENGTH * extent / np.sqrt(len(views)))})
    with gpu.matrix.push_pop():  # type: ignore[attr-defined]
        gpu.matrix.multiply_matrix(matrix)
        shader.bind()
        shader.uniform_float("color", COLOR)
        batch.draw(shader)


def lines(views: list[Camera], length: float) -> np.ndarray:
    """Return the end points (16 * V, 3) of the lines of V cameras, in the splats' space."""
    corners = []
    for view in views:
        x, y = np.array([0, view.width]) - view.cx, np.array([0, view.height]) - view.cy
        rays = [(x[i] / view.fx, y[j] / view.fy, 1.0) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        corners.append(view.center + length * np.array(rays) @ view.world_to_camera[:3, :3])
    return pyramids(np.array([view.center for view in views]), np.array(corners))


def pyramids(apexes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the line end points (16 * V, 3) of pyramids with apexes (V, 3) and base corners (V, 4, 3)."""
    sides = np.stack([np.broadcast_to(apexes[:, None], corners.shape), corners], axis=2)
    bases = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([sides, bases], axis=1).reshape(-1, 3).astype(np.float32)
