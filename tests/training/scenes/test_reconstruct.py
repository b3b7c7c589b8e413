"""Cameras from photographs alone, against the cameras that the photographs were drawn with."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from training.__main__ import main
from training.errors import LodgsError
from training.scenes.cameras import look_at
from training.scenes.colmap import read_scene
from training.scenes.exr import write_exr
from training.scenes.images import load_image, write_png
from training.scenes.reconstruct import _link_masks, draw_pairs, reconstruct

from .synthetic import noise, write_image
from .walls import CAMERA_POSITIONS, HEIGHT, WIDTH, render_photo


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for number, eye in enumerate(CAMERA_POSITIONS):
        write_png(folder / f"{number}.png", render_photo(eye))
    return folder


@pytest.fixture(scope="module")
def made(photos, tmp_path_factory):
    """The scene of these photographs, and what was told meanwhile."""
    out, told = tmp_path_factory.mktemp("made"), []
    return reconstruct(photos, out, tell=lambda *each: told.append(each)), told


def test_all_cameras_are_where_they_were(made):
    """But for the choice of axes and unit: distances between them are in proportion."""
    found, told = made
    assert found.placed == [f"{number}.png" for number in range(6)] and found.error < 1
    assert found.words == "All 6 photographs found their place."
    scene = read_scene(found.folder)
    eyes = np.array([camera.center for camera in scene.cameras])
    apart, truly = (np.linalg.norm(each[:, None] - each[None], axis=2) for each in (eyes, CAMERA_POSITIONS))
    scale = apart.sum() / truly.sum()
    np.testing.assert_allclose(apart / scale, truly, atol=0.03)
    turned = [camera.world_to_camera[:3, :3] for camera in scene.cameras]
    truth = [look_at(eye, np.array([0.0, 0.6, 0.4]), (0, 0, 1))[:3, :3] for eye in CAMERA_POSITIONS]
    for n in range(1, 6):  # angles between views
        expected, angle = (np.trace(each[0] @ each[n].T) for each in (truth, turned))
        assert angle == pytest.approx(expected, abs=0.03)
    assert {what for what, *_ in told} == {
        "Features of photograph", "Pairs compared:", "Photographs placed:",
    }  # fmt: skip
    assert all(0 <= done <= of for _, done, of in told)
    assert (found.folder / "images" / "0.png").is_file() and (found.folder / "colmap" / "pairs.png").is_file()


def test_what_is_known_is_not_done_again(made, photos):
    found, _ = made
    database = found.folder / "colmap" / "database.db"

    def features() -> list:
        with closing(sqlite3.connect(database)) as known:
            return known.execute("select image_id, rows, data from descriptors order by image_id").fetchall()

    with closing(sqlite3.connect(database)) as known:  # a mark that extracting anew would wipe out
        known.execute("update descriptors set data = zeroblob(length(data)) where image_id = 1")
        known.commit()
    before = features()
    again = reconstruct(photos, found.folder)
    assert features() == before and again.placed == found.placed


def test_other_settings_begin_anew_and_only_features_outside_masks_count(photos, tmp_path):
    out, masks = tmp_path / "out", tmp_path / "masks"
    black = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    black[:, : WIDTH // 2] = 0
    masks.mkdir()
    for number in range(6):
        write_png(masks / (f"{number}.png.png" if number % 2 else f"{number}.png"), black)
    reconstruct(photos, out)
    reconstruct(photos, out, masks=masks)
    with closing(sqlite3.connect(out / "colmap" / "database.db")) as known:
        rows = known.execute("select rows, cols, data from keypoints").fetchall()
    for count, columns, data in rows:
        places = np.frombuffer(data, np.float32).reshape(count, columns)
        assert count > 20 and places[:, 0].min() > WIDTH // 2 - 2
    assert json.loads((out / "colmap" / "settings.json").read_text())["masks"] == str(masks)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["", "scene"])
def test_it_goes_on_where_the_scene_is_among_its_photographs(photos, tmp_path, where):
    given = shutil.copytree(photos, tmp_path / "given")
    first = reconstruct(given, given / where)
    settings = (given / where / "colmap" / "settings.json").read_bytes()
    again = reconstruct(given, given / where)
    assert (given / where / "colmap" / "settings.json").read_bytes() == settings
    assert again.placed == first.placed == [f"{number}.png" for number in range(6)] and again.photos == 6


def test_masks_of_webp_photographs_have_the_names_that_these_had(tmp_path):
    Image.fromarray(noise(40, 30)).save(tmp_path / "b.webp")
    for name in ("b.png", "b.webp.png"):
        masks = tmp_path / name.replace(".", "-")
        masks.mkdir()
        write_png(masks / name, np.zeros((30, 40, 3), np.uint8))
        there = _link_masks(masks, tmp_path, {"b.webp": "b.webp.png"}, masks / "out")
        assert [path.name for path in there.iterdir()] == ["b.webp.png.png"]


@pytest.mark.slow
def test_folders_of_a_rig_are_a_lens_each(tmp_path):
    """Of twelve places: each lens is found by as many photographs as the one above."""
    for number, along in enumerate(np.linspace(0, 5, 12)):
        eye = [np.interp(along, range(6), axis) for axis in CAMERA_POSITIONS.T]
        place = tmp_path / "photos" / ("left" if number % 2 else "right") / f"{number}.png"
        place.parent.mkdir(parents=True, exist_ok=True)
        write_png(place, render_photo(np.array(eye)))
    found = reconstruct(tmp_path / "photos", tmp_path / "out", lens="folder")
    assert len(found.placed) == 12
    cameras = read_scene(found.folder).cameras
    lenses = {(camera.name.split("/")[0], round(camera.fx, 6)) for camera in cameras}
    assert {name for name, _ in lenses} == {"left", "right"} and len(lenses) == 2


def test_some_that_show_something_else_are_named(photos, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in photos.iterdir():
        kind = {"1": "tif", "2": "webp", "3": "jpg"}.get(path.stem, "png")
        if kind == "png":  # which Pillow must not write beside pycolmap
            shutil.copyfile(path, folder / path.name)
            continue
        options = {"lossless": True} if kind == "webp" else {}
        with Image.open(path) as image:
            image.save(folder / f"{path.stem}.{kind}", **options)
    random = np.random.default_rng(5)
    for name in ("x.png", "y.png"):
        coarse = random.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 1))
        write_png(
            folder / name,
            np.repeat(np.kron(coarse[..., 0], np.ones((8, 8)))[..., None], 3, 2).astype(np.uint8),
        )
    (folder / "text.jpg").write_text("no picture")
    found = reconstruct(folder, tmp_path / "out", lens="one")
    assert found.placed == ["0.png", "1.tif", "2.webp.png", "3.jpg", "4.png", "5.png"]
    assert found.photos == 8
    assert "6 of 8 photographs found their place: too little overlap between" in found.words
    assert "x.png" in found.words or "y.png" in found.words
    assert found.left_out == [
        f"text.jpg is left out: {folder / 'text.jpg'} is not a JPEG, PNG, TIFF, WebP or EXR image."
    ]


def test_unrelated_photographs_end_in_a_sentence(tmp_path, capsys):
    for number in range(4):
        coarse = np.random.default_rng(number).integers(0, 256, (30, 40))
        pixels = np.kron(coarse, np.ones((8, 8)))
        write_png(tmp_path / f"{number}.png", np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8))
    assert main(["scene", "--photos", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "None of the 4 photographs found its place" in said and "Take photographs a step apart" in said
    assert not (tmp_path / "out" / "sparse").exists()


def test_linear_light_alone_is_photographs(photos, tmp_path):
    for path in photos.iterdir():
        codes = load_image(path, WIDTH, HEIGHT)
        light = np.where(codes < 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
        (tmp_path / "exr").mkdir(exist_ok=True)
        write_exr(
            tmp_path / "exr" / f"{path.stem}.exr", dict(zip("RGB", np.moveaxis(light, 2, 0), strict=True))
        )
    found = reconstruct(tmp_path / "exr", tmp_path / "out", lens="one")
    assert found.placed == sorted(f"{path.stem}.exr" for path in photos.iterdir())


def test_what_is_not_read_is_named(tmp_path, capsys):
    for number in range(4):
        write_png(tmp_path / f"{number}.png", np.full((100, 100, 3), 90, np.uint8))
    for name in ("0.CR2", "5.HEIC", "6.png"):  # a raw beside its picture is nothing that is missing
        (tmp_path / name).write_bytes(b"other")
    assert main(["scene", "--photos", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "5.HEIC is left out: HEIC is not read. Make JPEGs of them." in said
    assert "6.png is left out" in said and "0.CR2" not in said


def test_what_cannot_be(photos, tmp_path):
    (tmp_path / "photos.zip").write_bytes(b"PK")
    with pytest.raises(LodgsError, match=r"photos.zip is a file, not a folder\. Unpack it first\."):
        reconstruct(tmp_path / "photos.zip", tmp_path / "out")
    with pytest.raises(LodgsError, match="does not exist"):
        reconstruct(tmp_path / "nowhere", tmp_path / "out")
    write_image(tmp_path / "few" / "a.png", noise())
    with pytest.raises(LodgsError, match="holds 1 photographs that can be read"):
        reconstruct(tmp_path / "few", tmp_path / "out")
    (tmp_path / "flat").mkdir()
    for number in range(3):
        write_png(tmp_path / "flat" / f"{number}.png", np.full((100, 100, 3), 90, np.uint8))
    with pytest.raises(LodgsError, match="show hardly anything that could be recognised"):
        reconstruct(tmp_path / "flat", tmp_path / "out")
    scene = tmp_path / "scene"
    (scene / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        (scene / "sparse" / "0" / name).write_text("")
    with pytest.raises(LodgsError, match="holds a COLMAP scene already"):
        reconstruct(photos, scene)
    theirs = tmp_path / "theirs" / "colmap" / "database.db"
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"days of work")
    with pytest.raises(LodgsError, match="holds a folder colmap of somebody else's"):
        reconstruct(photos, tmp_path / "theirs")
    assert theirs.read_bytes() == b"days of work"
    with pytest.raises(LodgsError, match="holds no mask"):
        reconstruct(photos, tmp_path / "masked", masks=tmp_path / "few")
    assert main(["scene", "--photos", str(photos)]) == 2


def test_pairs_picture():
    codes = draw_pairs(["a", "b", "c"], [["a", "b", 99], ["b", "c", 9]], ["a", "b"])
    assert codes.shape == (720, 720, 3)
    a, b, c = 120, 360, 600
    assert (codes[a, b] == 255).all() and (codes[b, a] == 255).all() and (codes[a, a] == 80).sum() == 0
    assert codes[b, c][0] == 147 and codes[b, c][1] == 36  # half as bright, by the logarithm, and red
