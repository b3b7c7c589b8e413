"""How well views cover a Blender scene: places on it as dots, by how many of the views will see them.

What views see is drawn as viewports draw it, without colour; it may differ from renders in what shows in
viewports alone, or in renders alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...training.scenes.cameras import Camera
from ...training.scenes.rendered_views import sample_coverage
from ..data import viewpoints

ENOUGH = 3
"""Views that have to see a place for it to be where they show it."""
COLORS = ((0.9, 0.1, 0.05, 1.0), (1.0, 0.65, 0.0, 1.0), (0.2, 0.8, 0.25, 1.0))
"""Of places that one view sees, two, and ENOUGH."""
PIXELS = 160
"""How wide the views are drawn."""
MOST = 40_000
"""Dots."""
SIZE = 3.0
"""Of a dot in pixels."""


class Coverage(NamedTuple):
    """Places (N, 3), by how many views each is seen (N,), and of which settings that is."""

    points: np.ndarray
    counts: np.ndarray
    settings: tuple

    @property
    def enough(self) -> float:
        """The share of what views show that ENOUGH of them see."""
        return float((self.counts >= ENOUGH).mean()) if len(self.counts) else 0.0


_current: Coverage | None = None


def current(scene: bpy.types.Scene) -> Coverage | None:
    """What was measured last, while the settings are the same."""
    return _current if _current and _current.settings == _settings(scene) else None


def clear() -> None:
    """Shows none."""
    global _current
    _current = None


def measure(context: bpy.types.Context) -> Coverage:
    """Measures and shows how well the views cover what is to be captured.

    Args:
        context: of a 3D viewport.

    Raises:
        LodgsError: as ``viewpoints.of_scene``.
    """
    global _current
    scene, window = context.scene, context.window_manager
    width, height = viewpoints.size(scene, scene.lodgs_capture)
    views = viewpoints.seen_from(context, width, height)
    screen = gpu.types.GPUOffScreen(PIXELS, max(round(PIXELS * height / width), 1))
    depths = []
    window.progress_begin(0, len(views))
    try:
        with _plain(context.space_data, context.preferences.system):
            for number, (view, near) in enumerate(views):
                window.progress_update(number)
                depths.append(_depths(context, screen, view, near))
    finally:
        window.progress_end()
        screen.free()
    _current = Coverage(*sample_coverage([view for view, _ in views], depths, MOST), _settings(scene))
    return _current


def draw(scene: bpy.types.Scene) -> None:
    """Draws the dots into the active framebuffer, behind what is before them."""
    measured = current(scene)
    if measured is None:
        return
    colors = np.asarray(COLORS, np.float32)[np.minimum(measured.counts, ENOUGH) - 1]
    content = {"pos": measured.points.astype(np.float32), "color": colors}
    shader = gpu.shader.from_builtin("POINT_FLAT_COLOR")
    batch = batch_for_shader(shader, "POINTS", content)
    with gpu.matrix.push_pop_projection():  # type: ignore[attr-defined]
        nearer = Matrix.Translation((0, 0, -2e-4))  # than the surfaces that they lie on
        gpu.matrix.load_projection_matrix(nearer @ gpu.matrix.get_projection_matrix())
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.point_size_set(SIZE)
        batch.draw(shader)
        gpu.state.depth_test_set("NONE")


def _settings(scene: bpy.types.Scene) -> tuple:
    chosen = scene.lodgs_capture
    return scene.session_uid, chosen.views_from, chosen.views, chosen.view_width, chosen.height, chosen.curve


@contextmanager
def _plain(space: bpy.types.SpaceView3D, system: bpy.types.PreferencesSystem) -> Iterator[None]:
    """Has a viewport draw surfaces and nothing else, and once: smoothing would draw them several times."""
    before = space.shading.type, space.overlay.show_overlays, system.viewport_aa
    try:
        space.shading.type, space.overlay.show_overlays, system.viewport_aa = "SOLID", False, "OFF"
        yield
    finally:
        space.shading.type, space.overlay.show_overlays, system.viewport_aa = before


def _depths(
    context: bpy.types.Context, screen: gpu.types.GPUOffScreen, view: Camera, near: float
) -> np.ndarray:
    """Depths (H, W) along the z axis of a view of what a viewport draws; 0 where that is nothing."""
    pose = Matrix((np.diag([1.0, -1.0, -1.0, 1.0]) @ view.world_to_camera).tolist())
    lens = Matrix(
        (
            (2 * view.fx / view.width, 0, 1 - 2 * view.cx / view.width, 0),
            (0, 2 * view.fy / view.height, 2 * view.cy / view.height - 1, 0),
            (0, 0, -1, -2 * near),  # to any depth
            (0, 0, -1, 0),
        )
    )
    region = next(region for region in context.area.regions if region.type == "WINDOW")
    screen.draw_view3d(
        context.scene, context.view_layer, context.space_data, region, pose, lens, do_color_management=False
    )
    with screen.bind():  # type: ignore[attr-defined]
        buffer = gpu.state.active_framebuffer_get().read_depth(0, 0, screen.width, screen.height)
    drawn = np.array(buffer, np.float64).reshape(screen.height, screen.width)[::-1]
    return np.divide(near, 1 - drawn, out=np.zeros_like(drawn), where=drawn < 1)
