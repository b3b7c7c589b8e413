"""Previews of training views in the viewport."""

import numpy as np
import pytest


@pytest.fixture
def root(bpy, lodgs):
    rng, bundle = np.random.default_rng(1), lodgs("training.splats.bundle")
    count = 4000
    splats = lodgs("training.splats.gaussians").Splats(
        means=rng.normal((3, -2, 1), 0.7, (count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), -3, np.float32),
        opacity_logits=np.float32(rng.choice([-3.0, 3.0], count)),
        sh=np.zeros((count, 1, 3), np.float32),
    )
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        lodgs("data.scenes").set_level(root, bundle.Level(1, splats))
    bpy.context.view_layer.update()
    return root, splats


def test_preview_matches_the_training_dome(lodgs, root):
    root, splats = root
    viewpoints, settings = lodgs("data.viewpoints"), root.lodgs.training
    settings.views = 10
    views, shells = viewpoints.preview_dome(root)
    module = lodgs("training.scenes.viewpoints")
    placed, _ = module.surrounding_views(module.opaque_means(splats), 10)
    assert len(views) == 10
    means = splats.means[splats.opacity_logits > 0]
    center, _ = lodgs("training.scenes.overview").central_ball(means)
    for number, (view, truth) in enumerate(zip(views, placed, strict=True)):
        np.testing.assert_allclose(view.world_to_camera, truth.world_to_camera, atol=1e-6)
        assert number >= 5 or np.isclose(np.linalg.norm(view.center - center), shells, rtol=1e-5).any()
    settings.views = 12
    assert len(viewpoints.preview_dome(root)[0]) == 12


def test_large_scenes_are_sampled(lodgs, root, monkeypatch):
    root, _ = root
    viewpoints = lodgs("data.viewpoints")
    _, shells = viewpoints.preview_dome(root)
    monkeypatch.setattr(viewpoints, "SAMPLE", 1000)
    viewpoints._cache.clear()
    assert np.allclose(viewpoints.preview_dome(root)[1], shells, rtol=0.1)


def test_pyramids_match_the_views(lodgs, root):
    root, _ = root
    views, _ = lodgs("data.viewpoints").preview_dome(root)
    ends = lodgs("viewport.frusta").lines(views, 0.5).reshape(len(views), 8, 2, 3)
    for view, edges in zip(views, ends, strict=True):
        np.testing.assert_allclose(edges[:4, 0], np.tile(view.center, (4, 1)), rtol=1e-6)
        local = edges[:4, 1] @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy)
        corners = [(0, 0), (view.width, 0), (view.width, view.height), (0, view.height)]
        np.testing.assert_allclose(pixels, corners, atol=0.01)
        np.testing.assert_allclose(local[:, 2], 0.5, rtol=1e-4)
        np.testing.assert_allclose(edges[4:, 0], edges[:4, 1])
        np.testing.assert_allclose(edges[4:, 1], np.roll(edges[:4, 1], -1, axis=0))


def test_frusta_of_previewed_views_are_drawn(bpy, lodgs, root, frame):
    import gpu
    from mathutils import Matrix

    root, _ = root
    root.lodgs.training.show_views = True

    def draw():
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_identity()
            gpu.matrix.load_projection_matrix(Matrix.Diagonal((0.1, 0.1, 0.01, 1)))
            lodgs("viewport.frusta").draw(bpy.context)

    assert (frame(64, draw)[..., 0] > 0).sum() > 50
    for source in ("CAMERAS", "ANIMATION"):  # Blender draws these cameras
        root.lodgs.training.views_from = source
        assert not frame(64, draw).any()
    root.lodgs.training.views_from = "GRID"
    assert (frame(64, draw)[..., 0] > 0).sum() > 50
    root.lodgs.training.show_views = False
    assert not frame(64, draw).any()


def test_capture_views_are_hidden_while_a_splat_scene_is_active(bpy, lodgs, monkeypatch):
    frusta, drawn = lodgs("viewport.frusta"), []
    monkeypatch.setattr(frusta, "_draw", lambda views, matrix: drawn.append(len(views)))
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.scene.lodgs_capture.show_views, bpy.context.scene.lodgs_capture.views = True, 9
    frusta.draw(bpy.context)
    assert drawn == [9]
    with lodgs("data.importing").new_scene(bpy.context, "scene"):
        pass
    frusta.draw(bpy.context)
    assert drawn == [9]


@pytest.mark.parametrize("views_from", ["GRID", "CURVE"])
def test_preview_matches_the_training_views(bpy, lodgs, root, views_from):
    root, splats = root
    viewpoints, settings = lodgs("data.viewpoints"), root.lodgs.training
    bpy.ops.curve.primitive_bezier_circle_add(radius=5, location=(0, 0, 1.7))
    settings.views_from, settings.views, settings.curve = views_from, 9, bpy.context.object
    root.scale, root.location, root.rotation_euler = (2, 2, 2), (1, 2, 3), (0.3, 0.2, 0.1)
    bpy.context.view_layer.update()
    for _ in range(2):
        previews, views = viewpoints.preview_views(root), viewpoints.training_views(bpy.context, root, splats)
        assert len(previews) == len(views) == 9
        for view, (truth, near) in zip(previews, views, strict=True):
            np.testing.assert_allclose(view.world_to_camera, truth.world_to_camera, atol=1e-3)
            assert near > 0
        settings.curve.data.splines[0].bezier_points[0].co.x -= 3  # the preview follows
        settings.curve.data.update_tag()
        settings.height = 7
        bpy.context.view_layer.update()
