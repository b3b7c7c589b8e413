"""Views where viewports rested: recorded after a pause, as cameras for training images."""

from types import SimpleNamespace

import numpy as np
import pytest


@pytest.fixture
def visited(lodgs, monkeypatch):
    module = lodgs("data.visited")
    module.clear()
    monkeypatch.setattr(module, "REST", 0.0)
    yield module
    module.clear()


@pytest.fixture
def visit(bpy, visited):
    """Return a function that draws a perspective view and lets it rest."""
    from mathutils import Euler, Matrix

    region = SimpleNamespace(as_pointer=lambda: 7)
    # 90 degrees wide, twice as wide as high; near depth 0.5, far 100
    a, b = -(100 + 0.5) / (100 - 0.5), -2 * 100 * 0.5 / (100 - 0.5)
    projection = Matrix(((1, 0, 0, 0), (0, 2, 0, 0), (0, 0, a, b), (0, 0, -1, 0)))

    def visit(location, turn=0.0, rests=True, kind="PERSP"):
        pose = Matrix.LocRotScale(location, Euler((np.pi / 2, 0, turn)), None)  # upright, looks along +y
        view = SimpleNamespace(
            view_perspective=kind, view_matrix=pose.inverted(), window_matrix=projection, view_distance=10.0
        )
        visited.track(region, bpy.context.scene, view)
        if rests:
            visited._record_at_rest()

    visit((0, 0, 0), rests=False)  # a viewport that opens has not moved
    return visit


def test_cameras_see_what_the_viewport_showed(bpy, visited, visit):
    visit((1, 2, 3))
    ((camera, near),) = visited.visited_views(bpy.context.scene, 640, 480)
    assert near == pytest.approx(0.5, rel=1e-4)
    assert (camera.width, camera.height) == (640, 480) and not camera.flaw
    pixels, depths = camera.project(np.array([(1, 7, 3), (6, 7, 3), (1, 7, 4)]))
    assert depths == pytest.approx(5)
    # 5 units to the right are at the edge; a unit up is 320 / 5 pixels up
    assert pixels == pytest.approx(np.array([(320, 240), (640, 240), (320, 176)]), abs=1e-3)


def test_only_new_perspective_views_at_rest_count(bpy, visited, visit):
    scene = bpy.context.scene
    visit((0, 0, 1), rests=False)
    visit((0, 0, 2))
    assert visited.count(scene) == 1
    visit((0, 0, 2.5))  # a tenth of the distance to the orbit point is 1
    visit((0, 0, 2.5), turn=np.radians(10))
    assert visited.count(scene) == 1
    visit((0, 0, 2.5), turn=np.radians(20))
    visit((0, 0, 4))
    assert visited.count(scene) == 3
    visit((9, 9, 9), kind="ORTHO")
    visit((9, 9, 9), kind="CAMERA")
    visit((0, 0, 4), rests=False)
    assert visited.count(scene) == 3
    other = bpy.data.scenes.new("other")
    assert visited.count(other) == 0


def test_the_oldest_views_are_dropped(bpy, visited, visit, monkeypatch):
    monkeypatch.setattr(visited, "MAX_VIEWS", 3)
    for height in range(2, 12, 2):
        visit((0, 0, height))
    views = [camera for camera, _ in visited.visited_views(bpy.context.scene, 30, 20)]
    assert [camera.center[2] for camera in views] == pytest.approx([6, 8, 10], abs=1e-5)


def test_no_timer_remains_without_the_extension(bpy, visited, visit):
    visit((0, 0, 2), rests=False)
    assert bpy.app.timers.is_registered(visited._record_at_rest)
    visited.clear()  # as unregistering does
    assert not bpy.app.timers.is_registered(visited._record_at_rest)


def test_training_views_are_in_the_coordinates_of_the_splats(bpy, lodgs, visit):
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        pass
    root.scale, root.location = (2, 2, 2), (1, 0, 0)
    bpy.context.view_layer.update()
    settings, viewpoints = root.lodgs.training, lodgs("data.viewpoints")
    settings.views_from, settings.views = "VISITED", 9
    visit((1, 0, 4))
    with pytest.raises(lodgs("training.errors").LodgsError, match="1 view"):
        viewpoints.training_views(bpy.context, root, None)
    visit((5, 0, 4))
    views = viewpoints.training_views(bpy.context, root, None)
    centers = np.array([camera.center for camera, _ in views])
    assert centers == pytest.approx(np.array([(0, 0, 2), (2, 0, 2)]), abs=1e-5)
    assert [near for _, near in views] == pytest.approx([0.25, 0.25], rel=1e-4)
    assert [view.center.tolist() for view in viewpoints.preview_views(root)] == centers.tolist()
    assert viewpoints.view_count(settings) == 2


def test_captures_use_visited_views(bpy, lodgs, visit):
    settings, viewpoints = bpy.context.scene.lodgs_capture, lodgs("data.viewpoints")
    settings.views_from, settings.views = "VISITED", 2
    for height in (2, 4, 6):
        visit((0, 0, height))
    shots = viewpoints.capture_views(bpy.context, 30, 20)
    assert [camera.center[2] for camera, _ in shots] == pytest.approx([2, 6], abs=1e-5)
    assert viewpoints.capture_view_count(bpy.context.scene) == 2
