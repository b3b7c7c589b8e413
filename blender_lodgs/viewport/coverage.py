"""Coverage of a Blender scene by capture views: surface points as dots, coloured by the number of views.

Visibility comes from viewport drawing. It differs from renders for objects that only one of them shows.
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
from ..data import roots, viewpoints

ENOUGH_VIEWS = 3
"""Number of views that have to see a point to reconstruct its position."""
COLORS = ((0.9, 0.1, 0.05, 1.0), (1.0, 0.65, 0.0, 1.0), (0.2, 0.8, 0.25, 1.0))
"""Colours of points seen by one view, two views, and at least ENOUGH_VIEWS views."""
DEPTH_WIDTH = 160
"""Width of the depth images in pixels."""
MAX_POINTS = 40_000
"""Maximum number of dots."""
DOT_SIZE = 3.0
"""Diameter of a dot in pixels."""


class Coverage(NamedTuple):
    """Surface points (N, 3), the number of views that see each (N,), and the settings used."""

    points: np.ndarray
    counts: np.ndarray
    settings: tuple

    @property
    def covered(self) -> float:
        """Fraction of the visible points that at least ENOUGH_VIEWS views see."""
        return float((self.counts >= ENOUGH_VIEWS).mean()) if len(self.counts) else 0.0


_current: Coverage | None = None


def current(scene: bpy.types.Scene) -> Coverage | None:
    """Return the last measurement; None if the settings have changed."""
    return _current if _current and _current.settings == _settings(scene) else None


def clear() -> None:
    """Remove the dots."""
    global _current
    _current = None


def measure(context: bpy.types.Context) -> Coverage:
    """Measure the coverage of the scene by the capture views and display it.

    Args:
        context: context of a 3D viewport.

    Raises:
        LodgsError: see ``viewpoints.capture_shots``.
    """
    global _current
    scene, window = context.scene, context.window_manager
    width, height = viewpoints.image_size(scene, scene.lodgs_capture)
    views = viewpoints.capture_views(context, width, height)
    screen = gpu.types.GPUOffScreen(DEPTH_WIDTH, max(round(DEPTH_WIDTH * height / width), 1))
    depths = []
    window.progress_begin(0, len(views))
    try:
        with _surfaces_only(context.space_data, context.preferences.system):
            for number, (view, near) in enumerate(views):
                window.progress_update(number)
                depths.append(_depths(context, screen, view, near))
    finally:
        window.progress_end()
        screen.free()
    _current = Coverage(*sample_coverage([view for view, _ in views], depths, MAX_POINTS), _settings(scene))
    return _current


def draw(scene: bpy.types.Scene) -> None:
    """Draw the dots into the active framebuffer, tested against its depth."""
    coverage = current(scene)
    if coverage is None or roots.active_root(bpy.context) is not None:  # the panel is hidden then, too
        return
    colors = np.asarray(COLORS, np.float32)[np.minimum(coverage.counts, ENOUGH_VIEWS) - 1]
    content = {"pos": coverage.points.astype(np.float32), "color": colors}
    shader = gpu.shader.from_builtin("POINT_FLAT_COLOR")
    batch = batch_for_shader(shader, "POINTS", content)
    with gpu.matrix.push_pop_projection():  # type: ignore[attr-defined]
        nearer = Matrix.Translation((0, 0, -2e-4))  # in front of their own surfaces
        gpu.matrix.load_projection_matrix(nearer @ gpu.matrix.get_projection_matrix())
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.point_size_set(DOT_SIZE)
        batch.draw(shader)
        gpu.state.depth_test_set("NONE")


def _settings(scene: bpy.types.Scene) -> tuple:
    capture = scene.lodgs_capture
    view_settings = capture.views_from, capture.views, capture.view_width, capture.height, capture.curve
    return scene.session_uid, *view_settings


@contextmanager
def _surfaces_only(space: bpy.types.SpaceView3D, system: bpy.types.PreferencesSystem) -> Iterator[None]:
    """Make a viewport draw only surfaces, without antialiasing, which draws each frame several times."""
    previous = space.shading.type, space.overlay.show_overlays, system.viewport_aa
    try:
        space.shading.type, space.overlay.show_overlays, system.viewport_aa = "SOLID", False, "OFF"
        yield
    finally:
        space.shading.type, space.overlay.show_overlays, system.viewport_aa = previous


def _depths(
    context: bpy.types.Context, screen: gpu.types.GPUOffScreen, view: Camera, near: float
) -> np.ndarray:
    """Return the viewport's depths (H, W) along a view's z axis; 0 for the background."""
    view_matrix = Matrix((np.diag([1.0, -1.0, -1.0, 1.0]) @ view.world_to_camera).tolist())
    projection = Matrix(
        (
            (2 * view.fx / view.width, 0, 1 - 2 * view.cx / view.width, 0),
            (0, 2 * view.fy / view.height, 2 * view.cy / view.height - 1, 0),
            (0, 0, -1, -2 * near),  # infinite far plane
            (0, 0, -1, 0),
        )
    )
    region = next(region for region in context.area.regions if region.type == "WINDOW")
    screen.draw_view3d(
        context.scene,
        context.view_layer,
        context.space_data,
        region,
        view_matrix,
        projection,
        do_color_management=False,
    )
    with screen.bind():  # type: ignore[attr-defined]
        buffer = gpu.state.active_framebuffer_get().read_depth(0, 0, screen.width, screen.height)
    window_depth = np.array(buffer, np.float64).reshape(screen.height, screen.width)[::-1]
    return np.divide(near, 1 - window_depth, out=np.zeros_like(window_depth), where=window_depth < 1)
