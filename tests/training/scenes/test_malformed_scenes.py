"""Malformed scenes: unusable items are skipped with warnings, and no path leaves the scene's folder."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from tests.training.scenes import synthetic
from training.errors import LodgsError
from training.scenes import colmap, colmap_model, image_files
from training.scenes.cameras import camera_to_dict, write_camera
from training.scenes.colmap import exclude_views, read_scene
from training.scenes.observations import observations
from training.scenes.offset_views import read_offset_views


def write_text_model(folder: Path, images: str, points: str = "", cameras: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(cameras or "1 PINHOLE 96 72 80 80 48 36\n")
    (folder / "images.txt").write_text(images)
    (folder / "points3D.txt").write_text(points)
    return folder


def views(*names: str, x: float = 0.0) -> str:
    """Return poses one unit apart along x, starting at ``x``."""
    return "".join(f"{i + 1} 1 0 0 0 {x + i} 0 0 1 {name}\n\n" for i, name in enumerate(names))


def grid(count: int = 4) -> str:
    return "".join(f"{i} {i % 3} {i % 5} {5 + i % 2} 9 9 9 0\n" for i in range(count))


@pytest.fixture
def scene(tmp_path) -> Path:
    """Write photos a.png to c.png without a model."""
    for name in "abc":
        synthetic.write_image(tmp_path / "images" / f"{name}.png", synthetic.noise())
    return tmp_path


# -- photos --------------------------------------------------------------------------------------------------


def test_unusable_photos_are_skipped_with_warnings(scene):
    """Pipes are not opened; links to photos in other folders are followed."""
    images = scene / "images"
    outside = scene.parent / f"{scene.name} outside.png"
    outside.write_bytes((images / "a.png").read_bytes())
    os.mkfifo(images / "fifo.png")
    (images / "link.png").symlink_to(outside)
    (images / "within.png").symlink_to("a.png")
    flat = bytearray((images / "a.png").read_bytes())
    flat[16:20] = bytes(4)
    (images / "flat.png").write_bytes(flat)
    names = ["a.png", "fifo.png", "flat.png", "link.png", "within.png"]
    write_text_model(scene / "sparse", views(*names), grid())
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a.png", "link.png", "within.png"]
    reasons = dict(warning.removeprefix("Skipped ").split(": ", 1) for warning in result.warnings)
    assert "not a file" in reasons["fifo.png"] and "no pixels" in reasons["flat.png"]
    assert len(reasons) == 2


def test_names_that_are_not_utf8_are_escaped_in_warnings(scene):
    name = os.fsdecode(b"\x81oto.png")  # invalid in UTF-8 and in Windows-1252
    (scene / "images" / name).write_bytes((scene / "images" / "a.png").read_bytes())
    folder = write_text_model(scene / "sparse", views("a.png"), grid())
    (folder / "images.txt").write_bytes(views("a.png").encode() + b"9 1 0 0 0 0 0 0 1 \x81oto.png\n\n")
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a.png"]
    (warning,) = result.warnings
    assert "oto.png: its name is not UTF-8." in warning and warning.encode()


@pytest.mark.parametrize("name", ["C:/a.png", "c:\\a.png", "/a.png", "\\\\server\\x\\a.png", "x/../../a.png"])
def test_names_that_leave_the_folder_on_any_system(scene, name):
    """Only their last part is used, as by 3DGS."""
    folder = write_text_model(scene / "sparse", views("b.png", name), grid())
    text = (folder / "images.txt").read_text().replace(f"{name}\n\n", f"{name}\n1 1 2\n")
    (folder / "images.txt").write_text(text)
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a.png", "b.png"]
    assert result.cameras[0].image == scene / "images" / "a.png" and not result.warnings
    assert observations(result, ["a.png"])["a.png"].tolist() == [2]


def test_point_ids_beyond_64_bits(scene):
    write_text_model(scene / "sparse", "1 1 0 0 0 0 0 0 1 a.png\n5 5 2 6 6 99999999999999999999\n", grid())
    result = read_scene(scene)
    with pytest.raises(LodgsError, match=r"images\.txt: the file is damaged"):
        observations(result, ["a.png"])


@pytest.mark.skipif(os.name == "nt", reason="Windows reserves the colon for drives")
def test_names_with_a_colon(scene):
    """A letter before a colon is no drive without a slash."""
    write_text_model(scene / "sparse", views("a:1.png", "b:left/2.png"), grid())
    (scene / "images" / "b:left").mkdir()
    for name in "a:1.png", "b:left/2.png":
        (scene / "images" / name).write_bytes((scene / "images" / "a.png").read_bytes())
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a:1.png", "b:left/2.png"]
    assert result.images_folder == scene / "images" and not result.warnings


def test_search_for_image_folder_stays_inside_the_scene(scene, monkeypatch):
    checked, is_file = [], image_files.is_file
    names = ["a.png", "//server/share/a.png", "../../secret.png", "C:/a.png", "\\\\server\\a.png"]
    write_text_model(scene / "sparse" / "0", views(*names), grid())
    monkeypatch.setattr(image_files, "is_file", lambda path: checked.append(path) or is_file(path))
    for folder in (scene, scene / "sparse" / "0", scene / "sparse"):
        assert len(read_scene(folder).cameras) == 1
    assert checked
    assert all(Path(os.path.abspath(path)).is_relative_to(scene) for path in checked)
    assert not any("server" in str(path) for path in checked)


def test_duplicate_name_is_skipped(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png", "a.png"), grid())
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a.png", "b.png"]
    assert "another view of the same name" in result.warnings[0]
    assert result.cameras[0].world_to_camera[0, 3] == 0, "the first pose of the file"


def test_missing_photos_are_one_warning_and_detected_before_reading_points(scene, monkeypatch):
    write_text_model(scene / "sparse", views("a.png", *(f"no{i:04d}.png" for i in range(1999))), grid())
    (warning,) = read_scene(scene).warnings
    assert "Skipped 1,999 views" in warning and "no0004.png and 1,994 more." in warning and len(warning) < 400
    (scene / "images" / "a.png").unlink()
    monkeypatch.setattr(colmap, "read_points", None)  # makes any call fail
    with pytest.raises(LodgsError, match="none of the 2000 views"):
        read_scene(scene)


def test_number_of_warnings_is_limited(scene):
    names = [f"{i:03d}.png" for i in range(40)]
    for name in names:
        (scene / "images" / name).write_bytes(b"not an image")
    write_text_model(scene / "sparse", views("a.png", *names), grid())
    *named, summary = read_scene(scene).warnings
    assert len(named) == 5 and summary == "Skipped 35 more views for similar reasons."


def test_exclude_views(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid())
    result = read_scene(scene)
    assert exclude_views(result, {}) is result
    remaining = exclude_views(result, {"b.png": "it is damaged."})
    assert [camera.name for camera in remaining.cameras] == ["a.png", "c.png"]
    assert remaining.warnings == ["Skipped b.png: it is damaged."]
    with pytest.raises(LodgsError, match="it is damaged"):
        exclude_views(result, dict.fromkeys(("a.png", "b.png", "c.png"), "it is damaged."))


def test_reading_reports_progress(scene):
    write_text_model(scene / "sparse", views("a.png", *(f"{i}.png" for i in range(200))), grid())
    shares = []
    read_scene(scene, progress=shares.append)
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1 and len(shares) > 4


def test_image_of_offset_view_is_next_to_its_camera(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid())
    camera = read_scene(scene).cameras[0]
    write_camera(scene / "aside" / "a.json", camera, 0.1)
    with pytest.raises(LodgsError, match="does not exist"):
        read_offset_views(scene)
    (scene / "aside" / "a.png").write_bytes((scene / "images" / "a.png").read_bytes())
    assert [view.image for view in read_offset_views(scene)] == [scene / "aside" / "a.png"]
    text = (scene / "aside" / "a.json").read_text().replace('"a.png"', '"../images/a.png"')
    (scene / "aside" / "a.json").write_text(text)
    with pytest.raises(LodgsError, match="outside the image folder"):
        read_offset_views(scene)
    assert camera_to_dict(camera, 0.1)["name"] == "a.png"


# -- models --------------------------------------------------------------------------------------------------


def test_model_behind_link(scene):
    write_text_model(scene / ".colmap" / "run7", views("a.png"), grid())
    (scene / "sparse").mkdir()
    (scene / "sparse" / "0").symlink_to("../.colmap/run7")
    (scene / "sparse" / "up").symlink_to("..")  # a cycle
    (scene / "sparse" / "root").symlink_to("/")  # leaves the scene
    assert read_scene(scene).model == scene / "sparse" / "0"
    assert colmap.find_models(scene) == [scene / "sparse" / "0"]


def test_text_model_of_windows_programs(scene):
    """It has a byte order mark and CR LF line ends."""
    plain = read_scene(
        write_text_model(scene / "sparse", "# images\n" + views("a.png", "b.png"), grid()).parent
    )
    for path in (scene / "sparse").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    result = read_scene(scene)
    assert not result.warnings and [camera.name for camera in result.cameras] == ["a.png", "b.png"]
    np.testing.assert_array_equal(result.points, plain.points)


def test_missing_and_empty_points_give_the_same_warning(scene):
    folder = write_text_model(scene / "sparse", views("a.png"))
    (empty,) = read_scene(scene).warnings
    (folder / "points3D.txt").unlink()
    assert read_scene(scene).warnings == [empty] and "no points" in empty


def test_points_of_zeros_are_read_in_linear_time(scene):
    """In 6 MB of zeros, every byte is a possible start of a record."""
    synthetic.write_scene(scene / "x", names=["a.png"])
    path = scene / "x" / "sparse" / "0" / "points3D.bin"
    path.write_bytes(struct.pack("<Q", 120_000) + bytes(51 * 120_000))
    assert len(read_scene(scene / "x").points) == 120_000
    path.write_bytes(struct.pack("<Q", 7) + bytes(51 * 120_000))
    with pytest.raises(LodgsError, match="instead of 7"):
        read_scene(scene / "x")


def test_records_across_block_borders(monkeypatch):
    """Blocks contain few records, and some records are longer than a block."""
    random = np.random.default_rng(1)
    monkeypatch.setattr(colmap_model, "_BLOCK", 200)
    lengths = random.choice([0, 1, 2, 3, 18, 19, 20, 60], 500)
    records = [random.bytes(43) + struct.pack("<Q", n) + random.bytes(8 * int(n)) for n in lengths]
    body = np.frombuffer(b"".join(records), np.uint8)
    starts = np.concatenate([[0], np.cumsum(51 + 8 * lengths)[:-1]])
    np.testing.assert_array_equal(colmap_model._point_starts(body, len(starts)), starts)
    for cut in (1, 30, 51, 60):
        with pytest.raises(ValueError, match="ends inside point"):
            colmap_model._point_starts(
                body[: -cut if lengths[-1] * 8 + 51 > cut else -(cut + 7)], len(starts)
            )


def test_outlier_points_are_dropped(scene):
    """Points at 1e9, 1e20, 1e300 and NaN do not change the scene."""
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid(60))
    plain = read_scene(scene)
    outliers = "90 1e9 0 0 1 2 3 0\n91 0 1e20 0 1 2 3 0\n92 0 nan 0 1 2 3 0\n93 0 1e300 0 1 2 3 0\n"
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid(60) + outliers)
    result = read_scene(scene)
    np.testing.assert_array_equal(result.points, plain.points)
    np.testing.assert_array_equal(result.point_colors, plain.point_colors)
    assert result.median_depth() == plain.median_depth()
    assert not plain.warnings and "4 points" in result.warnings[0]


def test_distant_points_are_kept(scene):
    """Points on the horizon are valid."""
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid(60) + "90 900 0 3000 1 2 3 0\n")
    assert len(read_scene(scene).points) == 61


@pytest.mark.parametrize("position", ["1e30", "1e9", "1e300"])
def test_outlier_camera_is_dropped(scene, position):
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid())
    extent = read_scene(scene).extent()
    write_text_model(
        scene / "sparse", views("a.png", "b.png") + f"9 1 0 0 0 0 {position} 0 1 c.png\n\n", grid()
    )
    result = read_scene(scene)
    assert result.extent() == extent and [camera.name for camera in result.cameras] == ["a.png", "b.png"]
    assert result.warnings[0].startswith("Skipped c.png: its p")


@pytest.mark.parametrize("focal", ["1e-300", "1e300", "1e-5"])
def test_views_with_impossible_lens_are_skipped(scene, focal):
    cameras = f"1 PINHOLE 96 72 80 80 48 36\n2 PINHOLE 96 72 {focal} 80 48 36\n"
    lines = views("a.png", "b.png") + "9 1 0 0 0 0 0 0 2 c.png\n\n"
    write_text_model(scene / "sparse", lines, grid(), cameras)
    result = read_scene(scene)
    assert [camera.name for camera in result.cameras] == ["a.png", "b.png"]
    assert "Skipped c.png: its focal length" in result.warnings[0]


@pytest.mark.parametrize("scale", [1e-300, 5e-324, 1e200])
def test_quaternions_of_any_length_are_rotations(scene, scale):
    line = f"1 {scale} 0 0 {scale} 1 2 3 1 a.png\n\n"
    write_text_model(scene / "sparse", line, grid())
    rotation = read_scene(scene).cameras[0].world_to_camera[:3, :3]
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("size", ["0 72", "96 -3", "1" + 400 * "0" + " 72", "18446744073709551616 72"])
def test_impossible_camera_size_is_rejected(scene, size):
    write_text_model(scene / "sparse", views("a.png"), grid(), f"1 PINHOLE {size} 80 80 48 36\n")
    with pytest.raises(LodgsError, match="invalid size"):
        read_scene(scene)


def test_colors_are_clipped_to_eight_bits(scene):
    points = grid() + "90 1 1 5 300 -4 nan 0\n"
    write_text_model(scene / "sparse", views("a.png"), points)
    assert read_scene(scene).point_colors[-1].tolist() == [255, 0, 0]


def test_folder_name_that_is_not_utf8_is_rejected(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    with pytest.raises(LodgsError, match="not UTF-8") as error:
        read_scene(folder)
    assert str(error.value).encode()
