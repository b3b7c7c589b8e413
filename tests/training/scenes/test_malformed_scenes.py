"""Scenes as strangers make them: what is odd is left out and named, and nothing leads out of the folder."""

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
from training.scenes.offset_views import read_offset_views


def write_text_model(folder: Path, images: str, points: str = "", cameras: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(cameras or "1 PINHOLE 96 72 80 80 48 36\n")
    (folder / "images.txt").write_text(images)
    (folder / "points3D.txt").write_text(points)
    return folder


def views(*names: str, x: float = 0.0) -> str:
    """Poses a unit apart along x, from ``x`` on."""
    return "".join(f"{i + 1} 1 0 0 0 {x + i} 0 0 1 {name}\n\n" for i, name in enumerate(names))


def grid(count: int = 4) -> str:
    return "".join(f"{i} {i % 3} {i % 5} {5 + i % 2} 9 9 9 0\n" for i in range(count))


@pytest.fixture
def scene(tmp_path) -> Path:
    """Photographs a.png to c.png, without a model."""
    for name in "abc":
        synthetic.write_image(tmp_path / "images" / f"{name}.png", synthetic.noise())
    return tmp_path


# -- photographs ---------------------------------------------------------------------------------------------


def test_odd_photographs_are_left_out_and_named(scene):
    """None of them is opened that has no end, none leads out, none ends the import."""
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
    found = read_scene(scene)
    assert [camera.name for camera in found.cameras] == ["a.png", "within.png"]
    sentences = dict(warning.split(" is left out: ") for warning in found.warnings)
    assert "not a file" in sentences["fifo.png"] and "no pixels" in sentences["flat.png"]
    assert "leads out" in sentences["link.png"] and len(sentences) == 3


def test_names_that_are_no_text_are_named_all_the_same(scene):
    name = os.fsdecode(b"\xffoto.png")
    (scene / "images" / name).write_bytes((scene / "images" / "a.png").read_bytes())
    folder = write_text_model(scene / "sparse", views("a.png"), grid())
    (folder / "images.txt").write_bytes(views("a.png").encode() + b"9 1 0 0 0 0 0 0 1 \xffoto.png\n\n")
    found = read_scene(scene)
    assert [camera.name for camera in found.cameras] == ["a.png"]
    (warning,) = found.warnings
    assert "oto.png is left out: its name is not UTF-8." in warning and warning.encode()


@pytest.mark.parametrize("name", ["C:/a.png", "c:a.png", "/a.png", "\\\\server\\x\\a.png", "x/../../a.png"])
def test_names_that_lead_out_on_any_system(scene, name):
    write_text_model(scene / "sparse", views("b.png", name), grid())
    found = read_scene(scene)
    assert [camera.name for camera in found.cameras] == ["b.png"]
    assert "leads out" in found.warnings[0]


def test_the_search_for_the_image_folder_looks_at_nothing_outside(scene, monkeypatch):
    looked_at, isfile = [], os.path.isfile
    names = ["a.png", "//server/share/a.png", "../../secret.png", "C:/a.png", "\\\\server\\a.png"]
    write_text_model(scene / "sparse" / "0", views(*names), grid())
    monkeypatch.setattr(image_files.os.path, "isfile", lambda path: looked_at.append(path) or isfile(path))
    for folder in (scene, scene / "sparse" / "0", scene / "sparse"):
        assert len(read_scene(folder).cameras) == 1
    assert looked_at
    assert all(Path(os.path.abspath(path)).is_relative_to(scene) for path in looked_at)
    assert not any("server" in str(path) for path in looked_at)


def test_a_name_twice_counts_once(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png", "a.png"), grid())
    found = read_scene(scene)
    assert [camera.name for camera in found.cameras] == ["a.png", "b.png"]
    assert "another view of that name" in found.warnings[0]
    assert found.cameras[0].world_to_camera[0, 3] == 0, "the first one of the file"


def test_many_missing_photographs_are_one_warning_and_known_before_the_points(scene, monkeypatch):
    write_text_model(scene / "sparse", views("a.png", *(f"no{i:04d}.png" for i in range(1999))), grid())
    (warning,) = read_scene(scene).warnings
    assert "1,999 views are left out" in warning and "no0004.png, ..." in warning and len(warning) < 400
    (scene / "images" / "a.png").unlink()
    monkeypatch.setattr(colmap, "read_points", None)  # whoever reads them now, fails
    with pytest.raises(LodgsError, match="None of the 2000 views"):
        read_scene(scene)


def test_many_odd_photographs_are_few_warnings(scene):
    names = [f"{i:03d}.png" for i in range(40)]
    for name in names:
        (scene / "images" / name).write_bytes(b"no picture")
    write_text_model(scene / "sparse", views("a.png", *names), grid())
    *five, rest = read_scene(scene).warnings
    assert len(five) == 5 and rest == "35 more views are left out for reasons like these."


def test_views_are_taken_out_of_a_scene(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid())
    found = read_scene(scene)
    assert exclude_views(found, {}) is found
    less = exclude_views(found, {"b.png": "it is torn."})
    assert [camera.name for camera in less.cameras] == ["a.png", "c.png"]
    assert less.warnings == ["b.png is left out: it is torn."]
    with pytest.raises(LodgsError, match="it is torn"):
        exclude_views(found, dict.fromkeys(("a.png", "b.png", "c.png"), "it is torn."))


def test_reading_tells_how_far_it_is(scene):
    write_text_model(scene / "sparse", views("a.png", *(f"{i}.png" for i in range(200))), grid())
    shares = []
    read_scene(scene, progress=shares.append)
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1 and len(shares) > 4


def test_a_picture_aside_lies_beside_its_camera(scene):
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid())
    camera = read_scene(scene).cameras[0]
    write_camera(scene / "aside" / "a.json", camera, 0.1)
    with pytest.raises(LodgsError, match="there is no such file"):
        read_offset_views(scene)
    (scene / "aside" / "a.png").write_bytes((scene / "images" / "a.png").read_bytes())
    assert [view.image for view in read_offset_views(scene)] == [scene / "aside" / "a.png"]
    text = (scene / "aside" / "a.json").read_text().replace('"a.png"', '"../images/a.png"')
    (scene / "aside" / "a.json").write_text(text)
    with pytest.raises(LodgsError, match="leads out"):
        read_offset_views(scene)
    assert camera_to_dict(camera, 0.1)["name"] == "a.png"


# -- models --------------------------------------------------------------------------------------------------


def test_a_model_behind_a_link(scene):
    write_text_model(scene / ".colmap" / "run7", views("a.png"), grid())
    (scene / "sparse").mkdir()
    (scene / "sparse" / "0").symlink_to("../.colmap/run7")
    (scene / "sparse" / "up").symlink_to("..")  # in circles
    (scene / "sparse" / "root").symlink_to("/")  # and out
    assert read_scene(scene).model == scene / "sparse" / "0"
    assert colmap.find_models(scene) == [scene / "sparse" / "0"]


def test_a_text_model_as_windows_writes_it(scene):
    """A byte order mark, and lines that end in CR LF."""
    plain = read_scene(
        write_text_model(scene / "sparse", "# images\n" + views("a.png", "b.png"), grid()).parent
    )
    for path in (scene / "sparse").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    found = read_scene(scene)
    assert not found.warnings and [camera.name for camera in found.cameras] == ["a.png", "b.png"]
    np.testing.assert_array_equal(found.points, plain.points)


def test_no_points_are_told_whether_or_not_there_is_a_file(scene):
    folder = write_text_model(scene / "sparse", views("a.png"))
    (empty,) = read_scene(scene).warnings
    (folder / "points3D.txt").unlink()
    assert read_scene(scene).warnings == [empty] and "no points" in empty


def test_points_among_zeros_are_read_in_a_straight_line(scene):
    """6 MB of zeros, in which every byte could begin a record: it took minutes and more."""
    synthetic.write_scene(scene / "x", names=["a.png"])
    path = scene / "x" / "sparse" / "0" / "points3D.bin"
    path.write_bytes(struct.pack("<Q", 120_000) + bytes(51 * 120_000))
    assert len(read_scene(scene / "x").points) == 120_000
    path.write_bytes(struct.pack("<Q", 7) + bytes(51 * 120_000))
    with pytest.raises(LodgsError, match="should hold 7"):
        read_scene(scene / "x")


def test_records_are_followed_over_the_blocks_borders(monkeypatch):
    """Blocks of few records, records longer than a block."""
    random = np.random.default_rng(1)
    monkeypatch.setattr(colmap_model, "_BLOCK", 200)
    lengths = random.choice([0, 1, 2, 3, 18, 19, 20, 60], 500)
    records = [random.bytes(43) + struct.pack("<Q", n) + random.bytes(8 * int(n)) for n in lengths]
    body = np.frombuffer(b"".join(records), np.uint8)
    starts = np.concatenate([[0], np.cumsum(51 + 8 * lengths)[:-1]])
    np.testing.assert_array_equal(colmap_model._point_starts(body), starts)
    for cut in (1, 30, 51, 60):
        with pytest.raises(ValueError, match="ends within point"):
            colmap_model._point_starts(body[: -cut if lengths[-1] * 8 + 51 > cut else -(cut + 7)])


def test_points_astray_do_not_count(scene):
    """One at 1e9, one at 1e20, one that is no number: the scene is the one without them."""
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid(60))
    plain = read_scene(scene)
    astray = "90 1e9 0 0 1 2 3 0\n91 0 1e20 0 1 2 3 0\n92 0 nan 0 1 2 3 0\n93 0 1e300 0 1 2 3 0\n"
    write_text_model(scene / "sparse", views("a.png", "b.png", "c.png"), grid(60) + astray)
    found = read_scene(scene)
    np.testing.assert_array_equal(found.points, plain.points)
    np.testing.assert_array_equal(found.point_colors, plain.point_colors)
    assert found.median_depth() == plain.median_depth()
    assert not plain.warnings and "4 points" in found.warnings[0]


def test_points_far_away_count(scene):
    """Those on the horizon are what a camera sees there."""
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid(60) + "90 900 0 3000 1 2 3 0\n")
    assert len(read_scene(scene).points) == 61


@pytest.mark.parametrize("place", ["1e30", "1e9", "1e300"])
def test_a_camera_astray_does_not_decide_the_extent(scene, place):
    write_text_model(scene / "sparse", views("a.png", "b.png"), grid())
    extent = read_scene(scene).extent()
    write_text_model(scene / "sparse", views("a.png", "b.png") + f"9 1 0 0 0 0 {place} 0 1 c.png\n\n", grid())
    found = read_scene(scene)
    assert found.extent() == extent and [camera.name for camera in found.cameras] == ["a.png", "b.png"]
    assert found.warnings[0].startswith("c.png is left out: it")


@pytest.mark.parametrize("focal", ["1e-300", "1e300", "1e-5"])
def test_an_impossible_lens_leaves_its_views_out(scene, focal):
    cameras = f"1 PINHOLE 96 72 80 80 48 36\n2 PINHOLE 96 72 {focal} 80 48 36\n"
    lines = views("a.png", "b.png") + "9 1 0 0 0 0 0 0 2 c.png\n\n"
    write_text_model(scene / "sparse", lines, grid(), cameras)
    found = read_scene(scene)
    assert [camera.name for camera in found.cameras] == ["a.png", "b.png"]
    assert "c.png is left out: its focal length" in found.warnings[0]


@pytest.mark.parametrize("scale", [1e-300, 5e-324, 1e200])
def test_a_quaternion_of_any_length_is_a_rotation(scene, scale):
    line = f"1 {scale} 0 0 {scale} 1 2 3 1 a.png\n\n"
    write_text_model(scene / "sparse", line, grid())
    rotation = read_scene(scene).cameras[0].world_to_camera[:3, :3]
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("size", ["0 72", "96 -3", "1" + 400 * "0" + " 72", "18446744073709551616 72"])
def test_a_camera_of_impossible_size(scene, size):
    write_text_model(scene / "sparse", views("a.png"), grid(), f"1 PINHOLE {size} 80 80 48 36\n")
    with pytest.raises(LodgsError, match="no size"):
        read_scene(scene)


def test_colours_beyond_eight_bits(scene):
    points = grid() + "90 1 1 5 300 -4 nan 0\n"
    write_text_model(scene / "sparse", views("a.png"), points)
    assert read_scene(scene).point_colors[-1].tolist() == [255, 0, 0]


def test_a_folder_whose_name_is_no_text(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    with pytest.raises(LodgsError, match="not UTF-8") as error:
        read_scene(folder)
    assert str(error.value).encode()
