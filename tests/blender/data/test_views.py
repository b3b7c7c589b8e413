"""Views of a bundle: imported as cameras without photos, and exported again."""

from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from training.editing.bake_filter import bake_filter
from training.scenes.cameras import Camera, look_at
from training.scenes.colmap import read_scene
from training.scenes.view_tables import make_view_tables, read_view_tables
from training.splats.bundle import read_bundle, write_bundle
from training.splats.levels import Bundle, Level
from training.splats.similarity import Similarity

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def views(count=6):
    angles = np.linspace(0, 5, count)
    centers = np.stack([3 * np.cos(angles), 0.2 * angles, 3 * np.sin(angles)], axis=1)
    poses = [look_at(center, np.zeros(3), (0, -1, 0)) for center in centers]
    return [
        Camera(f"v{n}.jpg", 640 - 300 * (n % 2), 480, 500, 505, 322.5, 235.25, pose)
        for n, pose in enumerate(poses)
    ]


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    bundle = Bundle("made", [Level(1, splats(30))], tables=make_view_tables(views(), 0.02, {"v2.jpg"}))
    # the trainer's indices count a view without photo, and its images were 1/40 of the size
    bundle.meta |= {"held_out": [3, 9], "focal_px": 12.5}
    write_bundle(tmp_path / "in.ply", bundle)
    return lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")


def check(cameras, expected):
    assert [camera.name for camera in cameras] == [camera.name for camera in expected]
    positions = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for camera, view in zip(cameras, expected, strict=True):
        assert (camera.width, camera.height) == (view.width, view.height)
        assert np.allclose(camera.project(positions)[0], view.project(positions)[0], atol=2e-3)


def test_views_keep_their_cameras(bpy, lodgs, root):
    objects = root.lodgs.cameras.objects
    assert [obj.name for obj in objects] == [view.name for view in views()]
    assert not any(obj.data.lodgs.photograph for obj in objects) and bpy.context.scene.camera == objects[0]
    assert lodgs("data.scenes").contents(root).startswith("6 views, ")
    bpy.context.view_layer.update()
    depsgraph, cameras = bpy.context.evaluated_depsgraph_get(), []
    for obj, view in zip(objects, views(), strict=True):  # compare with Blender's projection
        lodgs("data.photographs").use_view(bpy.context, obj)
        bpy.context.view_layer.update()
        cameras.append(lodgs("data.cameras").view_from(root, depsgraph, view.width, view.height, obj)[0])
    check(cameras, views())
    assert [obj.name for obj in lodgs("data.photographs").held_out(root)] == ["v2.jpg"]


def test_look_through_path_and_turntable_work_without_photographs(bpy, lodgs, root):
    assert bpy.ops.lodgs.look_through(step=1) == {"FINISHED"}
    assert bpy.context.scene.camera == root.lodgs.cameras.objects[1]
    assert bpy.ops.lodgs.camera_path() == {"FINISHED"}
    assert bpy.ops.lodgs.turntable() == {"FINISHED"}
    assert not bpy.ops.lodgs.measure_views.poll()


@pytest.mark.parametrize("placed", [False, True])
def test_exported_views_follow_the_placement(bpy, root, tmp_path, placed):
    root.location, root.scale = (1, 2, 3), (2, 2, 2)
    bpy.context.view_layer.update()
    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"), placed=placed) == {"FINISHED"}
    cameras, near, held_out = read_view_tables(read_bundle(tmp_path / "out.ply").tables)
    assert held_out == {"v2.jpg"} and near == pytest.approx(0.04 if placed else 0.02)
    if placed:
        placement = Similarity.from_matrix(np.array(root.lodgs.axes.matrix_world, np.float64).round(6))
        cameras = [camera.in_object_space(placement.matrix)[0] for camera in cameras]
    check(cameras, views())


def test_trained_scene_exports_the_views_of_its_photos(bpy, lodgs):
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    arrays = {name: getattr(splats(9), name) for name in names}
    level = lodgs("training.splats.gaussians").Splats(**arrays)
    scenes.set_level(root, lodgs("training.splats.levels").Level(1, level))
    cameras, near, _ = read_view_tables(scenes.read_levels(root).tables)
    scene = read_scene(GARDEN)
    check(cameras, scene.cameras)
    assert near == pytest.approx(scene.near())


@pytest.mark.parametrize("source", ["SHOWN", "LEVEL"])
def test_opacities_for_other_programs_contain_the_2d_filter(bpy, root, tmp_path, source):
    """The views of a scaled root are farther away by the same factor, so opacities stay the same."""
    root.lodgs.antialias = True
    root.location, root.scale = (1, 2, 3), (2, 2, 2)
    bpy.context.view_layer.update()

    def export_opacities(**options):
        path = str(tmp_path / "out.ply")
        bpy.ops.lodgs.export_plain(filepath=path, source=source, level=1, **options)
        opacities = read_bundle(path)
        return opacities.antialias, opacities.levels[0].splats.opacity_logits

    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "bundle.ply")) == {"FINISHED"}
    bundle = read_bundle(tmp_path / "bundle.ply")
    trained, expected = bundle.levels[0].splats, bake_filter(bundle).levels[0].rows.select(slice(None))
    filtered, opacities = export_opacities(antialiased=True)
    assert bundle.antialias and filtered
    np.testing.assert_array_equal(opacities, trained.opacity_logits)
    for placed in (False, True):
        filtered, opacities = export_opacities(placed=placed)
        assert not filtered
        np.testing.assert_allclose(opacities, expected.opacity_logits, atol=2e-3)
    assert (expected.opacity_logits < trained.opacity_logits - 0.1).all()


def test_copies_of_a_scene_have_their_own_views(bpy, lodgs, root):
    for obj in bpy.context.view_layer.objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.duplicate()
    copy = bpy.context.active_object
    own_views = [lodgs("data.photographs").views(scene) for scene in (root, copy)]
    assert [len(group) for group in own_views] == [6, 6] and not set(own_views[0]) & set(own_views[1])
