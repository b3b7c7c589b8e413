"""Reduction of levels to the corners of their bounds, as in windows whose viewports LODGS draws."""

import numpy as np
import pytest

from training.splats.levels import Bundle, Level

COUNT = 400


@pytest.fixture
def root(bpy, lodgs, monkeypatch):
    """Return a scene with two levels by distance, in a Blender with windows."""
    if bpy.app.version < (5, 0):
        pytest.skip("Blender 4.5 draws hidden points")
    monkeypatch.setattr(lodgs("data.properties"), "draws_viewports", True)
    rng = np.random.default_rng(2)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        for number, s_min in ((1, 0.003), (2, 0.0)):
            splats = lodgs("training.splats.gaussians").Splats(
                means=rng.normal(size=(COUNT, 3)).astype(np.float32),
                quats=rng.normal(size=(COUNT, 4)).astype(np.float32),
                log_scales=rng.normal(-1.5, 0.5, (COUNT, 3)).astype(np.float32),
                opacity_logits=rng.normal(2, 1, COUNT).astype(np.float32),
                sh=rng.normal(size=(COUNT, 4, 3)).astype(np.float32),
            )
            lodgs("data.scenes").set_level(root, Level(number, splats, {"s_min": s_min}))
        lodgs("data.scenes").set_bundle_facts(root, Bundle("flod", [], "bands"))
    root.lodgs.single_level = 2
    bpy.context.view_layer.update()
    return root


@pytest.fixture
def points(bpy):
    """``points(obj)``: number of evaluated points in the viewport, after handlers have run."""

    def count(obj):
        bpy.context.view_layer.update()
        bpy.context.view_layer.update()
        return len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.points)

    return count


def test_blender_draws_only_the_corners_of_the_bounds(bpy, lodgs, root, points):
    """Bounds, counts, exports and renders stay those of all points."""
    level, settings = root.lodgs.levels[1].object, bpy.context.scene.lodgs_viewport
    assert points(level) == 8
    corners = level.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    bounds = lodgs("attributes").read_attribute(corners, "position")
    means = lodgs("attributes").read_attribute(level.data, "position")
    np.testing.assert_allclose(bounds.min(axis=0), means.min(axis=0), atol=1e-5)
    np.testing.assert_allclose(bounds.max(axis=0), means.max(axis=0), atol=1e-5)
    scenes = lodgs("data.scenes")
    assert scenes.count_visible(bpy.context, root) == (COUNT, 2 * COUNT)
    exported = scenes.visible_splats(bpy.context, root)
    assert np.array_equal(exported.means, means) and exported.sh.shape == (COUNT, 4, 3)
    assert points(level) == 8, "reduced again after the export"
    depsgraph = bpy.context.evaluated_depsgraph_get()
    placed = lodgs("render.engine").placed_splats(depsgraph)
    assert [len(item.read()[0]) for item in placed] == [COUNT]
    settings.splats = False
    assert points(level) == COUNT, "Blender draws the points"
    settings.splats, settings.all_points = True, True
    assert points(level) == COUNT, "wireframes are points"


def test_counts_by_distance_are_those_of_all_points(bpy, lodgs, root, points, monkeypatch):
    scenes, properties = lodgs("data.scenes"), lodgs("data.properties")
    root.lodgs.mode, root.lodgs.bands.gamma = "SELECTIVE", 0.45
    assert all(points(item.object) <= 8 for item in root.lodgs.levels)
    reduced = scenes.count_visible(bpy.context, root)
    monkeypatch.setattr(properties, "draws_viewports", False)
    root.update_tag()
    bpy.context.scene.lodgs_viewport.splats = False
    bpy.context.scene.lodgs_viewport.splats = True
    bpy.context.view_layer.update()
    assert reduced == scenes.count_visible(bpy.context, root)
    assert 0 < reduced[0] < 2 * COUNT


@pytest.mark.parametrize("is_copy", [False, True])
def test_modifiers_of_artists_get_all_points(bpy, lodgs, root, points, is_copy):
    obj = root.lodgs.levels[1].object
    if is_copy:
        obj = obj.copy()
        bpy.context.scene.collection.objects.link(obj)
    assert points(obj) == 8
    modifier = obj.modifiers.new("mine", "NODES")
    assert points(obj) == COUNT
    if not is_copy:
        obj.modifiers.remove(modifier)
        root.update_tag()
        obj.data.update_tag()
        assert points(obj) == 8


def test_reduced_scenes_are_picked_as_they_are_drawn(bpy, lodgs, root, points):
    from mathutils import Matrix

    def pick():
        bpy.context.view_layer.update()
        view, clip = Matrix.Identity(4), Matrix.Diagonal((0.1, 0.2, -0.01, 1))
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return lodgs("data.picking").scene_at(depsgraph, None, view, clip, (200, 100), (100, 50))

    root.scale = 3, 3, 3
    assert points(root.lodgs.levels[1].object) == 8 and pick() == root
    crop = lodgs("operators.clean_up").add_crop(bpy.context, root, "BOX")
    crop.location.x = 1000
    assert pick() is None


def test_wireframe_viewports_show_points(bpy, lodgs):
    """Blender has one evaluation for all viewports of a scene."""
    viewport, scene = lodgs("viewport"), bpy.context.scene
    space = next(
        area.spaces.active for area in bpy.context.window_manager.windows[0].screen.areas
        if area.type == "VIEW_3D"
    )  # fmt: skip
    for shading in ("WIREFRAME", "SOLID"):
        space.shading.type = shading
        viewport._follow_shading(scene)
        assert bpy.app.timers.is_registered(viewport._store_shading)
        viewport._store_shading()
        bpy.app.timers.unregister(viewport._store_shading)
        assert scene.lodgs_viewport.all_points == (shading == "WIREFRAME")
