"""Scenes as users have them: other suffixes, workspaces, points as PLY, missing files."""

import shutil

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.images import load_mask


@pytest.fixture
def scene(tiny_scene, tmp_path):
    return shutil.copytree(tiny_scene, tmp_path / "scene")


def model_of(scene):
    return read_scene(scene).model


def test_photos_with_another_suffix_or_case_match(scene):
    before = read_scene(scene)
    for camera in before.cameras:
        photo = before.images_folder / camera.name
        photo.rename(photo.with_name(photo.stem.upper() + ".PNG"))
    after = read_scene(scene)
    assert [camera.name for camera in after.cameras] == [camera.name for camera in before.cameras]
    assert any("another folder, suffix or case" in warning for warning in after.warnings)


def test_model_with_photos_is_used_in_a_workspace(scene):
    model, images = model_of(scene), read_scene(scene).images_folder
    dense = scene / "dense" / "0"
    shutil.copytree(model, dense / "sparse")
    shutil.move(images, dense / "images")
    read = read_scene(scene)
    assert read.model == dense / "sparse" and read.images_folder == dense / "images"
    assert any("are missing" in warning for warning in read.warnings)


@pytest.mark.parametrize("name", ["points3D.ply", "cloud.ply", "../../init.ply", "../../sparse_pc.ply"])
def test_points_are_read_from_a_point_cloud(scene, name):
    model = model_of(scene)
    for file in model.glob("points3D.*"):
        file.unlink()
    kinds = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.zeros(3, kinds)
    rows["x"], rows["red"] = [0, 0.5, 1], 200
    path = (model / name).resolve()
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)
    read = read_scene(scene)
    assert read.points.dtype == np.float32 and read.points[:, 0].tolist() == [0, 0.5, 1]
    assert (read.point_colors[:, 0] == 200).all() and len(read.point_ids) == 0
    assert any(f"were read from {path}" in warning for warning in read.warnings)


def test_init_ply_replaces_the_points(scene):
    """As in Brush: laser scans replace the points of COLMAP."""
    rows = np.zeros(2, [(axis, "f8") for axis in "xyz"])
    rows["x"] = [0, 0.5]
    PlyData([PlyElement.describe(rows, "vertex")]).write(scene / "init.ply")
    read = read_scene(scene)
    assert read.points[:, 0].tolist() == [0, 0.5] and len(read.point_ids) == 0
    assert any("init.ply instead of" in warning for warning in read.warnings)


def test_missing_file_of_a_model_is_named(scene):
    model = model_of(scene)
    (images,) = model.glob("images.*")
    images.unlink()
    with pytest.raises(LodgsError, match=rf"{images.name} is missing"):
        read_scene(scene)


def test_masks_may_have_the_photos_own_suffix(scene):
    read = read_scene(scene)
    camera = read.cameras[0]
    mask = np.zeros((camera.height, camera.width), np.uint8)
    mask[:, : camera.width // 2] = 255
    path = (scene / "masks" / camera.name).with_suffix(".jpg")
    path.parent.mkdir(parents=True)
    Image.fromarray(mask).save(path)
    assert read_scene(scene).cameras[0].mask == path
    assert set(np.unique(load_mask(path, camera.width, camera.height))) == {0, 1}
