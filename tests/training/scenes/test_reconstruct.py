"""Reconstruction from photos alone, compared with the cameras that rendered them."""

import json
import shutil
import sqlite3
import threading
import time
from contextlib import closing, suppress
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
from training.scenes.reconstruct import STAGES, _link_masks, draw_pairs, reconstruct

from .synthetic import noise, write_image
from .walls import CAMERA_POSITIONS, HEIGHT, WIDTH, render_photo


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for number, position in enumerate(CAMERA_POSITIONS):
        write_png(folder / f"{number}.png", render_photo(position))
    return folder


@pytest.fixture(scope="module")
def reconstruction(photos, tmp_path_factory):
    """Return the reconstructed scene and the reported progress."""
    out, progress = tmp_path_factory.mktemp("scene"), []
    return reconstruct(photos, out, report=lambda *values: progress.append(values)), progress


def test_cameras_match_the_truth_up_to_axes_and_scale(reconstruction):
    """Distances between cameras are proportional."""
    result, progress = reconstruction
    assert result.placed == [f"{number}.png" for number in range(6)] and result.error < 1
    assert result.summary == "All 6 photos are placed."
    scene = read_scene(result.folder)
    positions = np.array([camera.center for camera in scene.cameras])
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    expected = np.linalg.norm(CAMERA_POSITIONS[:, None] - CAMERA_POSITIONS[None], axis=2)
    scale = distances.sum() / expected.sum()
    np.testing.assert_allclose(distances / scale, expected, atol=0.03)
    rotations = [camera.world_to_camera[:3, :3] for camera in scene.cameras]
    truth = [look_at(p, np.array([0.0, 0.6, 0.4]), (0, 0, 1))[:3, :3] for p in CAMERA_POSITIONS]
    for n in range(1, 6):  # angles between views
        expected, angle = (np.trace(views[0] @ views[n].T) for views in (truth, rotations))
        assert angle == pytest.approx(expected, abs=0.03)
    assert {stage for stage, *_ in progress} == {STAGES[name] for name in ("features", "pairs", "cameras")}
    assert all(0 <= done <= total for _, done, total in progress)
    assert (result.folder / "images" / "0.png").is_file() and (
        result.folder / "colmap" / "pairs.png"
    ).is_file()


def test_existing_features_are_reused(reconstruction, photos):
    result, _ = reconstruction
    database = result.folder / "colmap" / "database.db"

    def features() -> list:
        with closing(sqlite3.connect(database)) as connection:
            return connection.execute(
                "select image_id, rows, data from descriptors order by image_id"
            ).fetchall()

    with closing(sqlite3.connect(database)) as connection:  # repeated extraction would overwrite this mark
        connection.execute("update descriptors set data = zeroblob(length(data)) where image_id = 1")
        connection.commit()
    marked = features()
    repeated = reconstruct(photos, result.folder)
    assert features() == marked and repeated.placed == result.placed


def test_masks_restart_the_reconstruction_and_exclude_features(photos, tmp_path):
    out, masks = tmp_path / "out", tmp_path / "masks"
    black = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    black[:, : WIDTH // 2] = 0
    masks.mkdir()
    for number in range(6):
        write_png(masks / (f"{number}.png.png" if number % 2 else f"{number}.png"), black)
    reconstruct(photos, out)
    reconstruct(photos, out, masks=masks)
    with closing(sqlite3.connect(out / "colmap" / "database.db")) as connection:
        rows = connection.execute("select rows, cols, data from keypoints").fetchall()
    for count, columns, data in rows:
        positions = np.frombuffer(data, np.float32).reshape(count, columns)
        assert count > 20 and positions[:, 0].min() > WIDTH // 2 - 2
    assert json.loads((out / "colmap" / "settings.json").read_text())["masks"] == str(masks)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [("--masks", "folder"), ("--ordered",), ("--lens", "each"), ("--preset", "standard")]
)
def test_options_of_photos_are_refused_for_exports(tmp_path, capsys, words):
    """They would have no effect."""
    assert main(["scene", "--from", str(tmp_path), "--out", str(tmp_path / "out"), *words]) == 2
    assert f"Cannot use {words[0]}: it applies only to --photos." in capsys.readouterr().err


@pytest.mark.parametrize("subfolder", [pytest.param("", marks=pytest.mark.nightly), "scene"])
def test_scene_inside_its_photo_folder_resumes(photos, tmp_path, subfolder):
    folder = shutil.copytree(photos, tmp_path / "photos")
    first = reconstruct(folder, folder / subfolder)
    settings = (folder / subfolder / "colmap" / "settings.json").read_bytes()
    repeated = reconstruct(folder, folder / subfolder)
    assert (folder / subfolder / "colmap" / "settings.json").read_bytes() == settings
    assert repeated.placed == first.placed == [f"{n}.png" for n in range(6)] and repeated.photos == 6


def test_masks_of_webp_photos(tmp_path):
    Image.fromarray(noise(40, 30)).save(tmp_path / "b.webp")
    for name in ("b.png", "b.webp.png"):
        masks = tmp_path / name.replace(".", "-")
        masks.mkdir()
        write_png(masks / name, np.zeros((30, 40, 3), np.uint8))
        linked = _link_masks(masks, tmp_path, {"b.webp": "b.webp.png"}, masks / "out")
        assert [path.name for path in linked.iterdir()] == ["b.webp.png.png"]


def test_photos_without_a_mask_are_used_unmasked(tmp_path):
    """COLMAP 4.2.1 drops photos whose mask is missing (MASK_ERROR)."""
    for name in ("a.png", "b.png"):
        Image.fromarray(noise(40, 30)).save(tmp_path / name)
    (tmp_path / "masks").mkdir()
    write_png(tmp_path / "masks" / "a.png", np.zeros((30, 40, 3), np.uint8))
    names = {"a.png": "a.png", "b.png": "b.png"}
    linked = _link_masks(tmp_path / "masks", tmp_path, names, tmp_path / "out")
    codes = {path.name: np.asarray(Image.open(path)) for path in linked.iterdir()}
    assert set(codes) == {"a.png.png", "b.png.png"}
    assert (codes["a.png.png"] == 0).all() and (codes["b.png.png"] == 255).all()
    assert codes["b.png.png"].shape == (30, 40, 3)


@pytest.mark.slow
def test_folders_of_a_rig_have_one_lens_each(tmp_path):
    """Twelve positions give each lens as many photos as in the other tests."""
    for number, moment in enumerate(np.linspace(0, 5, 12)):
        position = [np.interp(moment, range(6), axis) for axis in CAMERA_POSITIONS.T]
        file = tmp_path / "photos" / ("left" if number % 2 else "right") / f"{number}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_png(file, render_photo(np.array(position)))
    result = reconstruct(tmp_path / "photos", tmp_path / "out", lens="folder")
    assert len(result.placed) == 12
    cameras = read_scene(result.folder).cameras
    lenses = {(camera.name.split("/")[0], round(camera.fx, 6)) for camera in cameras}
    assert {name for name, _ in lenses} == {"left", "right"} and len(lenses) == 2


def test_photos_without_overlap_are_named(photos, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in photos.iterdir():
        kind = {"1": "tif", "2": "webp", "3": "jpg"}.get(path.stem, "png")
        if kind == "png":  # Pillow must not write PNG in one process with pycolmap
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
    (folder / "text.jpg").write_text("not an image")
    result = reconstruct(folder, tmp_path / "out", lens="one")
    assert result.placed == ["0.png", "1.tif", "2.webp.png", "3.jpg", "4.png", "5.png"]
    assert result.photos == 8
    assert "6 of 8 photos are placed" in result.summary
    assert "x.png" in result.summary or "y.png" in result.summary
    (message,) = result.excluded
    assert message.startswith("Skipped text.jpg:") and "not a JPEG" in message


def test_unrelated_photos_are_reported(tmp_path, capsys):
    for number in range(4):
        coarse = np.random.default_rng(number).integers(0, 256, (30, 40))
        pixels = np.kron(coarse, np.ones((8, 8)))
        write_png(tmp_path / f"{number}.png", np.repeat(pixels[..., None], 3, axis=2).astype(np.uint8))
    assert main(["scene", "--photos", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "no 3 of the 4 photos overlap enough" in error and "pairs.png" in error
    assert not (tmp_path / "out" / "sparse").exists()


def test_exr_files_without_other_photos_are_photos(photos, tmp_path):
    for path in photos.iterdir():
        codes = load_image(path, WIDTH, HEIGHT)
        light = np.where(codes < 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
        (tmp_path / "exr").mkdir(exist_ok=True)
        write_exr(
            tmp_path / "exr" / f"{path.stem}.exr", dict(zip("RGB", np.moveaxis(light, 2, 0), strict=True))
        )
    result = reconstruct(tmp_path / "exr", tmp_path / "out", lens="one")
    assert result.placed == sorted(f"{path.stem}.exr" for path in photos.iterdir())


def test_readers_cannot_lock_the_database_between_stages(tmp_path):
    for number in range(4):
        write_png(tmp_path / f"{number}.png", np.full((100, 100, 3), 90, np.uint8))
    begun, ended = threading.Event(), threading.Event()

    def lock() -> None:
        begun.wait()
        database = next(tmp_path.rglob("database.db"))
        while not ended.is_set():
            with closing(sqlite3.connect(database, timeout=0)) as reader, suppress(sqlite3.OperationalError):
                reader.execute("pragma locking_mode=exclusive")
                reader.execute("select count(*) from images").fetchone()
                time.sleep(0.01)

    reader = threading.Thread(target=lock, daemon=True)
    reader.start()
    with pytest.raises(LodgsError, match="have almost no features"):
        reconstruct(tmp_path, tmp_path / "out", report=lambda *_: begun.set())
    ended.set()
    reader.join()


def test_unsupported_files_are_named(tmp_path, capsys):
    for number in range(4):
        write_png(tmp_path / f"{number}.png", np.full((100, 100, 3), 90, np.uint8))
    for name in ("0.CR2", "5.HEIC", "6.png"):  # a raw file next to its photo is not missing
        (tmp_path / name).write_bytes(b"other")
    assert main(["scene", "--photos", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "Skipped 5.HEIC: format HEIC is not supported" in error
    assert "Skipped 6.png" in error and "0.CR2" not in error


def test_invalid_inputs_are_rejected(photos, tmp_path):
    (tmp_path / "photos.zip").write_bytes(b"PK")
    with pytest.raises(LodgsError, match=r"photos.zip: it is a file, not a folder\. Unpack it first\."):
        reconstruct(tmp_path / "photos.zip", tmp_path / "out")
    with pytest.raises(LodgsError, match="does not exist"):
        reconstruct(tmp_path / "nowhere", tmp_path / "out")
    write_image(tmp_path / "few" / "a.png", noise())
    with pytest.raises(LodgsError, match="found 1 readable photos"):
        reconstruct(tmp_path / "few", tmp_path / "out")
    (tmp_path / "flat").mkdir()
    for number in range(3):
        write_png(tmp_path / "flat" / f"{number}.png", np.full((100, 100, 3), 90, np.uint8))
    with pytest.raises(LodgsError, match="3 of 3 have almost no features"):
        reconstruct(tmp_path / "flat", tmp_path / "out")
    scene = tmp_path / "scene"
    (scene / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        (scene / "sparse" / "0" / name).write_text("")
    with pytest.raises(LodgsError, match="already holds a COLMAP scene"):
        reconstruct(photos, scene)
    foreign = tmp_path / "foreign" / "colmap" / "database.db"
    foreign.parent.mkdir(parents=True)
    foreign.write_bytes(b"days of work")
    with pytest.raises(LodgsError, match="folder colmap of another program"):
        reconstruct(photos, tmp_path / "foreign")
    assert foreign.read_bytes() == b"days of work"
    with pytest.raises(LodgsError, match="has no mask"):
        reconstruct(photos, tmp_path / "masked", masks=tmp_path / "few")
    assert main(["scene", "--photos", str(photos)]) == 2


def test_draw_pairs():
    codes = draw_pairs(["a", "b", "c"], [["a", "b", 99], ["b", "c", 9]], ["a", "b"])
    assert codes.shape == (720, 720, 3)
    a, b, c = 120, 360, 600
    assert (codes[a, b] == 255).all() and (codes[b, a] == 255).all() and (codes[a, a] == 80).sum() == 0
    assert codes[b, c][0] == 147 and codes[b, c][1] == 36  # half the logarithmic brightness, in red
