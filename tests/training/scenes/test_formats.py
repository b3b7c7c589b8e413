"""Other programs' exports, written here by what their makers say of them, against what COLMAP makes of them.

Truth is where a point falls on a photograph: by the program's own formula here, in ``ours`` by pycolmap.
"""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.scenes.colmap import read_scene
from training.scenes.colmap_model import rotation_matrix
from training.scenes.depths import DepthPriors, add_depth_points
from training.scenes.formats import convert_export, find_export, random_start_points

from .depth_walls import grey
from .synthetic import write_image

WIDTH, HEIGHT, FOCAL, CENTER = 96, 72, (80.0, 82.0), (47.0, 37.0)
NAMES = "first.png", "second photo.png", "third.png"
POINTS = np.random.default_rng(3).uniform(-0.4, 0.4, (40, 3))
LENS = {"k1": 0.1, "k2": -0.02, "p1": 0.005, "p2": -0.004}


def poses() -> list[np.ndarray]:
    """camera-to-world (4, 4), OpenGL axes, of views that look at the origin from about 3 away."""
    found = []
    for angle in (0.0, 0.9, 2.2):
        back = np.array([np.cos(angle), np.sin(angle), 0.3])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = 3 * back
        found.append(pose)
    return found


def seen(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where POINTS are before an OpenGL camera, divided by the depth: x to the right, y down."""
    local = (POINTS - pose[:3, 3]) @ pose[:3, :3]
    return local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2]


def opencv(x, y, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """OpenCV's lens (docs.opencv.org, calib3d)."""
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
    )


def pixels(x, y, focal=FOCAL, center=CENTER):
    return np.stack([focal[0] * x + center[0], focal[1] * y + center[1]], axis=1)


def photographs(folder: Path, names=NAMES, size=(WIDTH, HEIGHT)) -> None:
    for name in names:
        write_image(folder / name, np.full((size[1], size[0], 3), 90, np.uint8))


def ours(scene: Path, points=POINTS) -> dict[str, np.ndarray]:
    """Where pycolmap says that POINTS are on each photograph."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    return {
        image.name: np.array([image.project_point(point) for point in points])
        for image in model.images.values()
    }


def check(scene: Path, expected: list[np.ndarray], names=NAMES, atol=1e-3) -> None:
    found = ours(scene)
    assert sorted(found) == sorted(names)
    for name, where in zip(names, expected, strict=True):
        np.testing.assert_allclose(found[name], where, atol=atol)
    assert len(read_scene(scene).cameras) == len(names)


def write_transforms(folder: Path, change=lambda document: None, **told) -> None:
    photographs(folder / "images")
    document = {
        "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL[0], "fl_y": FOCAL[1], "cx": CENTER[0], "cy": CENTER[1], **told,
        "frames": [
            {"file_path": f"./images/{name}", "transform_matrix": pose.tolist()}
            for name, pose in zip(NAMES, poses(), strict=True)
        ],
    }  # fmt: skip
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))


def test_nerfstudio_with_a_lens_and_points(tmp_path):
    cloud = "\n".join(f"{x:.6f} {y:.6f} {z:.6f} 250 20 30" for x, y, z in POINTS)
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    colors = "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    (tmp_path / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 40\n{axes}{colors}end_header\n{cloud}\n"
    )
    write_transforms(tmp_path, camera_model="OPENCV", ply_file_path="points.ply", **LENS)
    made = convert_export(tmp_path)
    assert (made.views, made.points, made.warnings) == (3, 40, [])
    check(tmp_path, [pixels(*opencv(*seen(pose), **LENS)) for pose in poses()])
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(scene.points, POINTS, atol=1e-5)
    assert (scene.point_colors == (250, 20, 30)).all() and len(scene.distorted) == 3


def test_nerfstudio_fisheye(tmp_path):
    k = {"k1": 0.05, "k2": -0.02, "k3": 0.003, "k4": -0.001}
    write_transforms(tmp_path, camera_model="OPENCV_FISHEYE", **k)
    convert_export(tmp_path)
    expected = []
    for pose in poses():
        x, y = seen(pose)
        r = np.hypot(x, y)
        theta = np.arctan(r)
        bent = theta * (1 + sum(value * theta ** (2 * n) for n, value in enumerate(k.values(), 1)))
        expected.append(pixels(x * bent / r, y * bent / r))
    check(tmp_path, expected)


def test_a_frame_s_own_camera_goes_before_the_common_one(tmp_path):
    def change(document):
        document["frames"][1] |= {"fl_x": 160.0, "fl_y": 164.0}

    write_transforms(tmp_path, change)
    convert_export(tmp_path)
    first, second, third = (pixels(*seen(pose)) for pose in poses())
    second = (second - CENTER) * 2 + CENTER
    check(tmp_path, [first, second, third])


def test_nerf_synthetic_has_names_without_endings_and_a_field_of_view(tmp_path):
    photographs(tmp_path / "train", ("r_0.png", "r_1.png", "r_2.png"))
    photographs(tmp_path / "test", ("r_0.png",))
    angle = 2 * np.arctan(0.5 * WIDTH / 80.0)
    for name, count in (("train", 3), ("test", 1)):
        frames = [
            {"file_path": f"./{name}/r_{n}", "rotation": 0.01, "transform_matrix": pose.tolist()}
            for n, pose in enumerate(poses()[:count])
        ]
        document = {"camera_angle_x": angle, "frames": frames}
        (tmp_path / f"transforms_{name}.json").write_text(json.dumps(document))
    made = convert_export(tmp_path)
    assert made.points > 1000 and "at random" in made.warnings[0]
    names = "train/r_0.png", "train/r_1.png", "train/r_2.png"
    check(tmp_path, [pixels(*seen(p), (80, 80), (WIDTH / 2, HEIGHT / 2)) for p in poses()], names)


def test_polycam(tmp_path):
    names = "11.jpg", "12.jpg", "13.jpg"
    for name, pose in zip(("11", "12", "13", "14"), [*poses(), poses()[0]], strict=True):
        camera = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTER[0], "cy": CENTER[1]}
        camera |= {"width": WIDTH, "height": HEIGHT, "blur_score": 3.0 if name == "14" else 90.0}
        (tmp_path / "keyframes" / "corrected_cameras").mkdir(parents=True, exist_ok=True)
        (tmp_path / "keyframes" / "corrected_cameras" / f"{name}.json").write_text(json.dumps(camera))
    photographs(tmp_path / "keyframes" / "corrected_images", (*names, "14.jpg"))
    grey(tmp_path / "keyframes" / "depth" / "12.png", np.full((HEIGHT, WIDTH), 2000))
    made = convert_export(tmp_path)
    assert "14.json is left out: it is blurred" in made.warnings[0]
    assert [camera.depth is not None for camera in read_scene(tmp_path).cameras] == [False, True, False]
    names = [f"keyframes/corrected_images/{name}" for name in names]
    check(tmp_path, [pixels(*seen(pose)) for pose in poses()], names)


def test_record3d(tmp_path):
    names = "2.jpg", "9.jpg", "10.jpg"  # by number
    photographs(tmp_path / "rgb", names)
    rows = []
    for pose in poses():
        x, y, z, w = pycolmap.Rotation3d(pose[:3, :3]).quat
        rows.append([x, y, z, w, *pose[:3, 3]])
    (tmp_path / "metadata").write_text(json.dumps({
        "poses": rows, "K": [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTER, 1], "w": WIDTH, "h": HEIGHT,
    }))  # fmt: skip
    convert_export(tmp_path)
    check(tmp_path, [pixels(*seen(pose)) for pose in poses()], names)


def test_record3d_without_some_of_its_photographs(tmp_path):
    """A photograph is its number's, not that of its place among those that are left."""
    photographs(tmp_path / "rgb", ("1.jpg", "2.jpg"))
    rows = [[*pycolmap.Rotation3d(pose[:3, :3]).quat, *pose[:3, 3]] for pose in poses()]
    told = {"poses": rows, "K": [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTER, 1], "w": WIDTH, "h": HEIGHT}
    (tmp_path / "metadata").write_text(json.dumps(told))
    assert convert_export(tmp_path).warnings[0] == "frame 0 is left out: it has no photograph."
    check(tmp_path, [pixels(*seen(pose)) for pose in poses()[1:]], ("1.jpg", "2.jpg"))
    (tmp_path / "sparse").rename(tmp_path / "before")
    (tmp_path / "rgb" / "1.jpg").rename(tmp_path / "rgb" / "one.jpg")
    with pytest.raises(LodgsError, match=r"tells of 3 photographs, and .* holds 2"):
        convert_export(tmp_path)


def test_metashape(tmp_path):
    """Its own formula, with P1 and P2 the other way round than OpenCV's, in metres of the chunk's scale."""
    photographs(tmp_path / "images")
    k1, k2, k3, p1, p2, b1 = 0.1, -0.02, 0.01, -0.004, 0.005, 2.0
    cameras = ""
    for number, (name, pose) in enumerate(zip(NAMES, poses(), strict=True)):
        pose = pose @ np.diag([1, -1, -1, 1])
        pose[:3, 3] /= 2
        label = name.removesuffix(".png") if number else name
        numbers = " ".join(map(repr, pose.ravel().tolist()))
        cameras += (
            f'<camera id="{number}" sensor_id="0" label="{label}"><transform>{numbers}</transform></camera>'
        )
    cameras += '<camera id="7" sensor_id="0" label="lost.png"></camera>'
    (tmp_path / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1"><sensors next_id="1">
<sensor id="0" label="unknown" type="frame"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="frame" class="initial"><resolution width="96" height="72"/><f>50</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<f>80</f><cx>1.5</cx><cy>-2</cy><k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><p1>{p1}</p1><p2>{p2}</p2><b1>{b1}</b1>
</calibration></sensor></sensors>
<cameras><group label="g">{cameras}</group></cameras>
<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>4e6 5e5 4e6</translation>
<scale>2</scale></transform>
</chunk></document>""")
    made = convert_export(tmp_path)
    assert made.warnings[0] == "lost.png is left out: it was not aligned."
    expected = []
    for pose in poses():
        x, y = seen(pose)
        r = x * x + y * y
        radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
        bent_x = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
        bent_y = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
        expected.append(pixels(bent_x, bent_y, (80 + b1, 80), (WIDTH / 2 + 1.5, HEIGHT / 2 - 2)))
    check(tmp_path, expected)


def similarity(seed: int, scale: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = scale * rotation_matrix(rng.normal(size=4)), rng.normal(size=3)
    return found


def written(matrix: np.ndarray) -> str:
    return " ".join(map(repr, matrix.ravel().tolist()))


def write_metashape(folder: Path, cameras: str, components: str = "", kind="frame", lens="<f>80</f>") -> None:
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    (folder / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="{kind}">{size}
<calibration type="{kind}" class="adjusted">{size}{lens}</calibration></sensor></sensors>
<components>{components}</components><cameras>{cameras}</cameras></chunk></document>""")


def metashape_camera(name: str, pose: np.ndarray, more: str = "") -> str:
    """Of a pose (4, 4) in the component, OpenGL axes."""
    transform = written(pose @ np.diag([1, -1, -1, 1]))
    return f'<camera sensor_id="0" label="{name}" {more}><transform>{transform}</transform></camera>'


def test_metashape_places_components_and_leaves_disabled_cameras_out(tmp_path):
    """Each component has its own axes; the largest one's are ours, in metres."""
    photographs(tmp_path / "images", [*NAMES, "off.png", "apart.png"])
    first, second = similarity(1, 2.5), similarity(2, 0.7)
    components = "".join(
        f'<component id="{number}"><transform><rotation>{written(its[:3, :3] / scale)}</rotation>'
        f"<translation>{written(its[:3, 3])}</translation><scale>{scale}</scale></transform></component>"
        for number, (its, scale) in enumerate([(first, 2.5), (second, 0.7)])
    )
    world = first @ np.diag([1 / 2.5, 1 / 2.5, 1 / 2.5, 1])  # of the first component's axes in metres
    cameras = ""
    for name, pose, number in zip(NAMES, poses(), (0, 1, 0), strict=True):
        within = np.linalg.inv((first, second)[number]) @ world @ pose
        within[:3, :3] /= np.cbrt(np.linalg.det(within[:3, :3]))
        cameras += metashape_camera(name, within, f'component_id="{number}"')
    cameras += metashape_camera("off.png", poses()[0], 'component_id="0" enabled="false"')
    cameras += metashape_camera("apart.png", poses()[0], 'component_id="2"')
    write_metashape(tmp_path, cameras, components + '<component id="2"/>')
    made = convert_export(tmp_path)
    assert made.warnings[:2] == [
        "off.png is left out: it is disabled in Metashape.",
        "apart.png is left out: Metashape has not aligned it together with most of the others.",
    ]
    check(tmp_path, [pixels(*seen(pose), (80, 80), (WIDTH / 2, HEIGHT / 2)) for pose in poses()])


def test_metashape_photographs_in_folders_of_their_groups(tmp_path):
    names = "left/0001.png", "right/0001.png", "right/0002.png"
    photographs(tmp_path / "images", names)
    one, two, three = (metashape_camera(name[-8:-4], pose) for name, pose in zip(names, poses(), strict=True))
    write_metashape(tmp_path, f'<group label="left">{one}</group><group label="right">{two}{three}</group>')
    convert_export(tmp_path)
    expected = [pixels(*seen(pose), (80, 80), (WIDTH / 2, HEIGHT / 2)) for pose in poses()]
    check(tmp_path, expected, names)
    write_metashape(tmp_path, one + two + three)
    (tmp_path / "sparse").rename(tmp_path / "before")
    assert "0001 is left out: several photographs are called so" in convert_export(tmp_path).warnings[0]


@pytest.mark.parametrize(("p1", "p2"), [(0.0, 0.0), (0.004, -0.003)])
def test_metashape_fisheye(tmp_path, p1, p2):
    """Its own formula: a frame camera's, of a place as far from the middle as the angle to the axis is."""
    photographs(tmp_path / "images")
    k = 0.03, -0.01, 0.004, -0.001
    told = "".join(f"<k{n}>{value}</k{n}>" for n, value in enumerate(k, 1)) + f"<p1>{p1}</p1><p2>{p2}</p2>"
    cameras = "".join(metashape_camera(name, pose) for name, pose in zip(NAMES, poses(), strict=True))
    write_metashape(tmp_path, cameras, kind="fisheye", lens=f"<f>80</f><cx>1.5</cx>{told}")
    convert_export(tmp_path)
    expected = []
    for pose in poses():
        x, y = seen(pose)
        away = np.hypot(x, y)
        x, y = x * np.arctan(away) / away, y * np.arctan(away) / away
        r = x * x + y * y
        radial = 1 + sum(value * r**n for n, value in enumerate(k, 1))
        bent_x = x * radial + p1 * (r + 2 * x * x) + 2 * p2 * x * y
        bent_y = y * radial + p2 * (r + 2 * y * y) + 2 * p1 * x * y
        expected.append(pixels(bent_x, bent_y, (80, 80), (WIDTH / 2 + 1.5, HEIGHT / 2)))
    check(tmp_path, expected)


def test_bundler(tmp_path):
    names = "a.jpg", "b 2.jpg", "c.jpg"
    photographs(tmp_path, names)
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
    made = convert_export(tmp_path)
    assert (made.points, made.warnings) == (40, [])
    expected = []
    for pose in poses():
        x, y = seen(pose)
        bent = 1 + 0.05 * (x * x + y * y) - 0.01 * (x * x + y * y) ** 2
        expected.append(pixels(x * bent, y * bent, (80, 80), (WIDTH / 2, HEIGHT / 2)))
    check(tmp_path, expected, names)
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(scene.points, POINTS, atol=1e-5)
    np.testing.assert_array_equal(scene.point_colors[:, 0], np.arange(40))


@pytest.mark.parametrize("lens", ["pinhole", "disto_k3", "disto_t2"])
def test_openmvg(tmp_path, lens):
    names = "a.jpg", "b.jpg", "c.jpg"
    photographs(tmp_path / "images", names)
    told = {"width": WIDTH, "height": HEIGHT, "focal_length": 80.0, "principal_point": list(CENTER)}
    distortion = {"k1": 0.1, "k2": -0.02, "k3": 0.01} if lens != "pinhole" else {}
    if lens == "disto_t2":
        distortion |= {"p1": 0.005, "p2": -0.004}
    if distortion:
        told = {"value0": told, lens: list(distortion.values())}

    def listed(values):
        return [
            {"key": key, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": 2, "data": value}}}
            for key, value in values
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
        "intrinsics": listed([(0, told)]), "extrinsics": extrinsics, "structure": structure,
    }))  # fmt: skip
    assert convert_export(tmp_path).points == 40
    check(
        tmp_path,
        [pixels(*opencv(*seen(pose), **distortion), (80, 80)) for pose in poses()],
        names,
    )


def test_photographs_of_another_size_scale_the_lens(tmp_path):
    write_transforms(tmp_path)
    photographs(tmp_path / "images", size=(WIDTH // 2, HEIGHT // 2))
    convert_export(tmp_path)
    check(tmp_path, [pixels(*seen(pose)) / 2 for pose in poses()])


def test_another_folder_gets_the_photographs_and_the_source_stays(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    write_transforms(source)
    before = sorted(source.rglob("*"))
    assert main(["scene", "--from", str(source), "--out", str(out)]) == 0
    assert sorted(source.rglob("*")) == before
    assert {path.name for path in (out / "images").iterdir()} == set(NAMES)
    check(out, [pixels(*seen(pose)) for pose in poses()])
    with pytest.raises(LodgsError, match="holds a COLMAP scene already"):
        convert_export(source, out)


def test_masks_come_along(tmp_path):
    def change(document):
        document["frames"][1]["mask_path"] = "black/b.png"

    write_transforms(tmp_path, change)
    photographs(tmp_path / "black", ["b.png"])
    convert_export(tmp_path)
    masks = [camera.mask for camera in read_scene(tmp_path).cameras]
    assert masks == [None, tmp_path / "masks" / "second photo.png.png", None]


def test_depth_maps_come_along_and_give_the_points(tmp_path):
    """Of nerfstudio's, in millimetres: a wall before each camera."""

    def change(document):
        for number, frame in enumerate(document["frames"]):
            frame["depth_file_path"] = f"deep/{number}.png"

    write_transforms(tmp_path, change)
    for number in range(3):
        grey(tmp_path / "deep" / f"{number}.png", np.full((HEIGHT // 2, WIDTH // 2), 3000 + number))
    made = convert_export(tmp_path)
    assert made.points == 0 and "training takes them from the depth maps" in made.warnings[-1]
    scene = read_scene(tmp_path)
    assert [camera.depth for camera in scene.cameras] == [
        tmp_path / "depths" / f"{name}.png" for name in NAMES
    ]
    found = add_depth_points(scene)
    for number, camera in enumerate(scene.cameras):
        inverse = DepthPriors(scene, "metric").inverse(camera)
        np.testing.assert_allclose(inverse, 1 / (3 + 0.001 * number), rtol=1e-5)
    depths = np.stack([camera.view_space(found.points)[:, 2] for camera in scene.cameras])
    assert (np.abs(depths - [[3.0], [3.001], [3.002]]).min(axis=0) < 1e-4).all() and len(found.points) > 5000


def test_kinds_of_depth_that_are_not_read_are_left(tmp_path):
    def change(document):
        for frame in document["frames"]:
            frame["depth_file_path"] = "depth.npz"

    write_transforms(tmp_path, change)
    (tmp_path / "depth.npz").write_bytes(b"numbers")
    assert convert_export(tmp_path).points == 30_000
    assert not (tmp_path / "depths").exists()


def test_random_points_are_seen_by_two_views(tmp_path):
    write_transforms(tmp_path)
    convert_export(tmp_path)
    cameras = read_scene(tmp_path).cameras
    points = random_start_points(cameras)
    assert (sum(camera.sees(points).astype(int) for camera in cameras) >= 2).all()
    assert np.linalg.norm(points.mean(axis=0)) < 0.5  # around what they look at, from 3 away


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda d: d.update(frames=[]), "has no frames"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "camera model EQUIRECTANGULAR"),
        (lambda d: d.pop("fl_x"), "no number 'camera_angle_x'"),
        (lambda d: [f.update(transform_matrix=[[1, 2], [3]]) for f in d["frames"]], "where -1x4 numbers"),
        (lambda d: [f.update(transform_matrix=[[0, 0, 0, 0]] * 4) for f in d["frames"]], "no rotation"),
        (lambda d: d.update(k4=0.3), "its k4"),
        (lambda d: [f.update(file_path="../secret") for f in d["frames"]], "secret"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_and_nothing_is_written(tmp_path, spoil, says, capsys):
    write_transforms(tmp_path, spoil)
    assert main(["scene", "--from", str(tmp_path)]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.glob("sparse/*"))


def test_photographs_that_were_turned_are_left_out(tmp_path):
    """Their lens would be of another shape."""
    write_transforms(tmp_path)
    write_image(tmp_path / "images" / NAMES[0], np.full((WIDTH, HEIGHT, 3), 90, np.uint8))
    made = convert_export(tmp_path)
    assert made.views == 2
    assert made.warnings[0] == (
        f"{NAMES[0]} is left out: it is 72x96, and its camera's pictures are 96x72: it was turned or cropped."
    )


def test_what_is_named_but_missing_is_told(tmp_path):
    def spoil(document):
        document.update(ply_file_path="nowhere.ply", camera_model=None)
        document["frames"][1].update(mask_path="masks/nowhere.png", k1=None)
        document["frames"][2]["file_path"] = "images/third.JPG"  # which is a PNG

    write_transforms(tmp_path, spoil)
    made = convert_export(tmp_path)
    assert made.views == 3 and len(made.warnings) == 3
    assert "nowhere.ply" in made.warnings[0]
    assert made.warnings[1].startswith("1 masks are missing, such as")
    check(tmp_path, [pixels(*seen(pose)) for pose in poses()])


def test_one_wrong_frame_is_left_out(tmp_path):
    write_transforms(tmp_path, lambda d: d["frames"][0].pop("transform_matrix"))
    made = convert_export(tmp_path)
    assert made.views == 2 and "left out" in made.warnings[0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<document><chunk>",
        "<document><chunk/></document>",
        "<!DOCTYPE a [<!ENTITY b 'c'>]><document><chunk>",
    ],
)
def test_damaged_xml(tmp_path, text):
    (tmp_path / "cameras.xml").write_text(text)
    with pytest.raises(LodgsError):
        convert_export(tmp_path)


def test_an_export_in_a_folder_of_its_own(tmp_path):
    """As unpacking leaves it."""
    write_transforms(tmp_path / "scan" / "scan")
    made = convert_export(tmp_path / "scan")
    assert made.views == 3
    names = [f"scan/images/{name}" for name in NAMES]
    check(tmp_path / "scan", [pixels(*seen(pose)) for pose in poses()], names)
    write_transforms(tmp_path / "two" / "a")
    write_transforms(tmp_path / "two" / "b")
    assert find_export(tmp_path / "two") is None


def test_what_is_no_export(tmp_path):
    assert find_export(tmp_path) is None
    with pytest.raises(LodgsError, match="is no export that is known"):
        convert_export(tmp_path)
    with pytest.raises(LodgsError, match="does not exist"):
        convert_export(tmp_path / "nowhere")
    write_transforms(tmp_path)
    convert_export(tmp_path)
    (tmp_path / "transforms.json").unlink()
    with pytest.raises(LodgsError, match="is a COLMAP scene as it is"):
        convert_export(tmp_path)
