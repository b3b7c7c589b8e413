"""Masks: which are found, and that they are bent as their photographs are."""

from pathlib import Path

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.optimize.training_data import TrainingData
from training.scenes.colmap import read_scene
from training.scenes.images import load_image, load_mask, write_png
from training.scenes.undistort import undistort_scene

from . import synthetic


def halves() -> np.ndarray:
    """Black on the left."""
    pixels = np.full((synthetic.HEIGHT, synthetic.WIDTH, 3), 255, np.uint8)
    pixels[:, : synthetic.WIDTH // 2] = 0
    return pixels


def spoil(path: Path, part: slice, by: bytes) -> None:
    """Writes a mask of which some bytes are others."""
    write_png(path, halves())
    whole = bytearray(path.read_bytes())
    whole[part] = by
    path.write_bytes(whole)


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


@pytest.mark.parametrize(("folder", "ending"), [("masks", "png"), ("depths", "exr")])
def test_files_of_other_names_are_told(tmp_path, folder, ending):
    synthetic.write_scene(tmp_path)
    assert read_scene(tmp_path).warnings == []
    (tmp_path / folder / "left").mkdir(parents=True)
    assert read_scene(tmp_path).warnings == []
    write_png(tmp_path / folder / "left" / "mask_a.png", halves())
    (told,) = read_scene(tmp_path).warnings
    whose = f"of a.png it would be a.png.{ending}"
    assert told == f"{tmp_path / folder} holds nothing for these photographs: {whose}."


def test_they_are_straightened_like_their_photographs(tmp_path):
    """A photograph that is its own mask still is."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), pixels=halves())
    (tmp_path / "masks").mkdir()
    for name in ("a.png", "b.png"):
        write_png(tmp_path / "masks" / name, halves()[::2, ::2])  # of another size
    scene = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert [camera.mask is None for camera in scene.cameras] == [False, False, True]
    for camera in scene.cameras[:2]:
        assert camera.image is not None and camera.mask is not None
        size = camera.width, camera.height
        photograph, mask = load_image(camera.image, *size), load_image(camera.mask, *size)
        assert np.abs(photograph - mask).mean() < 0.01 and 0.3 < mask.mean() < 0.7


WRONG = {
    "another shape": (
        lambda path: write_png(path, halves()[:, ::2]),
        "of other proportions than its photograph",
    ),
    "no image": (lambda path: path.write_text("people"), "is not a JPEG, PNG, TIFF, WebP or EXR image"),
    "cut short": (lambda path: spoil(path, slice(-20, None), b""), "is cut short"),
    "nothing": (lambda path: path.write_bytes(b""), "is empty"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_is_no_mask_is_a_sentence_before_anything_is_trained(tmp_path, capsys, kind):
    write, says = WRONG[kind]
    synthetic.write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    mask = tmp_path / "masks" / "a.png.png"
    write(mask)
    assert (
        main(["train", str(tmp_path), "--out", str(tmp_path / "run"), "--set", "steps=1", "--method", "3dgs"])
        == 2
    )
    out, err = capsys.readouterr()
    assert says in out and mask.name in out and "Traceback" not in out + err and "progress" not in out


def test_pixels_that_cannot_be_decoded_are_a_sentence(tmp_path):
    spoil(tmp_path / "mask.png", slice(60, 90), bytes(30))  # the head is as it should be
    with pytest.raises(LodgsError, match=r"mask\.png cannot be read as an image"):
        load_mask(tmp_path / "mask.png", synthetic.WIDTH, synthetic.HEIGHT)


def test_a_mask_that_is_of_no_photographs_shape_is_told_before_features_are_looked_for(tmp_path, capsys):
    synthetic.write_scene(tmp_path)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / "b.png.png", halves()[:, ::2])
    words = ["--photos", tmp_path / "images", "--masks", tmp_path / "masks", "--out", tmp_path / "out"]
    assert main(["scene", *map(str, words)]) == 2
    assert "b.png.png is 48x72, of other proportions" in capsys.readouterr().err
