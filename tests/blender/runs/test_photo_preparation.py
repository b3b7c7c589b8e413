"""Photographs in Blender: their cameras are found by the trainer, and the scene is imported."""

import time

import numpy as np
import pytest

from tests.training.scenes.walls import EYES, photograph
from training.scenes.cameras import look_at
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.scenes.model import intrinsics, write_model
from training.scenes.undistort import already_undistorted


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk") / "photos"
    folder.mkdir()
    for number, eye in enumerate(EYES):
        write_png(folder / f"{number}.png", photograph(eye))
    return folder


def test_photographs_become_a_scene(bpy, lodgs, photos):
    assert bpy.ops.lodgs.find_cameras(directory=str(photos)) == {"FINISHED"}
    work = lodgs("runs.photo_preparation").current
    assert "All 6 photographs found their place" in work.message and work.fraction == 1
    (root,) = lodgs("data.scenes").roots(bpy.context.scene)
    assert root == work.root and len(root.lodgs.cameras.objects) == 6
    assert root.lodgs.scene_folder == str(photos.parent / "photos_scene")
    bpy.context.view_layer.update()
    eyes = np.array([
        obj.matrix_world.translation for obj in sorted(root.lodgs.cameras.objects, key=lambda o: o.name)
    ])  # fmt: skip
    apart, truly = (np.linalg.norm(each[:, None] - each[None], axis=2) for each in (eyes, EYES))
    np.testing.assert_allclose(apart / apart.sum() * truly.sum(), truly, atol=0.05)


def test_what_is_stopped_goes_on(bpy, lodgs, photos, tmp_path):
    photo_preparation = lodgs("runs.photo_preparation")
    work = photo_preparation.find_cameras(photos, tmp_path / "out")
    with pytest.raises(RuntimeError, match="being prepared"):
        bpy.ops.lodgs.find_cameras(directory=str(photos))
    end = time.monotonic() + 60
    while work.step() and "of" not in work.message.split("photograph")[-1]:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert bpy.ops.lodgs.cancel_find_cameras() == {"FINISHED"}
    while work.step():
        time.sleep(0.02)
    assert "goes on from there" in work.message and not work.problem
    assert not lodgs("data.scenes").roots(bpy.context.scene)
    assert bpy.ops.lodgs.find_cameras(directory=str(photos), out=str(tmp_path / "out")) == {"FINISHED"}


def test_what_is_no_scene_is_a_sentence(bpy, lodgs, tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(RuntimeError, match="holds 0 photographs that can be read"):
        bpy.ops.lodgs.find_cameras(directory=str(tmp_path / "photos"))
    work = lodgs("runs.photo_preparation").current
    assert work.problem and not work.running and not lodgs("data.scenes").roots(bpy.context.scene)


@pytest.fixture
def bent(tmp_path):
    """A scene whose lens distorts."""
    names, random = ("a.png", "b.png", "c.png"), np.random.default_rng(0)
    lens = intrinsics("OPENCV", 320, 240, np.array([260.0, 262.0, 158.0, 121.0, 0.1, -0.02, 0.005, -0.004]))
    poses = [look_at(eye, np.array([0.0, 0.6, 0.4]), (0, 0, 1)) for eye in EYES]
    (tmp_path / "bent" / "images").mkdir(parents=True)
    for name, eye in zip(names, EYES, strict=False):
        write_png(tmp_path / "bent" / "images" / name, photograph(eye))
    write_model(
        tmp_path / "bent" / "sparse" / "0", [lens] * 3, list(zip(names, poses, strict=False)),
        random.normal(size=(50, 3)), np.full((50, 3), 99, np.uint8),
    )  # fmt: skip
    return tmp_path / "bent"


def test_a_distorted_scene_shows_straightened_photographs(bpy, lodgs, bent):
    for _ in range(2):  # the second time they are there already
        assert bpy.ops.lodgs.import_colmap(directory=str(bent), upright=False) == {"FINISHED"}
        root = lodgs("data.scenes").active_root(bpy.context)
        scene = read_scene(bent)
        straight = already_undistorted(scene)
        assert scene.distorted and straight is not None and not straight.distorted
        views = lodgs("data.photographs").views(root)
        assert len(views) == len(straight.cameras) == 3
        for view, camera in zip(views, straight.cameras, strict=True):
            facts = view.data.lodgs
            assert not facts.distorted and facts.photograph == str(camera.image)
            assert (facts.width, facts.height) == (camera.width, camera.height)
            assert facts.fx == pytest.approx(camera.fx) and facts.fy == pytest.approx(camera.fy)
            (picture,) = view.data.background_images
            assert picture.image.filepath == str(camera.image)
            assert tuple(picture.image.size) == (camera.width, camera.height)
        assert root.lodgs.scene_folder == str(bent)
        assert len(lodgs("render.compare").measurable(root)) == 3
        first = straight.cameras[0]
        assert bpy.context.scene.render.resolution_x == first.width
        bpy.ops.lodgs.remove_scene()
    assert not [image for image in bpy.data.images if not image.users]


def test_without_a_trainer_it_says_so(bpy, lodgs, bent, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    told = []
    root = lodgs("data.scenes").import_colmap(bpy.context, bent)
    lodgs("runs.photo_preparation").straighten(root, told.append)
    assert len(told) == 1 and "3 views have lens distortion" in told[0] and "none is set up" in told[0]
    assert all(view.data.lodgs.distorted for view in lodgs("data.photographs").views(root))
