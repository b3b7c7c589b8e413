"""Other programs' exports, written from their documentation and compared with pycolmap's projections."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.depths import DepthPriors, add_depth_points
from training.scenes.formats import convert_export, find_exports, transforms
from training.scenes.point_cloud import read_points
from training.scenes.triangulate import random_start_points
from training.splats.georeference import Georeference

from .depth_walls import write_png_map
from .export_helpers import (
    CENTER,
    FOCAL,
    HEIGHT,
    LENS,
    NAMES,
    POINTS,
    WIDTH,
    check,
    opencv,
    pixels,
    poses,
    project,
    write_photos,
)
from .synthetic import write_image


def write_transforms(folder: Path, change=lambda document: None, **values) -> None:
    write_photos(folder / "images")
    document = {
        "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL[0], "fl_y": FOCAL[1], "cx": CENTER[0], "cy": CENTER[1],
        **values,
        "frames": [
            {"file_path": f"./images/{name}", "transform_matrix": pose.tolist()}
            for name, pose in zip(NAMES, poses(), strict=True)
        ],
    }  # fmt: skip
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))


def test_nerfstudio_with_distortion_and_points(tmp_path):
    points = "\n".join(f"{x:.6f} {y:.6f} {z:.6f} 250 20 30" for x, y, z in POINTS)
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    colors = "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    (tmp_path / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 40\n{axes}{colors}end_header\n{points}\n"
    )
    write_transforms(tmp_path, camera_model="OPENCV", ply_file_path="points.ply", **LENS)
    scene = convert_export(tmp_path)
    assert (scene.views, scene.points, scene.warnings) == (3, 40, [])
    check(tmp_path, [pixels(*opencv(*project(pose), **LENS)) for pose in poses()])
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(scene.points, POINTS, atol=1e-5)
    assert (scene.point_colors == (250, 20, 30)).all() and len(scene.distorted) == 3


@pytest.mark.parametrize("key", ["K", "intrinsics", "camera_matrix", "distortion", "dist_coeffs"])
@pytest.mark.parametrize("value", [[[1, 2], [3]], [1, "a", None, {}], "abc"])
def test_malformed_lenses_exclude_their_frame(tmp_path, key, value):
    write_transforms(tmp_path, lambda document: document["frames"][0].update({key: value}))
    scene = convert_export(tmp_path)
    assert scene.views == 2 and NAMES[0] in scene.warnings[0]


def test_names_of_endless_folders_are_bounded(tmp_path):
    write_transforms(tmp_path, lambda document: document["frames"][0].update(file_path="a/" * 20_000 + "b"))
    scene = convert_export(tmp_path)
    assert scene.views == 2 and len(scene.warnings[0]) < 1500


def test_nerfstudio_fisheye(tmp_path):
    k = {"k1": 0.05, "k2": -0.02, "k3": 0.003, "k4": -0.001}
    write_transforms(tmp_path, camera_model="OPENCV_FISHEYE", **k)
    convert_export(tmp_path)
    expected = []
    for pose in poses():
        x, y = project(pose)
        r = np.hypot(x, y)
        theta = np.arctan(r)
        distorted = theta * (1 + sum(value * theta ** (2 * n) for n, value in enumerate(k.values(), 1)))
        expected.append(pixels(x * distorted / r, y * distorted / r))
    check(tmp_path, expected)


def test_values_of_a_frame_override_common_values(tmp_path):
    def change(document):
        document["frames"][1] |= {"fl_x": 160.0, "fl_y": 164.0}

    write_transforms(tmp_path, change)
    convert_export(tmp_path)
    first, second, third = (pixels(*project(pose)) for pose in poses())
    second = (second - CENTER) * 2 + CENTER
    check(tmp_path, [first, second, third])


def test_nerf_synthetic_with_names_without_suffix_and_field_of_view(tmp_path):
    write_photos(tmp_path / "train", ("r_0.png", "r_1.png", "r_2.png"))
    write_photos(tmp_path / "test", ("r_0.png",))
    angle = 2 * np.arctan(0.5 * WIDTH / 80.0)
    for name, count in (("train", 3), ("test", 1)):
        frames = [
            {"file_path": f"./{name}/r_{n}", "rotation": 0.01, "transform_matrix": pose.tolist()}
            for n, pose in enumerate(poses()[:count])
        ]
        document = {"camera_angle_x": angle, "frames": frames}
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps(document))
    scene = convert_export(tmp_path)
    (warning,) = scene.warnings
    assert scene.points == 0 and "without those of transforms_test.json" in warning
    names = "train/r_0.png", "train/r_1.png", "train/r_2.png"
    check(tmp_path, [pixels(*project(p), (80, 80), (WIDTH / 2, HEIGHT / 2)) for p in poses()], names)


def test_polycam(tmp_path):
    names = "11.jpg", "12.jpg", "13.jpg"
    for name, pose in zip(("11", "12", "13", "14"), [*poses(), poses()[0]], strict=True):
        camera = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTER[0], "cy": CENTER[1]}
        camera |= {"width": WIDTH, "height": HEIGHT, "blur_score": 3.0 if name == "14" else 90.0}
        (tmp_path / "keyframes" / "corrected_cameras").mkdir(parents=True, exist_ok=True)
        (tmp_path / "keyframes" / "corrected_cameras" / f"{name}.json").write_text(json.dumps(camera))
    write_photos(tmp_path / "keyframes" / "corrected_images", (*names, "14.jpg"))
    write_png_map(tmp_path / "keyframes" / "depth" / "12.png", np.full((HEIGHT, WIDTH), 2000))
    scene = convert_export(tmp_path)
    assert "14.json" in scene.warnings[0] and "blurred" in scene.warnings[0]
    assert [camera.depth is not None for camera in read_scene(tmp_path).cameras] == [False, True, False]
    names = [f"keyframes/corrected_images/{name}" for name in names]
    check(tmp_path, [pixels(*project(pose)) for pose in poses()], names)


def test_polycam_with_only_blurred_photos(tmp_path):
    """All are used: the user may have no better ones."""
    for name, pose in zip(("11", "12", "13"), poses(), strict=True):
        camera = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": FOCAL[0], "fy": FOCAL[1], "width": WIDTH, "height": HEIGHT, "blur_score": 20.0}
        (tmp_path / "keyframes" / "cameras").mkdir(parents=True, exist_ok=True)
        (tmp_path / "keyframes" / "cameras" / f"{name}.json").write_text(json.dumps(camera))
    write_photos(tmp_path / "keyframes" / "images", ("11.jpg", "12.jpg", "13.jpg"))
    assert "rates all photos as blurred" in convert_export(tmp_path).warnings[0]
    assert len(read_scene(tmp_path).cameras) == 3


def test_record3d(tmp_path):
    names = "2.jpg", "9.jpg", "10.jpg"  # in numeric order
    write_photos(tmp_path / "rgb", names)
    rows = []
    for pose in poses():
        x, y, z, w = pycolmap.Rotation3d(pose[:3, :3]).quat
        rows.append([x, y, z, w, *pose[:3, 3]])
    (tmp_path / "metadata").write_text(json.dumps({
        "poses": rows, "K": [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTER, 1], "w": WIDTH, "h": HEIGHT,
    }))  # fmt: skip
    convert_export(tmp_path)
    check(tmp_path, [pixels(*project(pose)) for pose in poses()], names)


def test_record3d_with_missing_photos(tmp_path):
    """Poses are matched by the photos' numbers, not by their order."""
    write_photos(tmp_path / "rgb", ("1.jpg", "2.jpg"))
    rows = [[*pycolmap.Rotation3d(pose[:3, :3]).quat, *pose[:3, 3]] for pose in poses()]
    values = {"poses": rows, "K": [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTER, 1], "w": WIDTH, "h": HEIGHT}
    (tmp_path / "metadata").write_text(json.dumps(values))
    assert convert_export(tmp_path).warnings[0] == "Skipped frame 0: it has no photo."
    check(tmp_path, [pixels(*project(pose)) for pose in poses()[1:]], ("1.jpg", "2.jpg"))
    (tmp_path / "sparse").rename(tmp_path / "old")
    (tmp_path / "rgb" / "1.jpg").rename(tmp_path / "rgb" / "one.jpg")
    with pytest.raises(LodgsError, match="it has 3 poses, but"):
        convert_export(tmp_path)


def test_bundler(tmp_path):
    names = "a.jpg", "b 2.jpg", "c.jpg"
    write_photos(tmp_path, names)
    (tmp_path / "list.txt").write_text("./a.jpg\n./b 2.jpg 0 80.0\nc.jpg\n")
    lines = ["# Bundle file v0.3", f"3 {len(POINTS)}"]
    for pose in poses():
        inverse = np.linalg.inv(pose)
        lines += ["80.0 0.05 -0.01", *(" ".join(map(repr, row)) for row in inverse[:3, :3].tolist())]
        lines.append(" ".join(map(repr, inverse[:3, 3].tolist())))
    for number, point in enumerate(POINTS):
        lines += [" ".join(map(repr, point.tolist())), f"{number} 200 7"]
        lines.append(" ".join([str(number % 3), *["0 1 2.5 -3.5"] * (number % 3)]))
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "bundle.out").write_text("\n".join(lines) + "\n")
    scene = convert_export(tmp_path)
    assert (scene.points, scene.warnings) == (40, [])
    expected = []
    for pose in poses():
        x, y = project(pose)
        factor = 1 + 0.05 * (x * x + y * y) - 0.01 * (x * x + y * y) ** 2
        expected.append(pixels(x * factor, y * factor, (80, 80), (WIDTH / 2, HEIGHT / 2)))
    check(tmp_path, expected, names)
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(scene.points + scene.origin, POINTS, atol=1e-5)
    np.testing.assert_array_equal(scene.point_colors[:, 0], np.arange(40))


@pytest.mark.parametrize("lens", ["pinhole", "disto_k3", "disto_t2"])
def test_openmvg(tmp_path, lens):
    names = "a.jpg", "b.jpg", "c.jpg"
    write_photos(tmp_path / "images", names)
    values = {"width": WIDTH, "height": HEIGHT, "focal_length": 80.0, "principal_point": list(CENTER)}
    distortion = {"k1": 0.1, "k2": -0.02, "k3": 0.01} if lens != "pinhole" else {}
    if lens == "disto_t2":
        distortion |= {"p1": 0.005, "p2": -0.004}
    if distortion:
        values = {"value0": values, lens: list(distortion.values())}

    def listed(entries):
        return [
            {"key": key, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": 2, "data": value}}}
            for key, value in entries
        ]

    views = [
        {"local_path": "", "filename": name, "width": WIDTH, "height": HEIGHT, "id_view": n,
         "id_intrinsic": 0, "id_pose": n}
        for n, name in enumerate(names)
    ]  # fmt: skip
    extrinsics = [
        {"key": n, "value": {
            "rotation": (pose[:3, :3] @ np.diag([1, -1, -1])).T.tolist(), "center": pose[:3, 3].tolist(),
        }}
        for n, pose in enumerate(poses())
    ]  # fmt: skip
    structure = [{"key": n, "value": {"X": point.tolist()}} for n, point in enumerate(POINTS)]
    (tmp_path / "sfm_data.json").write_text(json.dumps({
        "sfm_data_version": "0.3", "root_path": "/nowhere", "views": listed(enumerate(views)),
        "intrinsics": listed([(0, values)]), "extrinsics": extrinsics, "structure": structure,
    }))  # fmt: skip
    assert convert_export(tmp_path).points == 40
    check(
        tmp_path,
        [pixels(*opencv(*project(pose), **distortion), (80, 80)) for pose in poses()],
        names,
    )


def test_lens_scales_with_the_photos(tmp_path):
    write_transforms(tmp_path)
    write_photos(tmp_path / "images", size=(WIDTH // 2, HEIGHT // 2))
    convert_export(tmp_path)
    check(tmp_path, [pixels(*project(pose)) / 2 for pose in poses()])


def test_output_folder_gets_links_and_source_stays_unchanged(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    write_transforms(source)
    files = sorted(source.rglob("*"))
    assert main(["scene", "--from", str(source), "--out", str(out)]) == 0
    assert sorted(source.rglob("*")) == files
    assert {path.name for path in (out / "images").iterdir()} == set(NAMES)
    check(out, [pixels(*project(pose)) for pose in poses()])
    with pytest.raises(LodgsError, match="already holds a COLMAP scene"):
        convert_export(source, out)


def test_other_photos_in_the_output_folder_are_not_used(tmp_path):
    write_transforms(tmp_path / "export")
    write_photos(tmp_path / "out" / "images", NAMES[:1], (30, 20))
    with pytest.raises(LodgsError, match=r"another file has this name \(.*first\.png\)") as error:
        convert_export(tmp_path / "export", tmp_path / "out")
    assert "Choose another output folder" in error.value.remedy
    (tmp_path / "out" / "images" / NAMES[0]).unlink()
    assert convert_export(tmp_path / "export", tmp_path / "out").views == 3


@pytest.mark.parametrize("in_place", [False, True])
def test_place_on_earth_beside_an_export_is_kept(tmp_path, in_place):
    source, out = tmp_path / "source", tmp_path / "out"
    write_transforms(source)
    (source / "map.prj").write_text('PROJCS["WGS 84 / UTM zone 31N"]')
    convert_export(source, None if in_place else out)
    place = read_scene(source if in_place else out).georeference
    assert place is not None and place.crs.startswith("PROJCS")


@pytest.mark.parametrize("in_place", [False, True])
def test_georeference_of_the_user_replaces_that_of_the_export(tmp_path, monkeypatch, in_place):
    source, out = tmp_path / "source", tmp_path / "out"
    write_transforms(source)
    read, other = transforms.read, Georeference("EPSG:4978", np.eye(4))
    monkeypatch.setattr(transforms, "read", lambda *paths: replace(read(*paths), georeference=other))
    (source / "georeference.json").write_text('{"crs": "EPSG:32631"}')
    convert_export(source, None if in_place else out)
    place = read_scene(source if in_place else out).georeference
    assert place is not None and place.crs == "EPSG:32631"


def test_masks_are_linked(tmp_path):
    def change(document):
        document["frames"][1]["mask_path"] = "black/b.png"

    write_transforms(tmp_path, change)
    write_photos(tmp_path / "black", ["b.png"])
    convert_export(tmp_path)
    masks = [camera.mask for camera in read_scene(tmp_path).cameras]
    assert masks == [None, tmp_path / "masks" / "second photo.png.png", None]


def test_depth_maps_are_linked_and_add_points(tmp_path):
    """nerfstudio's maps are in millimetres and show a wall in front of each camera."""

    def change(document):
        for number, frame in enumerate(document["frames"]):
            frame["depth_file_path"] = f"deep/{number}.png"

    write_transforms(tmp_path, change)
    for number in range(3):
        write_png_map(tmp_path / "deep" / f"{number}.png", np.full((HEIGHT // 2, WIDTH // 2), 3000 + number))
    scene = convert_export(tmp_path)
    assert scene.points == 0 and "from the depth maps" in scene.warnings[-1]
    scene = read_scene(tmp_path)
    assert [camera.depth for camera in scene.cameras] == [
        tmp_path / "depths" / f"{name}.png" for name in NAMES
    ]
    result = add_depth_points(scene)
    for number, camera in enumerate(scene.cameras):
        inverse = DepthPriors(scene, "metric").inverse(camera)
        np.testing.assert_allclose(inverse, 1 / (3 + 0.001 * number), rtol=1e-5)
    depths = np.stack([camera.view_space(result.points)[:, 2] for camera in scene.cameras])
    assert (np.abs(depths - [[3.0], [3.001], [3.002]]).min(axis=0) < 1e-4).all() and len(result.points) > 5000


def test_unsupported_depth_maps_are_ignored(tmp_path):
    def change(document):
        for frame in document["frames"]:
            frame["depth_file_path"] = "depth.npz"

    write_transforms(tmp_path, change)
    (tmp_path / "depth.npz").write_bytes(b"numbers")
    assert convert_export(tmp_path).warnings == []
    assert not (tmp_path / "depths").exists()


def test_random_points_are_visible_in_two_views(tmp_path):
    write_transforms(tmp_path)
    convert_export(tmp_path)
    cameras = read_scene(tmp_path).cameras
    points = random_start_points(cameras)
    assert (sum(camera.sees(points).astype(int) for camera in cameras) >= 2).all()
    assert np.linalg.norm(points.mean(axis=0)) < 0.5  # around the common target


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(frames=[]), "has no frames"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "camera model EQUIRECTANGULAR"),
        (lambda d: [d.pop("fl_x"), d.pop("fl_y")], "neither a focal length"),
        (lambda d: [f.update(transform_matrix=[[1, 2], [3]]) for f in d["frames"]], "Nx4 finite numbers"),
        (lambda d: [f.update(transform_matrix=[[0, 0, 0, 0]] * 4) for f in d["frames"]], "not a rotation"),
        (lambda d: d.update(k4=0.3), "its k4"),
        (lambda d: [f.update(file_path="../secret") for f in d["frames"]], "secret"),
    ],
)
def test_invalid_files_are_reported_and_nothing_is_written(tmp_path, damage, message, capsys):
    write_transforms(tmp_path, damage)
    assert main(["scene", "--from", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("sparse/*"))


def test_rotated_photos_are_skipped(tmp_path):
    """Their aspect ratio does not match the lens."""
    write_transforms(tmp_path)
    write_image(tmp_path / "images" / NAMES[0], np.full((WIDTH, HEIGHT, 3), 90, np.uint8))
    scene = convert_export(tmp_path)
    assert scene.views == 2
    assert scene.warnings[0].startswith(f"Skipped {NAMES[0]}: its size 72x96")


def test_masks_of_instant_ngp_give_a_warning(tmp_path):
    """Its docs/nerf_dataset_tips.md: non-zero pixels are masked away."""
    write_transforms(tmp_path)
    stem = Path(NAMES[0]).stem
    write_image(tmp_path / "images" / f"dynamic_mask_{stem}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    (warning,) = convert_export(tmp_path).warnings
    assert f"dynamic_mask_{stem}.png" in warning and "Invert" in warning


@pytest.mark.parametrize("others", [[], ["transform_test.json", "transform_val.json"]])
def test_other_names_of_transforms(tmp_path, others):
    """As a data set of Brush's issue 41 has them."""
    write_transforms(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "transform_train.json")
    for name in others:
        (tmp_path / name).write_text("{}")
    assert convert_export(tmp_path).views == 3


def test_missing_files_give_warnings(tmp_path):
    def remove(document):
        document.update(ply_file_path="nowhere.ply", camera_model=None)
        document["frames"][1].update(mask_path="masks/nowhere.png", k1=None)
        document["frames"][2]["file_path"] = "images/third.JPG"  # the file is a PNG

    write_transforms(tmp_path, remove)
    scene = convert_export(tmp_path)
    assert scene.views == 3 and len(scene.warnings) == 2
    assert "nowhere.ply" in scene.warnings[0]
    assert scene.warnings[1].startswith("1 masks are missing, such as")
    check(tmp_path, [pixels(*project(pose)) for pose in poses()])


def test_invalid_frame_is_skipped(tmp_path):
    write_transforms(tmp_path, lambda d: d["frames"][0].pop("transform_matrix"))
    scene = convert_export(tmp_path)
    assert scene.views == 2 and "Skipped" in scene.warnings[0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<document><chunk>",
        "<document><chunk/></document>",
        "<!DOCTYPE a [<!ENTITY b 'c'>]><document><chunk>",
    ],
)
def test_damaged_xml_is_rejected(tmp_path, text):
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(LodgsError):
        convert_export(tmp_path)


def test_export_in_a_subfolder(tmp_path):
    """Unpacking an archive often adds a folder level."""
    write_transforms(tmp_path / "scan" / "scan")
    scene = convert_export(tmp_path / "scan")
    assert scene.views == 3
    names = [f"scan/images/{name}" for name in NAMES]
    check(tmp_path / "scan", [pixels(*project(pose)) for pose in poses()], names)
    write_transforms(tmp_path / "two" / "a")
    write_transforms(tmp_path / "two" / "b")
    assert len(find_exports(tmp_path / "two")) == 2


def test_folders_without_export_are_rejected(tmp_path):
    assert not find_exports(tmp_path)
    with pytest.raises(LodgsError, match="its format is unknown"):
        convert_export(tmp_path)
    with pytest.raises(LodgsError, match="does not exist"):
        convert_export(tmp_path / "nowhere")
    write_transforms(tmp_path)
    convert_export(tmp_path)
    with pytest.raises(LodgsError, match=r"sparse.0 already holds a model\. Use the folder as it is"):
        convert_export(tmp_path)
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "sparse" / "0" / "points3D.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 1\n"
    )
    with pytest.raises(LodgsError, match="already is a COLMAP scene"):
        convert_export(tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        "[]", "{}", '[{"shots": 1}]', '[{"shots": {"a.jpg": 1}}]', "7", "",
        '[{"cameras": {}, "shots": {"a.jpg": {}}, "points": {"1": {"coordinates": [0, 0, 5], "color": []}}}]',
    ],
)  # fmt: skip
def test_damaged_reconstructions_of_opensfm_are_rejected(tmp_path, content):
    (tmp_path / "reconstruction.json").write_text(content)
    with pytest.raises(LodgsError, match=r"reconstruction\.json"):
        convert_export(tmp_path)


@pytest.mark.parametrize(
    ("files", "reason", "remedy"),
    [
        (["scan.r3d"], "scan.r3d is a packed Record3D file", "Unpack it"),
        (
            ["Registration.CSV", "a.jpg"],
            "Registration.CSV is a table",
            "Internal/External",
        ),
        (["a.jpg", "a.xmp"], "a.xmp is data of a photo", "Internal/External"),
        (["IMG_1.HEIC", "IMG_2.HEIC"], "IMG_1.HEIC is a HEIC photo", "Convert the photos to JPEG"),
        (["clip.MOV"], "clip.MOV is a video", "lodgs frames"),
        (["poses_bounds.npy", "a.jpg"], "poses_bounds.npy is a file of LLFF", "COLMAP model"),
        (["frames/a.png"], "it has photos, but no cameras", "lodgs scene --photos"),
        (["blocks.xml", "a.jpg"], "another program than Metashape", "COLMAP or Bundler"),
        (["sfm_data.bin", "images/a.jpg"], "binary file of OpenMVG", "sfm_data.json"),
        (["cloud.e57"], "point cloud without cameras", "lodgs scene --photos"),
        (["images/a.HEIC"], "photos have an unsupported format", "Convert the photos to JPEG"),
        (["dataparser_transforms.json"], "output of a 3DGS program", "trained from"),
        (["project.psx"], "project.psx is a Metashape project", "Export Cameras"),
        (
            ["database.db", "images/a.jpg"],
            "COLMAP database without a model",
            "Choose the folder of the model",
        ),
        (["point_cloud/iteration_7/a.ply"], "output of a 3DGS program", "Choose the scene"),
        (["images/a.JPG", "Thumbs.db"], "it has photos, but no cameras", "lodgs scene --photos"),
        ([".hidden.csv"], "its format is unknown", "Choose an export of nerfstudio"),
    ],
)
def test_folders_of_other_programs_get_a_remedy(tmp_path, files, reason, remedy):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(LodgsError) as error:
        convert_export(tmp_path)
    assert reason in error.value.what and remedy in error.value.remedy


def test_point_clouds_with_impossible_headers_are_rejected_quickly(tmp_path):
    """Rows beyond the end of the file, and lists of faces after the points, which are not read."""

    def write(rows: int, faces: int) -> Path:
        path = tmp_path / "points.ply"
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        lists = f"element face {faces}\nproperty list uchar int vertex_indices\n" if faces else ""
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex {rows}\n{axes}{lists}end_header\n0 1 2\n3 4 5\n"
        )
        return path

    points, _ = read_points(write(2, 20_000_000))
    assert points.tolist() == [[0, 1, 2], [3, 4, 5]]
    for rows in (3, 2**40, 2**70):
        with pytest.raises(LodgsError, match=r"points\.ply"):
            read_points(write(rows, 0))
