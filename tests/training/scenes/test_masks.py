"""Masks: file names, undistortion, invalid files."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from training.__main__ import main
from training.errors import LodgsError
from training.optimize.training_data import TrainingData
from training.scenes.colmap import read_scene
from training.scenes.images import load_image, load_mask, write_png
from training.scenes.undistort import undistort_scene

from . import synthetic


def halves() -> np.ndarray:
    """Return a mask that is black on the left."""
    pixels = np.full((synthetic.HEIGHT, synthetic.WIDTH, 3), 255, np.uint8)
    pixels[:, : synthetic.WIDTH // 2] = 0
    return pixels


def write_damaged(path: Path, part: slice, replacement: bytes) -> None:
    """Write a mask with some bytes replaced."""
    write_png(path, halves())
    content = bytearray(path.read_bytes())
    content[part] = replacement
    path.write_bytes(content)


@pytest.mark.parametrize("name", ["a.png.png", "a.png"])
def test_mask_names(tmp_path, name):
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


@pytest.mark.parametrize("name", ["a.png.mask.png", "a_mask.png", "a.mask.png"])
def test_masks_beside_the_photos(tmp_path, name):
    """RealityScan reads and writes them there."""
    synthetic.write_scene(tmp_path)
    write_png(tmp_path / "images" / name, halves())
    scene = read_scene(tmp_path)
    assert [camera.mask for camera in scene.cameras] == [tmp_path / "images" / name, None, None]
    assert scene.warnings == []


@pytest.mark.parametrize(("folder", "suffix"), [("masks", "png"), ("depths", "exr")])
def test_mismatched_names_give_a_warning(tmp_path, folder, suffix):
    synthetic.write_scene(tmp_path)
    assert read_scene(tmp_path).warnings == []
    (tmp_path / folder / "left").mkdir(parents=True)
    assert read_scene(tmp_path).warnings == []
    write_png(tmp_path / folder / "left" / "mask_a.png", halves())
    (warning,) = read_scene(tmp_path).warnings
    assert str(tmp_path / folder) in warning and f"a.png.{suffix}" in warning


@pytest.mark.parametrize("folder", ["masks", "depths"])
def test_files_of_operating_systems_are_no_masks(tmp_path, folder):
    synthetic.write_scene(tmp_path)
    (tmp_path / folder).mkdir()
    for name in ".DS_Store", "._a.jpg.png", "Thumbs.db", "desktop.ini":
        (tmp_path / folder / name).write_bytes(b"x")
    assert read_scene(tmp_path).warnings == []


def test_masks_are_undistorted_like_their_photos(tmp_path):
    """A photo that equals its mask still does."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), pixels=halves())
    (tmp_path / "masks").mkdir()
    for name in ("a.png", "b.png"):
        write_png(tmp_path / "masks" / name, halves()[::2, ::2])  # another size
    scene = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert [camera.mask is None for camera in scene.cameras] == [False, False, True]
    for camera in scene.cameras[:2]:
        assert camera.image is not None and camera.mask is not None
        size = camera.width, camera.height
        photo, mask = load_image(camera.image, *size), load_image(camera.mask, *size)
        assert np.abs(photo - mask).mean() < 0.01 and 0.3 < mask.mean() < 0.7


INVALID = {
    "another shape": (
        lambda path: write_png(path, halves()[:, ::2]),
        "does not match the aspect ratio",
    ),
    "no image": (lambda path: path.write_text("people"), "not a JPEG, PNG, TIFF, WebP, BMP or EXR image"),
    "truncated": (lambda path: write_damaged(path, slice(-20, None), b""), "is truncated"),
    "empty": (lambda path: path.write_bytes(b""), "is empty"),
}


@pytest.mark.parametrize("kind", INVALID)
def test_invalid_mask_is_reported_before_training(tmp_path, capsys, kind):
    write, message = INVALID[kind]
    synthetic.write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    mask = tmp_path / "masks" / "a.png.png"
    write(mask)
    assert (
        main(["train", str(tmp_path), "--out", str(tmp_path / "run"), "--set", "steps=1", "--method", "3dgs"])
        == 2
    )
    out, err = capsys.readouterr()
    assert message in out and mask.name in out and "Traceback" not in out + err and "progress" not in out


@pytest.mark.parametrize("kind", ["of 0 and 1", "0 and 1, 16 bit", "green", "transparent", "grey with alpha"])
def test_masks_of_other_kinds_are_black_and_white(tmp_path, kind):
    """Segmentation programs write class numbers, overlay colours or transparency."""
    white = halves()[..., 0] > 0
    pixels = {
        "of 0 and 1": white.astype(np.uint8),
        "0 and 1, 16 bit": white.astype(np.uint16),
        "green": white[..., None] * np.uint8([0, 255, 0]),
        "transparent": np.dstack([np.full(halves().shape, 255, np.uint8), 255 * white.astype(np.uint8)]),
        "grey with alpha": np.dstack([255 * white.astype(np.uint8), np.full(white.shape, 255, np.uint8)]),
    }[kind]
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    mask = load_mask(tmp_path / "mask.png", synthetic.WIDTH, synthetic.HEIGHT)
    np.testing.assert_array_equal(mask, white)


def test_black_masks_are_reported(tmp_path):
    """Training would change nothing. Black masks of all photos but one are no error: these are ignored."""
    names = [f"{letter}.png" for letter in "abdefghijc"]  # the last is in the middle of the sorted names
    synthetic.write_scene(tmp_path, names=names)
    (tmp_path / "masks").mkdir()
    for name in names:
        TrainingData(read_scene(tmp_path), test_every=0)
        write_png(tmp_path / "masks" / name, 0 * halves())
    with pytest.raises(LodgsError, match="black, so that all pixels are ignored"):
        TrainingData(read_scene(tmp_path), test_every=0)


def test_damaged_pixels_are_reported(tmp_path):
    write_damaged(tmp_path / "mask.png", slice(60, 90), bytes(30))  # the header stays intact
    with pytest.raises(LodgsError, match=r"mask\.png as an image"):
        load_mask(tmp_path / "mask.png", synthetic.WIDTH, synthetic.HEIGHT)


def test_mask_with_another_aspect_ratio_is_reported_before_reconstruction(tmp_path, capsys):
    synthetic.write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / "b.png.png", halves()[:, ::2])
    arguments = ["--photos", tmp_path / "images", "--masks", tmp_path / "masks", "--out", tmp_path / "out"]
    assert main(["scene", *map(str, arguments)]) == 2
    error = capsys.readouterr().err
    assert "b.png.png" in error and "48x72" in error and "aspect ratio" in error
