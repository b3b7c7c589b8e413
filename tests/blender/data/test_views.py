"""Views of a bundle: cameras where it is imported, without a photograph, and in its bundle again."""

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
    turns = np.linspace(0, 5, count)
    eyes = np.stack([3 * np.cos(turns), 0.2 * turns, 3 * np.sin(turns)], axis=1)
    return [
        Camera(
            f"v{n}.jpg",
            640 - 300 * (n % 2),
            480,
            500,
            505,
            322.5,
            235.25,
            look_at(eye, np.zeros(3), (0, -1, 0)),
        )
        for n, eye in enumerate(eyes)
    ]


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    bundle = Bundle("made", [Level(1, splats(30))], tables=make_view_tables(views(), 0.02, {"v2.jpg"}))
    # counted with a view that has no photograph; trained at a fortieth of the size
    bundle.meta |= {"held_out": [3, 9], "focal_px": 12.5}
    write_bundle(tmp_path / "in.ply", bundle)
    return lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")


def check(cameras, wanted):
    assert [camera.name for camera in cameras] == [camera.name for camera in wanted]
    places = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for camera, view in zip(cameras, wanted, strict=True):
        assert (camera.width, camera.height) == (view.width, view.height)
        assert np.allclose(camera.project(places)[0], view.project(places)[0], atol=2e-3)


def test_views_keep_their_cameras(bpy, lodgs, root):
    objects = root.lodgs.cameras.objects
    assert [obj.name for obj in objects] == [view.name for view in views()]
    assert not any(obj.data.lodgs.photograph for obj in objects) and bpy.context.scene.camera == objects[0]
    assert lodgs("data.scenes").contents(root).startswith("6 views, ")
    bpy.context.view_layer.update()
    depsgraph, seen = bpy.context.evaluated_depsgraph_get(), []
    for obj, view in zip(objects, views(), strict=True):  # as Blender itself projects
        lodgs("data.photographs").use_view(bpy.context, obj)
        bpy.context.view_layer.update()
        seen.append(lodgs("data.cameras").view_from(root, depsgraph, view.width, view.height, obj)[0])
    check(seen, views())
    assert [obj.name for obj in lodgs("data.photographs").held_out(root)] == ["v2.jpg"]


def test_look_through_path_and_turntable_work_without_photographs(bpy, lodgs, root):
    assert bpy.ops.lodgs.look_through(step=1) == {"FINISHED"}
    assert bpy.context.scene.camera == root.lodgs.cameras.objects[1]
    assert bpy.ops.lodgs.camera_path() == {"FINISHED"}
    assert bpy.ops.lodgs.turntable() == {"FINISHED"}
    assert not bpy.ops.lodgs.measure_views.poll()


@pytest.mark.parametrize("placed", [False, True])
def test_views_are_in_the_bundle_again_where_the_scene_stands(bpy, root, tmp_path, placed):
    root.location, root.scale = (1, 2, 3), (2, 2, 2)
    bpy.context.view_layer.update()
    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"), placed=placed) == {"FINISHED"}
    cameras, near, held_out = read_view_tables(read_bundle(tmp_path / "out.ply").tables)
    assert held_out == {"v2.jpg"} and near == pytest.approx(0.04 if placed else 0.02)
    if placed:
        there = Similarity.from_matrix(np.array(root.lodgs.axes.matrix_world, np.float64).round(6))
        cameras = [camera.in_object_space(there.matrix)[0] for camera in cameras]
    check(cameras, views())


def test_a_trained_scene_takes_its_photographs_views_along(bpy, lodgs):
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    made = {name: getattr(splats(9), name) for name in names}
    level = lodgs("training.splats.gaussians").Splats(**made)
    scenes.set_level(root, lodgs("training.splats.levels").Level(1, level))
    cameras, near, _ = read_view_tables(scenes.read_levels(root).tables)
    scene = read_scene(GARDEN)
    check(cameras, scene.cameras)
    assert near == pytest.approx(scene.near())


@pytest.mark.parametrize("source", ["SHOWN", "LEVEL"])
def test_files_for_other_programs_are_as_opaque_as_the_views_show_them(bpy, root, tmp_path, source):
    """Where the scene stands, too: it is twice as large, and so far away."""
    root.lodgs.antialias = True
    root.location, root.scale = (1, 2, 3), (2, 2, 2)
    bpy.context.view_layer.update()

    def exported(**how):
        path = str(tmp_path / "out.ply")
        bpy.ops.lodgs.export_plain(filepath=path, source=source, level=1, **how)
        found = read_bundle(path)
        return found.antialias, found.levels[0].splats.opacity_logits

    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "own.ply")) == {"FINISHED"}
    bundle = read_bundle(tmp_path / "own.ply")
    own, expected = bundle.levels[0].splats, bake_filter(bundle).levels[0].rows.select(slice(None))
    filtered, kept = exported(antialiased=True)
    assert bundle.antialias and filtered
    np.testing.assert_array_equal(kept, own.opacity_logits)
    for placed in (False, True):
        filtered, found = exported(placed=placed)
        assert not filtered
        np.testing.assert_allclose(found, expected.opacity_logits, atol=2e-3)
    assert (expected.opacity_logits < own.opacity_logits - 0.1).all()
