"""Training of levels for splats without photos: rendered views, job and result."""

import os

import numpy as np
import pytest

from tests.blender.fake_trainer import COUNTS
from training.runs.job import Job
from training.scenes.cameras import read_camera
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

pytestmark = pytest.mark.one_blender


TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")


def ball(count: int = 400) -> Splats:
    """Opaque splats on a sphere with radius 2 and centre (5, -1, 3)."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(count, 3))
    means = 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [5, -1, 3]
    return Splats(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), np.log(0.15), np.float32), np.full(count, 4.0, np.float32),
        rng.normal(0, 1, (count, 1, 3)).astype(np.float32),
    )  # fmt: skip


@pytest.fixture
def root(bpy, tmp_path):
    """Import the ball and transform its root."""
    write_bundle(tmp_path / "ball.ply", Bundle("", [Level(1, ball())]))
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "ball.ply"))
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    root.location, root.scale, root.rotation_euler = (1, 2, 3), (2, 2, 2), (-1.2, 0.1, 0.3)
    bpy.context.view_layer.update()
    return root


def new_camera(bpy, location, lens=35.0):
    data = bpy.data.cameras.new("Camera")
    data.lens, data.clip_start = lens, 0.5
    camera = bpy.data.objects.new("Camera", data)
    camera.location, camera.rotation_euler = location, (1.1, 0.2, 0.5)
    bpy.context.scene.collection.objects.link(camera)
    return camera


def train(bpy, tmp_path):
    """Train with the fake trainer. Return the job and its views."""
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    files = sorted((tmp_path / "run" / "cameras").glob("*.json"))
    return Job.from_file(tmp_path / "run" / "job.toml"), [read_camera(file) for file in files]


def assert_matches_blender(bpy, root, camera, view, near):
    """Assert that splats project to the pixels and depths that Blender computes for its camera."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    points = ball(20).means.astype(float)
    pixels, depths = view.project(points)
    for point, pixel, depth in zip(points, pixels, depths, strict=True):
        position = root.lodgs.axes.matrix_world @ Vector(point)
        x, y, distance = world_to_camera_view(bpy.context.scene, camera, position)
        assert pixel == pytest.approx((x * view.width, (1 - y) * view.height), abs=0.02)
        assert depth * 2 == pytest.approx(distance, rel=1e-4)  # the root is twice as large
    assert near == pytest.approx(camera.data.clip_start / 2)


def test_current_splats_are_exported_to_the_run(bpy, lodgs, fake, root, tmp_path):
    fake()
    objects = lodgs("data.objects")
    (item,) = root.lodgs.levels
    thinned = objects.new_splats("fewer", ball().select(slice(0, 150)))
    item.object.data = thinned.data  # some splats were deleted
    finest = item.object
    root.lodgs.training.view_width = 300
    job, views = train(bpy, tmp_path)
    assert (job.method, job.scene, job.capture, job.views, job.view_width) == ("lodge", "", "dome", 64, 300)
    assert job.test_every == 8 and not views, "the trainer places the views"
    assert job.base == str(tmp_path / "run" / "base.ply")
    (exported,) = read_bundle(job.base).levels
    for name, column in vars(ball().select(slice(0, 150))).items():
        if name != "extras":
            np.testing.assert_array_equal(getattr(exported.splats, name), column)
    levels = {item.number: item.object for item in root.lodgs.levels}
    assert {number: len(obj.data.points) for number, obj in levels.items()} == COUNTS
    assert levels[1] == finest, "the object stays with its modifiers and children"


def test_views_match_all_cameras(bpy, fake, root, tmp_path):
    fake()
    root.lodgs.training.views_from = "CAMERAS"
    with pytest.raises(RuntimeError, match="has 0 camera"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    cameras = [new_camera(bpy, (0, -9, 4)), new_camera(bpy, (9, -12, 4), 50.0)]
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 800, 300
    root.lodgs.training.view_width = 400
    bpy.context.view_layer.update()
    job, views = train(bpy, tmp_path)
    assert job.capture == str(tmp_path / "run" / "cameras") and job.test_every == 0
    for camera, (view, near) in zip(cameras, views, strict=True):
        assert (view.width, view.height) == (400, 150)
        assert_matches_blender(bpy, root, camera, view, near)


def test_imported_splats_use_cameras_but_not_those_of_other_scenes(bpy, root, tmp_path):
    assert root.lodgs.training.views_from == "DOME"
    photos = [new_camera(bpy, (5, -10 * number, 4)) for number in (1, 2)]
    for parent, expected in ((root, "DOME"), (None, "CAMERAS")):
        for photo in photos:
            photo.parent = parent
        bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "ball.ply"))
        assert bpy.context.active_object.lodgs.training.views_from == expected


def test_imported_splats_use_an_animated_camera_or_a_selected_curve(bpy, root, tmp_path):
    camera = bpy.context.scene.camera = new_camera(bpy, (0, -9, 4))
    for frame in (1, 41):
        camera.location.x = frame
        camera.keyframe_insert("location", frame=frame)
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "ball.ply"))
    assert bpy.context.active_object.lodgs.training.views_from == "ANIMATION"
    bpy.ops.curve.primitive_bezier_circle_add(radius=6)
    curve = bpy.context.object
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "ball.ply"))
    training = bpy.context.active_object.lodgs.training
    assert (training.views_from, training.curve) == ("CURVE", curve)


def test_views_match_an_animated_camera(bpy, fake, root, tmp_path):
    fake()
    camera = bpy.context.scene.camera = new_camera(bpy, (0, -9, 4))
    scene, training = bpy.context.scene, root.lodgs.training
    training.views_from, training.views, scene.frame_end = "ANIMATION", 5, 41
    with pytest.raises(RuntimeError, match="'Camera' does not move"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    camera.keyframe_insert("location", frame=1)
    camera.location.x = 20
    camera.keyframe_insert("location", frame=41)
    scene.frame_set(7)
    _, views = train(bpy, tmp_path)
    assert scene.frame_current == 7
    for frame, (view, near) in zip((1, 11, 21, 31, 41), views, strict=True):
        scene.frame_set(frame)
        assert_matches_blender(bpy, root, camera, view, near)


def test_views_are_evenly_spaced_on_a_curve(bpy, fake, root, tmp_path):
    fake()
    training = root.lodgs.training
    training.views_from, training.views = "CURVE", 30
    with pytest.raises(RuntimeError, match="no curve is chosen"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    bpy.ops.curve.primitive_bezier_circle_add(radius=6, location=(1, 2, 1.7))
    training.curve = circle = bpy.context.object
    circle.data.bevel_depth = 0.3
    bpy.context.view_layer.objects.active = root
    curves = len(bpy.data.curves), len(bpy.data.objects)
    _, views = train(bpy, tmp_path)
    assert (len(bpy.data.curves), len(bpy.data.objects)) == (curves[0], curves[1] + 1), (
        "only one level was added"
    )
    matrix = np.array(root.lodgs.axes.matrix_world)
    centers = np.array([view.center for view, _ in views]) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2] - [1, 2], axis=1), 6, atol=0.1)
    np.testing.assert_allclose(centers[:, 2], 1.7, atol=1e-5)
    gaps = np.linalg.norm(centers - np.roll(centers, 1, axis=0), axis=1)
    np.testing.assert_allclose(gaps, gaps.mean(), rtol=0.02)  # evenly spaced on the circle
    for view, _ in views:
        down = matrix[:3, :3] @ view.world_to_camera[1, :3]
        np.testing.assert_allclose(down / np.linalg.norm(down), [0, 0, -1], atol=1e-5)
    with bpy.context.temp_override(selected_objects=[circle]):
        bpy.ops.object.delete()
    with pytest.raises(RuntimeError, match="no curve is chosen"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run2"))
    bpy.data.objects.remove(circle)
    assert training.curve is None


def test_method_that_needs_photos_is_rejected(bpy, fake, root, tmp_path):
    fake()
    root.lodgs.training.method = "flod"
    with pytest.raises(RuntimeError, match="with FLoD: it has no photos"):
        bpy.ops.lodgs.train(folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_training_with_photos_starts_from_the_current_splats(bpy, lodgs, fake, root, tmp_path):
    fake()
    root.lodgs.scene_folder, root.lodgs.training.start_from = str(tmp_path / "scene"), "SCENE"
    job, _ = train(bpy, tmp_path)
    assert (job.scene, job.capture) == (str(tmp_path / "scene"), "")
    np.testing.assert_array_equal(read_bundle(job.base).levels[-1].splats.means, ball().means)


def test_real_trainer_adds_levels_to_splats_without_photos(bpy, lodgs, root, tmp_path):
    if not TRAINER:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    jobs, training = lodgs("runs.jobs"), root.lodgs.training
    training.views, training.view_width, training.image_scale = 8, 96, 1.0
    (item,) = root.lodgs.levels
    imported = item.object
    watch = jobs.start(root, str(tmp_path / "run"), {"levels": 3, "tune_steps": 3})
    messages = []
    jobs.follow(watch, lambda watch: messages.append(watch.message))
    assert (watch.state, watch.problem) == ("done", "")
    assert any("Rendering view" in message for message in messages)
    levels = {item.number: item.object for item in root.lodgs.levels}
    assert list(levels) == [1, 2, 3] and levels[3] == imported and imported.name.endswith("level 3")
    finest = lodgs("data.scenes").read_level(root, 3)
    finest, base = (splats.select(np.lexsort(splats.means.T)) for splats in (finest, ball()))
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(finest, name), getattr(base, name))
    assert root.lodgs.rule == "chunks" and len(watch.levels) == 3
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "bundle.ply"))
    assert [level.number for level in read_bundle(tmp_path / "bundle.ply").levels] == [1, 2, 3]
