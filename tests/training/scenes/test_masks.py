"""Masks: which are found, and that they are bent as their photographs are."""

import numpy as np
import pytest

from training.methods.data import TrainingData
from training.scenes.colmap import read_scene
from training.scenes.images import load_image, write_png
from training.scenes.undistort import undistorted

from . import synthetic


def halves() -> np.ndarray:
    """Black on the left."""
    pixels = np.full((synthetic.HEIGHT, synthetic.WIDTH, 3), 255, np.uint8)
    pixels[:, : synthetic.WIDTH // 2] = 0
    return pixels


@pytest.mark.parametrize("name", ["a.png.png", "a.png"])
def test_both_ways_of_naming_them(tmp_path, name):
    synthetic.write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / name, halves())
    scene = read_scene(tmp_path)
    assert [camera.mask for camera in scene.cameras] == [tmp_path / "masks" / name, None, None]
    data = TrainingData(scene, image_scale=0.5, test_every=0)
    masks = [data.target(view).mask for view in range(3)]
    assert masks[1] is None and masks[2] is None and masks[0] is not None
    expected = np.repeat([[0.0] * 24 + [1.0] * 24], 36, axis=0)
    np.testing.assert_array_equal(masks[0], expected)


def test_they_are_straightened_like_their_photographs(tmp_path):
    """A photograph that is its own mask still is."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), pixels=halves())
    (tmp_path / "masks").mkdir()
    for name in ("a.png", "b.png"):
        write_png(tmp_path / "masks" / name, halves()[::2, ::2])  # of another size
    scene = undistorted(read_scene(tmp_path), tmp_path / "cache")
    assert [camera.mask is None for camera in scene.cameras] == [False, False, True]
    for camera in scene.cameras[:2]:
        assert camera.image is not None and camera.mask is not None
        size = camera.width, camera.height
        photograph, mask = load_image(camera.image, *size), load_image(camera.mask, *size)
        assert np.abs(photograph - mask).mean() < 0.01 and 0.3 < mask.mean() < 0.7
