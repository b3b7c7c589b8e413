"""Preparation of photos: the trainer finds their cameras and Blender imports the scene."""

import os
import time

import numpy as np
import pytest

from tests.training.scenes.walls import CAMERA_POSITIONS, render_photo
from training.scenes.cameras import look_at
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.scenes.lenses import make_intrinsics
from training.scenes.undistort import cached_undistorted_scene
from training.scenes.write_colmap import write_model

pytestmark = pytest.mark.one_blender


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk") / "photos"
    folder.mkdir()
    for number, position in enumerate(CAMERA_POSITIONS):
        write_png(folder / f"{number}.png", render_photo(position))
    return folder


def test_photos_become_a_scene(bpy, lodgs, photos):
    assert bpy.ops.lodgs.find_cameras(directory=str(photos)) == {"FINISHED"}
    work = lodgs("runs.photo_preparation").current
    assert "All 6 " in work.message and work.fraction == 1
    (root,) = lodgs("data.roots").roots(bpy.context.scene)
    assert root == work.root and len(root.lodgs.cameras.objects) == 6
    assert root.lodgs.scene_folder == str(photos.parent / "photos_scene")
    bpy.context.view_layer.update()
    cameras = np.array([
        obj.matrix_world.translation for obj in sorted(root.lodgs.cameras.objects, key=lambda o: o.name)
    ])  # fmt: skip
    distances, expected = (
        np.linalg.norm(positions[:, None] - positions[None], axis=2)
        for positions in (cameras, CAMERA_POSITIONS)
    )
    np.testing.assert_allclose(distances / distances.sum() * expected.sum(), expected, atol=0.05)


def test_stopped_preparation_continues(bpy, lodgs, photos, hanging, tmp_path, monkeypatch):
    photo_preparation, trainer = lodgs("runs.photo_preparation"), os.environ["LODGS_TRAINER_PYTHON"]
    hanging(tmp_path / "trainer", " 1 of 6", trainer)
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", str(tmp_path / "trainer"))
    work = photo_preparation.find_cameras(photos, tmp_path / "out")
    with pytest.raises(RuntimeError, match="already being prepared"):
        bpy.ops.lodgs.find_cameras(directory=str(photos))
    end = time.monotonic() + 200
    while work.step() and not work.fraction:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert bpy.ops.lodgs.cancel_find_cameras() == {"FINISHED"}
    while work.step():
        time.sleep(0.02)
    assert "start it again" in work.message and not work.problem
    assert not lodgs("data.roots").roots(bpy.context.scene)
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", trainer)
    assert bpy.ops.lodgs.find_cameras(directory=str(photos), out=str(tmp_path / "out")) == {"FINISHED"}


def test_folder_without_photos_is_reported(bpy, lodgs, tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(RuntimeError, match="photo"):
        bpy.ops.lodgs.find_cameras(directory=str(tmp_path / "photos"))
    work = lodgs("runs.photo_preparation").current
    assert work.problem and not work.running and not lodgs("data.roots").roots(bpy.context.scene)


@pytest.fixture
def distorted(tmp_path):
    """A scene with lens distortion."""
    names, random = ("a.png", "b.png", "c.png"), np.random.default_rng(0)
    lens = make_intrinsics(
        "OPENCV", 320, 240, np.array([260.0, 262.0, 158.0, 121.0, 0.1, -0.02, 0.005, -0.004])
    )
    poses = [look_at(position, np.array([0.0, 0.6, 0.4]), (0, 0, 1)) for position in CAMERA_POSITIONS]
    (tmp_path / "distorted" / "images").mkdir(parents=True)
    for name, position in zip(names, CAMERA_POSITIONS, strict=False):
        write_png(tmp_path / "distorted" / "images" / name, render_photo(position))
    write_model(
        tmp_path / "distorted" / "sparse" / "0", [lens] * 3, list(zip(names, poses, strict=False)),
        random.normal(size=(50, 3)), np.full((50, 3), 99, np.uint8),
    )  # fmt: skip
    return tmp_path / "distorted"


def test_distorted_scene_shows_undistorted_photos(bpy, lodgs, distorted):
    for _ in range(2):  # the second time, undistorted photos exist
        assert bpy.ops.lodgs.import_colmap(directory=str(distorted), upright=False) == {"FINISHED"}
        root = lodgs("data.roots").active_root(bpy.context)
        scene = read_scene(distorted)
        undistorted = cached_undistorted_scene(scene)
        assert scene.distorted and undistorted is not None and not undistorted.distorted
        views = lodgs("data.photographs").views(root)
        assert len(views) == len(undistorted.cameras) == 3
        for view, camera in zip(views, undistorted.cameras, strict=True):
            facts = view.data.lodgs
            assert not facts.distorted and facts.photograph == str(camera.image)
            assert (facts.width, facts.height) == (camera.width, camera.height)
            assert facts.fx == pytest.approx(camera.fx) and facts.fy == pytest.approx(camera.fy)
            (background,) = view.data.background_images
            assert background.image.filepath == str(camera.image)
            assert tuple(background.image.size) == (camera.width, camera.height)
        assert root.lodgs.scene_folder == str(distorted)
        assert len(lodgs("render.compare").measurable_views(root)) == 3
        first = undistorted.cameras[0]
        assert bpy.context.scene.render.resolution_x == first.width
        bpy.ops.lodgs.remove_scene()
    assert not [image for image in bpy.data.images if not image.users]


def test_missing_trainer_gives_a_warning(bpy, lodgs, distorted, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    warnings = []
    root = lodgs("data.importing").import_colmap(bpy.context, distorted)
    lodgs("runs.photo_preparation").undistort_photos(root, warnings.append)
    (warning,) = warnings
    assert "3 views have lens distortion" in warning and "not installed" in warning
    assert all(view.data.lodgs.distorted for view in lodgs("data.photographs").views(root))
