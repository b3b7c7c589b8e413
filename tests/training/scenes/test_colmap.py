"""COLMAP models and scenes, compared with pycolmap."""

import os
import shutil
import struct
import subprocess
import sys
import unicodedata
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from tests.training.scenes import synthetic
from training.errors import LodgsError
from training.scenes import colmap
from training.scenes import colmap_model as model_files
from training.scenes.colmap import exclude_views, find_models, read_scene
from training.scenes.lenses import make_intrinsics
from training.scenes.undistort import undistort_scene
from training.scenes.write_colmap import write_model

SCENES = ("fox", "saharov", "caliterra")
VARIANTS = (
    "mini_saharov",
    "multicam_subfolders",
    "distorted_simple_radial",
    "names_unicode_spaces",
    "missing_images",
    "empty_points3D",
    "flat_sparse",
)


def assert_same(scene: colmap.Scene, truth: pycolmap.Reconstruction, skipped: int = 0) -> None:
    """Compare views, poses, intrinsics, points and colours with pycolmap."""
    views = {image.name: image for image in truth.images.values()}
    assert [camera.name for camera in scene.cameras] == sorted(camera.name for camera in scene.cameras)
    assert len(scene.cameras) == len(views) - skipped
    for camera in scene.cameras:
        view = views[camera.name]
        assert camera.image is not None and camera.image.is_file()
        assert (camera.width, camera.height) == (view.camera.width, view.camera.height)
        np.testing.assert_allclose(
            [camera.fx, camera.fy, camera.cx, camera.cy],
            [
                view.camera.focal_length_x,
                view.camera.focal_length_y,
                view.camera.principal_point_x,
                view.camera.principal_point_y,
            ],
            rtol=1e-12,
        )
        np.testing.assert_allclose(camera.world_to_camera[:3], view.cam_from_world().matrix(), atol=1e-9)
        np.testing.assert_allclose(camera.center, view.projection_center(), atol=1e-9)
    points = np.array([point.xyz for point in truth.points3D.values()]).reshape(-1, 3).astype(np.float32)
    colors = np.array([point.color for point in truth.points3D.values()]).reshape(-1, 3)
    actual = np.hstack([scene.points, scene.point_colors])
    expected = np.hstack([points, colors]).astype(np.float32)
    np.testing.assert_array_equal(actual[np.lexsort(actual.T)], expected[np.lexsort(expected.T)])


@pytest.mark.parametrize("name", [*SCENES, *(f"variants/{variant}" for variant in VARIANTS)])
def test_real_scenes_match_pycolmap(shared_scenes, tmp_path, name):
    scene = read_scene(shared_scenes / name)
    truth = pycolmap.Reconstruction(str(scene.model))
    skipped = 5 if "missing" in name else 0
    warnings = {
        "variants/missing_images": 3,
        "variants/empty_points3D": 1,
    }  # one warning for all missing images
    assert len(scene.warnings) == warnings.get(name, 0)
    assert bool(scene.distorted) == ("distorted" in name)
    assert_same(scene, truth, skipped)

    truth.write_text(str(tmp_path))
    assert_same(read_scene(shared_scenes / name, model=tmp_path, images=scene.images_folder), truth, skipped)


@pytest.mark.parametrize("points", [0, 1, 2000])
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_synthetic_models_match_pycolmap(tmp_path, points, form):
    names = ["frame 1.png", "up/a  b #1.png", "Säule.png", "写真 02.png", "памятник%20.png"]
    truth = synthetic.write_scene(tmp_path, names=names, points=points)
    if form == "txt":
        shutil.rmtree(tmp_path / "sparse")
        (tmp_path / "sparse").mkdir()
        truth.write_text(str(tmp_path / "sparse"))
    scene = read_scene(tmp_path)
    assert len(scene.warnings) == (points == 0) and not scene.distorted
    assert_same(scene, truth)


def test_text_model_equals_binary_model(shared_scenes):
    folder = shared_scenes / "variants" / "names_unicode_spaces"
    binary, text = read_scene(folder), read_scene(folder, model=folder / "sparse_txt" / "0")
    assert [camera.name for camera in binary.cameras] == [camera.name for camera in text.cameras]
    np.testing.assert_allclose(binary.points, text.points, atol=1e-5)


@pytest.mark.parametrize("model", [*synthetic.PINHOLES, *synthetic.DISTORTION])
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_camera_models(tmp_path, model, form):
    truth = synthetic.write_scene(tmp_path, synthetic.camera(model), names=["a.png"], points=3)
    if form == "txt":
        truth.write_text(str(tmp_path / "sparse" / "0"))
        for file in (tmp_path / "sparse" / "0").glob("*.bin"):
            file.unlink()
    scene = read_scene(tmp_path)
    assert_same(scene, truth)
    assert scene.distorted == ([] if model in synthetic.PINHOLES else ["a.png"])


def test_all_camera_models_of_pycolmap_are_supported():
    supported = {number: (lens.name, lens.parameters) for number, lens in model_files.LENSES.items()}
    expected = {}
    for name, number in pycolmap.CameraModelId.__members__.items():
        if name != "INVALID":
            camera = pycolmap.Camera.create_from_model_id(1, number, 50.0, 64, 48)
            expected[int(number)] = name, len(camera.params)
    assert supported == expected


@pytest.mark.parametrize("model", [name for name in synthetic.DISTORTION if "FISHEYE" not in name])
def test_zero_distortion_is_a_pinhole(tmp_path, model):
    """pycolmap's camera projects like a pinhole, so the view is not distorted."""
    lens = synthetic.camera(
        model, [0.0, 1.0] if model == "EUCM" else [0.0] * len(synthetic.DISTORTION[model])
    )
    ray = np.array([0.4, -0.3, 1.0])
    np.testing.assert_allclose(
        lens.img_from_cam(ray),
        [47 + lens.focal_length_x * 0.4, 37 - lens.focal_length_y * 0.3],
        atol=1e-3,
    )
    synthetic.write_scene(tmp_path, lens, names=["a.png"], points=3)
    assert read_scene(tmp_path).distorted == []


@pytest.mark.parametrize("model", [name for name in synthetic.DISTORTION if "FISHEYE" in name])
def test_ideal_fisheye_is_distorted(tmp_path, model):
    lens = synthetic.camera(model, [0.0] * len(synthetic.DISTORTION[model]))
    synthetic.write_scene(tmp_path, lens, names=["a.png"], points=3)
    assert read_scene(tmp_path).distorted == ["a.png"]


def test_panorama_is_skipped(tmp_path):
    synthetic.write_scene(tmp_path, names=["a.png"], points=3)
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "cameras.txt").write_text(
        "1 PINHOLE 96 72 80 80 48 36\n2 EQUIRECTANGULAR 96 72 96 72\n"
    )
    (tmp_path / "text" / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 2 a.png\n\n")
    scene = read_scene(tmp_path, model=tmp_path / "text")
    assert len(scene.cameras) == 1
    assert any("panorama" in warning for warning in scene.warnings)
    assert any("points3D" in warning for warning in scene.warnings)
    (tmp_path / "text" / "images.txt").write_text("2 1 0 0 0 0 0 0 2 a.png\n\n")
    with pytest.raises(LodgsError, match="cut it into perspective views") as caught:
        read_scene(tmp_path, model=tmp_path / "text")
    assert "folder" not in caught.value.remedy


def test_text_model_of_other_programs(tmp_path):
    """No comments, Windows line ends, quaternions of other lengths, lines of 2D points."""
    synthetic.write_image(tmp_path / "images" / "my view.png", synthetic.noise())
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / "cameras.txt").write_bytes(b"3 SIMPLE_PINHOLE 96 72 80 48 36\r\n")
    (tmp_path / "sparse" / "images.txt").write_bytes(b"7 2 0 0 2 1 2 3 3 my view.png\r\n1.5 2.5 -1 3 4 9\r\n")
    (tmp_path / "sparse" / "points3D.txt").write_bytes(b"9 1 2 3 4 5 6 0.5 7 1\r\n8 -1 -2 -3 0 0 255 0.5\r\n")
    scene = read_scene(tmp_path)
    (camera,) = scene.cameras
    assert camera.name == "my view.png" and not scene.warnings
    # A quarter turn about z maps x to y.
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(camera.world_to_camera, expected, atol=1e-12)
    np.testing.assert_array_equal(scene.points, [[1, 2, 3], [-1, -2, -3]])
    np.testing.assert_array_equal(scene.point_colors, [[4, 5, 6], [0, 0, 255]])


def test_model_with_unknown_camera_or_without_views_is_rejected(tmp_path):
    synthetic.write_scene(tmp_path)
    model = tmp_path / "text"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 96 72 80 80 48 36\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 2 a.png\n\n")
    with pytest.raises(LodgsError, match="lacks camera 2"):
        read_scene(tmp_path, model=model)
    (model / "images.txt").write_text("")
    with pytest.raises(LodgsError, match="no registered images"):
        read_scene(tmp_path, model=model)


def test_extent_of_single_view_is_its_median_depth(tmp_path):
    synthetic.write_scene(tmp_path, names=["a.png"], points=2000)
    scene = read_scene(tmp_path)
    assert scene.extent() == scene.median_depth() > 0


def test_models_are_sorted_by_size_then_depth(tmp_path):
    for model, names in {
        "sparse/0": ["a.png"],
        "sparse/1": ["a.png", "b.png", "c.png"],
        "distorted/sparse/0": ["a.png", "b.png", "c.png"],
    }.items():
        synthetic.write_scene(tmp_path, names=names, model=model)
    relative = [path.relative_to(tmp_path).as_posix() for path in find_models(tmp_path)]
    assert relative == ["sparse/1", "distorted/sparse/0", "sparse/0"]
    scene = read_scene(tmp_path)
    assert scene.model == tmp_path / "sparse" / "1" and len(scene.cameras) == 3
    assert len(scene.warnings) == 1 and "sparse/0" in scene.warnings[0].replace(os.sep, "/")
    assert len(read_scene(tmp_path, model=tmp_path / "sparse" / "0").cameras) == 1


@pytest.mark.parametrize("model", [".", "sparse", "sparse/0", "colmap/sparse/0"])
@pytest.mark.parametrize("images", ["images", "input"])
def test_folder_layouts(tmp_path, model, images):
    synthetic.write_scene(tmp_path, model=model if model != "." else "x")
    if model == ".":
        for file in (tmp_path / "x").iterdir():
            file.rename(tmp_path / file.name)
    (tmp_path / "images").rename(tmp_path / images)
    scene = read_scene(tmp_path)
    assert scene.images_folder == tmp_path / images and len(scene.cameras) == 3
    if model.startswith("sparse"):  # the scene around a model folder is found
        assert read_scene(tmp_path / model).images_folder == tmp_path / images


def test_intrinsics_scale_with_image_size(tmp_path):
    synthetic.write_scene(tmp_path, names=["a.png", "b.png"])
    synthetic.write_image(tmp_path / "images" / "a.png", synthetic.noise(48, 36))
    synthetic.write_image(tmp_path / "images" / "b.png", synthetic.noise(72, 96))
    (half,) = read_scene(tmp_path).cameras
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (48, 36, 40, 41, 23.5, 18.5)
    warnings = read_scene(tmp_path).warnings
    assert len(warnings) == 1 and "b.png" in warnings[0] and "rotated" in warnings[0]


def test_unusable_photos_are_skipped_with_warnings(tmp_path):
    names = ["0.png", "absent.png", "cut.png", "empty.png", "folder.png", "text.png"]
    synthetic.write_scene(tmp_path, names=names)
    images = tmp_path / "images"
    (images / "absent.png").unlink()
    (images / "cut.png").write_bytes((images / "0.png").read_bytes()[:-20])
    (images / "empty.png").write_bytes(b"")
    (images / "text.png").write_bytes(b"not an image")
    (images / "folder.png").unlink()
    (images / "folder.png").mkdir()
    scene = read_scene(tmp_path)
    assert [camera.name for camera in scene.cameras] == ["0.png"]
    *skipped, missing = scene.warnings
    assert [warning.split()[1] for warning in skipped] == ["cut.png:", "empty.png:", "text.png:"]
    assert missing.startswith("Skipped 2 views") and "absent.png, folder.png" in missing


def test_missing_images_of_real_scene(shared_scenes):
    scene = read_scene(shared_scenes / "variants" / "missing_images")
    missing = [f"IMG_{number}.jpg" for number in (3026, 3028, 3031, 3033, 3044)]
    assert all(any(name in warning for warning in scene.warnings) for name in missing)
    assert not {camera.name for camera in scene.cameras} & {*missing, "not_in_model.jpg"}


def test_names_match_other_unicode_forms_and_backslashes(tmp_path):
    truth = synthetic.write_scene(tmp_path, names=["é/Säule.png"])
    decomposed = tmp_path / "images" / unicodedata.normalize("NFD", "é")
    (tmp_path / "images" / "é").rename(decomposed)
    assert len(read_scene(tmp_path).cameras) == 1
    truth.write_text(str(tmp_path / "sparse"))
    path = tmp_path / "sparse" / "images.txt"
    path.write_text(path.read_text(encoding="utf-8").replace("é/", "é\\"), encoding="utf-8")
    scene = read_scene(tmp_path, model=tmp_path / "sparse")
    assert [camera.name for camera in scene.cameras] == ["é/Säule.png"]


def test_overlong_name_is_skipped(tmp_path):
    truth = synthetic.write_scene(tmp_path, names=["a.png", "b.png"])
    truth.write_text(str(tmp_path))
    text = (tmp_path / "images.txt").read_text()
    (tmp_path / "images.txt").write_text(text.replace("b.png", 300 * "b"))
    scene = read_scene(tmp_path, model=tmp_path)
    assert len(scene.cameras) == 1 and "no such file" in scene.warnings[0]


def test_names_cannot_leave_the_image_folder(tmp_path):
    synthetic.write_scene(tmp_path, names=["a.png", "../secret.png"])
    scene = read_scene(tmp_path)
    assert len(scene.cameras) == 1 and "has no such file" in scene.warnings[0]


@pytest.mark.parametrize("cut", [0, 4, 8, 20, 51, 60, -1, -30])
@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_model_is_rejected(tmp_path, file, cut):
    synthetic.write_scene(tmp_path)
    path = tmp_path / "sparse" / "0" / file
    content = path.read_bytes()
    path.write_bytes(content[:cut])
    with pytest.raises(LodgsError) as error:
        read_scene(tmp_path)
    assert str(path) in error.value.what and error.value.remedy


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt"])
@pytest.mark.parametrize("damage", ["missing line", "letters"])
def test_damaged_text_model_is_rejected(tmp_path, file, damage):
    truth = synthetic.write_scene(tmp_path)
    model = tmp_path / "text"
    model.mkdir()
    truth.write_text(str(model))
    lines = (model / file).read_text().splitlines(keepends=True)
    if damage == "letters":
        lines = [line if line.startswith("#") else "1 x y z PINHOLE\n" for line in lines]
    else:
        lines = lines[: -2 if file == "images.txt" else -1]
    (model / file).write_text("".join(lines))
    with pytest.raises(LodgsError) as error:
        read_scene(tmp_path, model=model)
    assert str(model / file) in error.value.what and error.value.remedy


def test_random_bytes_raise_no_other_exceptions(tmp_path):
    """A model with changed bytes is read or rejected with a LodgsError."""
    synthetic.write_scene(tmp_path)
    random = np.random.default_rng(0)
    for file in sorted((tmp_path / "sparse" / "0").glob("*.bin")):
        content = np.frombuffer(file.read_bytes(), np.uint8)
        for _ in range(60):
            damaged = content.copy()
            damaged[random.integers(0, len(content), 3)] = random.integers(0, 256, 3)
            file.write_bytes(damaged.tobytes())
            try:
                scene = read_scene(tmp_path)
            except LodgsError:
                continue
            assert np.isfinite(scene.points).all()
        file.write_bytes(content.tobytes())


def test_missing_files_are_reported(tmp_path):
    with pytest.raises(LodgsError, match="absent"):
        read_scene(tmp_path / "absent")
    with pytest.raises(LodgsError, match="no COLMAP model"):
        read_scene(tmp_path)
    synthetic.write_scene(tmp_path)
    with pytest.raises(LodgsError, match=r"image folder .* does not exist"):
        read_scene(tmp_path, images=tmp_path / "nowhere")
    with pytest.raises(LodgsError, match="no cameras and images"):
        read_scene(tmp_path, model=tmp_path / "images")
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(LodgsError, match=r"image folder .* does not exist"):
        read_scene(tmp_path)
    (tmp_path / "images").mkdir()
    with pytest.raises(LodgsError, match="none of the 3 views"):
        read_scene(tmp_path)


def test_point_records_among_zeros():
    """Every offset looks like the start of a record; only the chain of lengths is unambiguous."""
    random = np.random.default_rng(1)
    lengths = random.integers(0, 40, 3000)
    records = [struct.pack("<Q3d3BdQ", 0, 0, 0, 0, 0, 0, 0, 0, n) + bytes(8 * int(n)) for n in lengths]
    starts = model_files._point_starts(np.frombuffer(b"".join(records), np.uint8), len(records))
    np.testing.assert_array_equal(starts, np.concatenate([[0], np.cumsum(51 + 8 * lengths)[:-1]]))


def test_split_extent_and_median_depth(tmp_path):
    """Nine cameras on a line look along z at points of known depths."""
    synthetic.write_scene(tmp_path, names=[f"{i}.png" for i in range(9)], points=0)
    model = tmp_path / "text"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 96 72 48 48 48 36\n")
    (model / "images.txt").write_text("".join(f"{i} 1 0 0 0 {-i} 0 0 1 {i}.png\n\n" for i in range(9)))
    # Three points in front of all cameras, one behind them, one outside all images.
    points = [(4, 0, 20), (4, 0, 30), (4, 0, 100), (4, 0, -1), (400, 0, 1)]
    (model / "points3D.txt").write_text(
        "".join(f"{i} {x} {y} {z} 1 2 3 0\n" for i, (x, y, z) in enumerate(points))
    )
    scene = read_scene(tmp_path, model=model)
    assert scene.extent() == pytest.approx(1.1 * 4)
    assert scene.median_depth() == 30
    train, test = scene.split(8)
    assert [camera.name for camera in test] == ["0.png", "8.png"]
    assert [camera.name for camera in train] == [f"{i}.png" for i in range(1, 8)]
    assert [len(cameras) for cameras in scene.split(0)] == [9, 0]
    train, held_out = scene.split(8, validation=True)  # excludes 0 and 8
    assert [camera.name for camera in held_out] == ["4.png"]
    assert [camera.name for camera in train] == [f"{i}.png" for i in (1, 2, 3, 5, 6, 7)]


@pytest.mark.parametrize("lens", ["PINHOLE", "SIMPLE_RADIAL"])
def test_lost_photo_does_not_change_the_split_of_other_photos(tmp_path, lens):
    synthetic.write_scene(tmp_path, lens=synthetic.camera(lens), names=[f"{i}.png" for i in range(9)])
    (tmp_path / "images" / "1.png").unlink()
    scene = read_scene(tmp_path)
    scene = undistort_scene(scene, tmp_path / "cache") if scene.distorted else scene
    for variant in (scene, exclude_views(scene, {"4.png": "it is damaged."})):
        train, test = variant.split(4)
        names = [camera.name for camera in test]
        assert names == [
            name for name in ("0.png", "4.png", "8.png") if name in {c.name for c in variant.cameras}
        ]
        assert [camera.name for camera in train] == [f"{i}.png" for i in (2, 3, 5, 6, 7)]


def test_median_depth_needs_points(tmp_path):
    synthetic.write_scene(tmp_path, points=0)
    with pytest.raises(LodgsError, match="sees a point"):
        read_scene(tmp_path).median_depth()


def test_reading_loads_no_trainer_library():
    """Blender's Python has only numpy."""
    import subprocess
    import sys

    code = (
        "import sys, training.scenes.colmap, training.scenes.orientation, training.scenes.images;"
        "print(*{'torch', 'numba', 'PIL', 'pycolmap', 'OpenEXR', 'scipy'} & set(sys.modules))"
    )
    root = Path(__file__).parents[3]
    assert subprocess.check_output([sys.executable, "-c", code], cwd=root, text=True).strip() == ""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps mapped files")
@pytest.mark.parametrize(("file", "function"), [("images.bin", "_pose"), ("points3D.bin", "_record_chain")])
def test_model_that_another_program_truncates_is_reported(tmp_path, file, function):
    """A process of its own, because reading beyond the end of a mapped file ends it."""
    model, lens = tmp_path / "model", make_intrinsics("PINHOLE", 40, 30, np.array([50.0, 50, 20, 15]))
    poses = [(f"{number:06}.png", np.eye(4)) for number in range(100)]
    write_model(model, [lens] * 100, poses, np.zeros((9000, 3)), np.zeros((9000, 3), np.uint8))
    program = """
import os, sys
from pathlib import Path
from training.errors import LodgsError
from training.scenes import colmap_model

model, file, name = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
function = getattr(colmap_model, name)

def truncate(*arguments):
    result = function(*arguments)
    os.truncate(model / file, 100)
    return result

setattr(colmap_model, name, truncate)
try:
    colmap_model.read_poses(model)
    colmap_model.read_points(model)
except LodgsError as error:
    print(error)
"""
    command = [sys.executable, "-c", program, model, file, function]
    process = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True)
    assert "another program has truncated it" in process.stdout, process
