"""Undistortion, compared with pycolmap's camera models pixel by pixel."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenEXR
import pycolmap
import pytest

from tests.training.scenes import synthetic
from training.color import linear_from_srgb
from training.errors import LodgsError
from training.scenes import pycolmap_process
from training.scenes.colmap import read_scene
from training.scenes.images import load_image
from training.scenes.undistort import undistort_scene
from training.splats.georeference import Georeference, write_georeference


def ramps() -> np.ndarray:
    """Return pixels whose red is proportional to x and whose green is proportional to y."""
    x, y = np.meshgrid(np.linspace(0, 255, synthetic.WIDTH), np.linspace(0, 255, synthetic.HEIGHT))
    return np.stack([x, y, 0 * x], axis=2).round().astype(np.uint8)


COMMON = {"SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"}


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(name, marks=[] if name in COMMON else pytest.mark.nightly)
        for name in synthetic.DISTORTION
    ],
)
def test_camera_models_become_pinholes(tmp_path, model):
    """Each undistorted pixel shows the distorted image's colour along the same ray."""
    lens = synthetic.camera(model)
    synthetic.write_scene(tmp_path, lens, names=["a.png"], pixels=ramps())
    scene = read_scene(tmp_path)
    result = undistort_scene(scene, tmp_path / "cache")
    assert result.distorted == [] and result.warnings == []
    (camera,) = result.cameras
    np.testing.assert_allclose(camera.world_to_camera, scene.cameras[0].world_to_camera, atol=1e-12)
    np.testing.assert_array_equal(result.points, scene.points)

    image = load_image(camera.image, camera.width, camera.height)
    v, u = np.mgrid[2 : camera.height - 2 : 5, 2 : camera.width - 2 : 5]
    rays = [((u + 0.5 - camera.cx) / camera.fx).ravel(), ((v + 0.5 - camera.cy) / camera.fy).ravel()]
    expected = np.array([lens.img_from_cam([x, y, 1.0]) for x, y in zip(*rays, strict=True)])
    actual = image[v, u].reshape(-1, 3) * [synthetic.WIDTH - 1, synthetic.HEIGHT - 1, 0] + 0.5
    inside = (expected > 1).all(axis=1) & (expected < [synthetic.WIDTH - 1, synthetic.HEIGHT - 1]).all(axis=1)
    assert inside.mean() > 0.9
    assert np.abs(actual[:, :2] - expected)[inside].max() < 0.35


def test_ideal_fisheye_is_undistorted(tmp_path):
    """COLMAP itself copies a fisheye without further distortion."""
    lens = synthetic.camera("OPENCV_FISHEYE", [0, 0, 0, 0])
    synthetic.write_scene(tmp_path, lens, names=["a.png"], pixels=ramps())
    result = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    (camera,) = result.cameras
    assert result.distorted == []
    # r = f atan(tan) instead of r = f tan, at a pixel far from the centre
    u, v = camera.width - 12, int(camera.cy)
    tangent = (u + 0.5 - camera.cx) / camera.fx
    actual = load_image(camera.image, camera.width, camera.height)[v, u, 0] * (synthetic.WIDTH - 1) + 0.5
    assert actual == pytest.approx(47 + 80 * np.arctan(tangent), abs=0.35)
    assert abs(80 * (tangent - np.arctan(tangent))) > 1


@pytest.mark.parametrize(
    "suffix", ["exr", "tiff", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("tif", "webp"))]
)
def test_unsupported_formats_are_undistorted_like_a_png(tmp_path, suffix):
    """EXR keeps floats above 1; a TIFF of grey floats equals the grey PNG."""
    grey = np.repeat(ramps()[..., :1], 3, axis=2)
    synthetic.write_scene(
        tmp_path, synthetic.camera("OPENCV"), names=["a.png"], pixels=grey if suffix == "tiff" else ramps()
    )
    (plain,) = undistort_scene(read_scene(tmp_path), tmp_path / "cache").cameras
    model, path = pycolmap.Reconstruction(tmp_path / "sparse/0"), tmp_path / "images" / f"a.{suffix}"
    (image,) = model.images.values()
    image.name = path.name
    model.write(tmp_path / "sparse/0")
    if suffix == "exr":
        light = linear_from_srgb(ramps() / 255) * 4
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": light.astype(np.float32)}).write(str(path))
    else:  # Pillow must not write in one process with pycolmap
        change = (
            "convert('F').point(lambda code: code * (1 / 255) + 0)" if suffix == "tiff" else "convert('RGB')"
        )
        program = (
            "import sys; from PIL import Image; "
            f"Image.open(sys.argv[1]).{change}.save(sys.argv[2], lossless=True, tiffinfo={{274: 6}})"
        )
        subprocess.run([sys.executable, "-c", program, tmp_path / "images" / "a.png", path], check=True)
    (camera,) = undistort_scene(read_scene(tmp_path), tmp_path / "cache").cameras
    assert camera.image is not None and plain.image is not None and camera.image.name == path.name
    assert (camera.width, camera.height, camera.fx) == (plain.width, plain.height, plain.fx)
    size = camera.width, camera.height
    actual = load_image(camera.image, *size, exposure=-2 if suffix == "exr" else 0)
    np.testing.assert_allclose(actual, load_image(plain.image, *size), atol=3 / 255)
    assert camera.turns == ("tif" in suffix)


def test_names_sizes_and_missing_images(tmp_path):
    """Unicode, spaces, subfolders, photos at half the model's size, and a missing photo."""
    names = ["a  b #1%20.png", "c/写真 01.png", "c/absent.png", "ä/ö/ü.png"]
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=names)
    for name in names:
        synthetic.write_image(tmp_path / "images" / name, ramps()[::2, ::2])
    (tmp_path / "images" / "c" / "absent.png").unlink()
    scene = read_scene(tmp_path)
    result = undistort_scene(scene, tmp_path / "cache")
    assert [camera.name for camera in result.cameras] == [names[0], names[1], names[3]]
    assert result.warnings == scene.warnings and len(scene.warnings) == 1
    for camera in result.cameras:
        assert 30 < camera.width <= 60 and camera.fx == pytest.approx(40)
        assert load_image(camera.image, camera.width, camera.height).shape == (camera.height, camera.width, 3)


def test_cache_depends_on_content(tmp_path, monkeypatch):
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"))
    cache = tmp_path / "cache"
    scene = read_scene(tmp_path)
    first = undistort_scene(scene, cache)
    assert [path.name for path in cache.iterdir()] == [first.folder.name]  # and no unfinished folder

    synthetic.write_image(tmp_path / "images" / "a.png", ramps())
    second = undistort_scene(read_scene(tmp_path), cache)
    assert second.folder != first.folder

    monkeypatch.setattr(subprocess, "Popen", None)  # makes any call fail
    assert undistort_scene(read_scene(tmp_path), cache).cameras[0].image == second.cameras[0].image


def test_place_on_earth_stays_the_same(tmp_path):
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"))
    write_georeference(tmp_path, Georeference("EPSG:32631", np.diag([2.0, 2.0, 2.0, 1.0])))
    scene = read_scene(tmp_path)
    assert undistort_scene(scene, tmp_path / "cache").georeference is scene.georeference is not None


def test_pinhole_scene_is_returned_unchanged(tmp_path):
    synthetic.write_scene(tmp_path)
    scene = read_scene(tmp_path)
    assert undistort_scene(scene, tmp_path / "cache") is scene
    assert not (tmp_path / "cache").exists()


def test_pinhole_views_among_distorted_ones_stay_unchanged(tmp_path):
    """Size, intrinsics and image of the pinhole view stay the same."""
    synthetic.write_scene(tmp_path, names=["a.png", "b.png"])
    model = tmp_path / "text"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 96 72 80 82 47 37\n2 SIMPLE_RADIAL 96 72 80 48 36 0.2\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 2 b.png\n\n")
    (model / "points3D.txt").write_text("")
    scene = read_scene(tmp_path, model=model)
    assert scene.distorted == ["b.png"]
    pinhole, undistorted = undistort_scene(scene, tmp_path / "cache").cameras
    assert (pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == (
        96,
        72,
        80,
        82,
        47,
        37,
    )
    np.testing.assert_array_equal(
        load_image(pinhole.image, 96, 72), synthetic.noise().astype(np.float32) / 255
    )
    assert (undistorted.width, undistorted.height) != (96, 72)


def test_photos_of_one_camera_may_differ_in_size(tmp_path):
    """The second photo has the size of the model; the first is smaller, with a rounded height."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=["a.png", "b.png"], pixels=ramps())
    synthetic.write_image(tmp_path / "images" / "a.png", ramps()[::2, ::2][:35])
    small, large = undistort_scene(read_scene(tmp_path), tmp_path / "cache").cameras
    assert small.fx == pytest.approx(40) and small.fy == pytest.approx(82 * 35 / 72)
    assert (large.fx, large.fy) == pytest.approx((80, 82)) and small.width < 50 < large.width


def test_photos_with_another_suffix_and_turned_photos(tmp_path):
    """Pycolmap does not find the first file, and the second is a pinhole view that EXIF turns."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=["a.png"], pixels=ramps())
    expected = undistort_scene(read_scene(tmp_path), tmp_path / "cache").cameras[0]
    (tmp_path / "images" / "a.png").rename(tmp_path / "images" / "a.PNG")
    (camera,) = undistort_scene(read_scene(tmp_path), tmp_path / "other").cameras
    assert (camera.width, camera.cx, camera.cy) == (expected.width, expected.cx, expected.cy)
    pictures = [load_image(view.image, view.width, view.height) for view in (camera, expected)]
    assert np.abs(pictures[0] - pictures[1]).max() < 0.02

    model = tmp_path / "text"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 72 96 80 82 33 47\n2 SIMPLE_RADIAL 96 72 80 48 36 0.2\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 b.jpg\n\n2 1 0 0 0 1 0 0 2 a.png\n\n")
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    synthetic.write_image(tmp_path / "images" / "b.jpg", ramps())
    content = (tmp_path / "images" / "b.jpg").read_bytes()
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "images" / "b.jpg").write_bytes(content[:2] + segment + content[2:])
    scene = read_scene(tmp_path, model=model)
    rotated_view = next(camera for camera in scene.cameras if camera.name == "b.jpg")
    assert (rotated_view.width, rotated_view.height, rotated_view.fx, rotated_view.cx) == (96, 72, 82, 47)
    result = undistort_scene(scene, tmp_path / "cache").cameras
    np.testing.assert_allclose(
        next(camera for camera in result if camera.name == "b.jpg").world_to_camera,
        rotated_view.world_to_camera,
        atol=1e-12,
    )
    assert [(camera.fx, camera.cx) for camera in result if camera.name == "b.jpg"] == [(82, 47)]


def test_tracks_of_absent_observations_do_not_matter(tmp_path):
    """pycolmap cannot read such models; programs that write no observations make them."""
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"))
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    for file in (tmp_path / "sparse/0").iterdir():
        file.unlink()
    model.write_text(tmp_path / "sparse/0")
    lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
    lines_without_observations = [
        line if line.endswith(".png") else "" for line in lines if not line.startswith("#")
    ]
    (tmp_path / "sparse/0/images.txt").write_text("\n".join([*lines_without_observations, ""]))
    result = undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert len(result.cameras) == 3 and len(result.points) == 50


def test_failures_are_reported_and_leave_no_files(tmp_path, monkeypatch):
    synthetic.write_scene(tmp_path, synthetic.camera("RADIAL"))
    with monkeypatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path / "broken"))
        (tmp_path / "broken").mkdir()
        (tmp_path / "broken" / "pycolmap.py").write_text("raise ImportError('no libraries')")
        with pytest.raises(LodgsError, match=r"Cannot undistort.*no libraries") as error:
            undistort_scene(read_scene(tmp_path), tmp_path / "cache")
    assert "Traceback" not in str(error.value) and error.value.remedy
    assert os.listdir(tmp_path / "cache") == []
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LodgsError, match="Cannot undistort"):
        undistort_scene(read_scene(tmp_path), tmp_path / "file")


def test_points_of_real_scene_project_to_their_features(shared_scenes, tmp_path):
    """Each point projects to the position of pycolmap's undistorted keypoint."""
    scene = read_scene(shared_scenes / "variants" / "distorted_simple_radial")
    truth = pycolmap.Reconstruction(str(scene.model))
    views = {image.name: image for image in truth.images.values()}
    result = undistort_scene(scene, tmp_path)
    assert len(result.cameras) == 32 and not result.distorted
    for camera in result.cameras[::8]:
        view = views[camera.name]
        observed = [point for point in view.points2D if point.has_point3D()]
        tangents = np.array([view.camera.cam_from_img(point.xy) for point in observed])
        expected = tangents * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        points = np.array([truth.points3D[point.point3D_id].xyz for point in observed])
        local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        projected = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        assert np.median(np.linalg.norm(projected - expected, axis=1)) < 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's list of child processes")
def test_program_that_hangs_on_a_full_disk_is_killed_and_reported(monkeypatch, tmp_path):
    """COLMAP's threads can wait for each other forever after one of them met a full disk."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=["a.png"], pixels=ramps())
    scene = read_scene(tmp_path)
    assert scene.distorted
    real, require_free_space = subprocess.Popen, pycolmap_process._require_free_space
    hangs = [sys.executable, "-c", "import sys, time; sys.stdin.readline(); time.sleep(600)"]
    monkeypatch.setattr(pycolmap_process.subprocess, "Popen", lambda _, **settings: real(hangs, **settings))
    monkeypatch.setattr(pycolmap_process, "CHECK_SECONDS", 0.05)
    checks = []

    def check(folder):
        checks.append(folder)
        if len(checks) > 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        require_free_space(folder)

    monkeypatch.setattr(pycolmap_process, "_require_free_space", check)
    with pytest.raises(LodgsError, match="No space left on device"):
        undistort_scene(scene, tmp_path / "cache")
    assert not list((tmp_path / "cache").iterdir())


def test_program_stops_when_its_parent_is_killed(tmp_path):
    names = [f"{number}.png" for number in range(200)]
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=names)
    large = np.kron(ramps(), np.ones((40, 40, 1), np.uint8))
    synthetic.write_image(tmp_path / "large.png", large)
    for name in names:
        (tmp_path / "images" / name).unlink()
        os.link(tmp_path / "large.png", tmp_path / "images" / name)
    program = (
        "import sys; from pathlib import Path; from training.scenes.colmap import read_scene;"
        "from training.scenes.undistort import undistort_scene;"
        "undistort_scene(read_scene(Path(sys.argv[1])), Path(sys.argv[1]) / 'cache')"
    )
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=Path(__file__).parents[3])
    while not list(tmp_path.glob("cache/undistorting-*/undistorted/images/*")):
        assert parent.poll() is None
        time.sleep(0.01)
    (child,) = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    while Path(f"/proc/{child}").exists() and "Z" not in Path(f"/proc/{child}/stat").read_text().split()[2]:
        time.sleep(0.01)
    images = list(tmp_path.glob("cache/undistorting-*/undistorted/images/*"))
    assert len(images) < len(names)


def test_text_models_made_by_hand_are_undistorted(tmp_path):
    """COLMAP itself takes each second image for the 2D points of the first."""
    synthetic.write_scene(tmp_path, synthetic.camera("OPENCV"), names=["a.png", "b.png"], pixels=ramps())
    model = tmp_path / "sparse" / "0"
    expected = undistort_scene(read_scene(tmp_path), tmp_path / "cache").cameras
    pycolmap.Reconstruction(model).write_text(model)
    for file in model.glob("*.bin"):
        file.unlink()
    lines = (model / "images.txt").read_text().splitlines()
    images = [line for line in lines if line.endswith(".png")]
    (model / "images.txt").write_text("\n".join(images))
    points = [
        line.split()[:7] for line in (model / "points3D.txt").read_text().splitlines() if line[0] != "#"
    ]
    (model / "points3D.txt").write_text("\n".join(" ".join(point) for point in points))
    cameras = undistort_scene(read_scene(tmp_path), tmp_path / "text").cameras
    assert [camera.name for camera in cameras] == [camera.name for camera in expected] == ["a.png", "b.png"]
    for camera, other in zip(cameras, expected, strict=True):
        assert (camera.width, camera.height) == (other.width, other.height)
        np.testing.assert_allclose(camera.world_to_camera, other.world_to_camera, atol=1e-12)
