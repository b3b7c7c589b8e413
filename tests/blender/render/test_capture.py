"""Capture of a Blender scene as a COLMAP scene: exact cameras, and depths and points on its surfaces."""

import json
import os
import subprocess
import sys
import time
from math import radians
from pathlib import Path

import numpy as np
import pytest

from training.scenes.cameras import read_camera_folder
from training.scenes.colmap_model import read_points
from training.scenes.image_headers import image_size

pytestmark = pytest.mark.one_blender


TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")
AS_BLENDER = Path(__file__).resolve().parents[1] / "as_blender.py"
SIZE = "64x48"

needs_trainer = pytest.mark.skipif(not TRAINER, reason="no trainer; set LODGS_TRAINER_PYTHON")


@pytest.fixture
def scene(bpy):
    """Two cubes on a ground of 12 m with a sun, rendered with one sample through each pixel centre."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=12)
    bpy.ops.mesh.primitive_cube_add(location=(2.5, 1.5, 1))
    bpy.ops.mesh.primitive_cube_add(location=(0, 0, 1))
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.3, 0))
    scene.world = bpy.data.worlds.new("World")
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    select(bpy, "Cube.001")
    return scene


def select(bpy, *names):
    for obj in bpy.context.scene.objects:
        obj.select_set(obj.name in names)


def new_camera(bpy, location, rotation, **data):
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = location, [radians(angle) for angle in rotation]
    for name, value in data.items():
        setattr(camera.data, name, value)
    bpy.context.scene.collection.objects.link(camera)
    return camera


def unusual_cameras(bpy):
    """Cameras with shift, roll, other sensor fits, depth of field and a scaled parent."""
    carrier = bpy.data.objects.new("Carrier", None)
    carrier.location, carrier.scale, carrier.rotation_euler = (0, 0, 1), (2, 2, 2), (0, 0, 0.4)
    bpy.context.scene.collection.objects.link(carrier)
    cameras = [
        new_camera(bpy, (0, -9, 3), (75, 0, 0), shift_x=0.13, shift_y=-0.08),
        new_camera(bpy, (7, -6, 4), (68, 10, 48), lens=35, sensor_fit="VERTICAL", sensor_height=30),
        new_camera(bpy, (-5, -6, 5), (60, 0, -40), lens=28, sensor_fit="HORIZONTAL", sensor_width=40),
        new_camera(bpy, (0, -4, 1), (80, 0, 0), lens=24),
    ]
    cameras[-1].parent = carrier
    cameras[0].data.dof.use_dof = True
    return cameras


@pytest.fixture
def capture(bpy, lodgs, tmp_path):
    """``capture("--around", ...)`` captures the current file to tmp_path/out. Returns the exit code."""

    def run(*arguments, out="out"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
        command = ["capture", tmp_path / "scene.blend", "--out", tmp_path / out, "--size", SIZE, *arguments]
        return lodgs("commands").main([str(word) for word in command])

    return run


def read_depth(folder: Path, name: str) -> np.ndarray:
    """Read a depth map with the trainer's reader, in a Python that has OpenEXR."""
    code = (
        "import sys, numpy, pathlib; from training.scenes.rendered_views import read_exr_depth;"
        "numpy.save(sys.argv[2], read_exr_depth(pathlib.Path(sys.argv[1])))"
    )
    saved = folder / "depth.npy"
    command = [TRAINER, "-c", code, str(folder / "depths" / f"{name}.exr"), str(saved)]
    subprocess.run(command, check=True, cwd=AS_BLENDER.parents[2])
    return np.load(saved)


def test_cameras_match_blender_within_a_fraction_of_a_pixel(bpy, scene, capture, tmp_path):
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = 1.0, 1.4
    cameras = unusual_cameras(bpy)
    assert capture("--cameras", "--range", "1-4") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    rng, scene = np.random.default_rng(0), bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = (int(side) for side in SIZE.split("x"))
    by_name = sorted((obj for obj in scene.objects if obj.type == "CAMERA"), key=lambda obj: obj.name)
    assert len(views) == len(by_name) == len(cameras)
    for camera, view in zip(by_name, views, strict=True):
        points = rng.uniform((-3, -3, 0), (3, 3, 2), (50, 3))
        pixels, depths = view.project(points)
        for point, pixel, depth in zip(points, pixels, depths, strict=True):
            x, y, distance = world_to_camera_view(scene, camera, Vector(point))
            assert distance > 0 and depth == pytest.approx(distance, rel=1e-5)
            assert pixel == pytest.approx((x * view.width, (1 - y) * view.height), abs=2e-3)


@needs_trainer
def test_depths_match_ray_casts(bpy, scene, capture, tmp_path):
    unusual_cameras(bpy)
    assert capture("--cameras", "--range", "1-4") == 0
    scene, depsgraph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    for view in views:
        depths = read_depth(tmp_path / "out", view.name)
        hits = 0
        sky = 0
        for y in range(1, view.height, 5):
            for x in range(2, view.width, 5):
                far = view.unproject(np.array([[x + 0.5, y + 0.5]]), np.ones(1))[0]
                hit, point, *_ = scene.ray_cast(depsgraph, view.center, far - view.center)
                window = depths[y - 1 : y + 2, x - 1 : x + 2]
                if hit and np.ptp(window) < 1:  # skip outlines, which float32 may shift
                    assert depths[y, x] == pytest.approx(view.view_space(np.array([point]))[0, 2], rel=2e-4)
                    hits += 1
                elif not hit and window.min() > 100:
                    assert depths[y, x] > 1e6
                    sky += 1
        assert hits > 40 and (sky or view is not views[0])


@needs_trainer
def test_depths_belong_to_the_view_layers_of_the_image(bpy, lodgs, scene, capture, tmp_path):
    """Without a compositor, Blender's image is the first layer."""
    excluded = bpy.data.collections.new("Excluded")
    scene.collection.children.link(excluded)
    cube = bpy.data.objects["Cube"]
    cube.users_collection[0].objects.unlink(cube)
    excluded.objects.link(cube)
    scene.view_layers.new("Second")
    scene.view_layers[0].layer_collection.children["Excluded"].exclude = True
    new_camera(bpy, (2.5, 1.5, 9), (0, 0, 0))
    new_camera(bpy, (2.5, 1.6, 9), (0, 0, 0))
    assert capture("--cameras", "--range", "1-1") == 0
    assert read_depth(tmp_path / "out", "view_0001")[24, 32] == pytest.approx(9, abs=1e-3)
    scene = bpy.context.scene
    for layer in scene.view_layers:
        layer.use = True
    tree = lodgs("compat").compositor_tree(scene)
    tree.nodes.clear()
    output = lodgs("compat").compositor_output(tree)
    tree.links.new(tree.nodes.new("CompositorNodeRLayers").outputs["Image"], output)
    assert capture("--cameras", "--range", "1-1", out="both") == 0
    assert read_depth(tmp_path / "both", "view_0001")[24, 32] == pytest.approx(7, abs=1e-3)


@needs_trainer
def test_imported_points_lie_on_the_surfaces(bpy, scene, capture, tmp_path):
    assert capture("--around", "--views", "8") == 0
    assert not (tmp_path / "out" / ".model.tmp").exists()
    bpy.context.scene.lodgs_capture.folder = str(tmp_path / "out")
    assert bpy.ops.lodgs.import_capture() == {"FINISHED"}
    assert not any(obj.hide_get() for obj in bpy.context.view_layer.objects)
    (root,) = [obj for obj in bpy.context.scene.objects if obj.lodgs.is_root]
    assert np.allclose(root.matrix_world, np.eye(4)), "it has the coordinates of the Blender scene"
    assert len(root.lodgs.cameras.objects) == 8
    cloud = root.lodgs.points.data
    points = np.empty(3 * len(cloud.points), np.float32)
    cloud.attributes["position"].data.foreach_get("vector", points)
    points = points.reshape(-1, 3).astype(float)
    assert len(points) > 1000
    boxes = [
        np.abs(points - center) - half_size
        for center, half_size in (((0, 0, 1), 1.0), ((2.5, 1.5, 1), 1.0), ((0, 0, 0), (6, 6, 0)))
    ]
    distances = [
        np.linalg.norm(np.maximum(box, 0), axis=1) + np.abs(box.max(axis=1).clip(max=0)) for box in boxes
    ]
    sky = np.linalg.norm(points, axis=1) > 20
    assert np.min(distances, axis=0)[~sky].max() < 0.01 and sky.mean() <= 0.1
    assert all((distance < 0.01).sum() > 20 for distance in distances), "points on each surface"


def test_dome_views_see_the_selection(bpy, scene, capture, tmp_path):
    assert capture("--around", "--views", "9", "--range", "1-9") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    for view in views:
        assert view.center[2] >= 1 and view.sees(corners).all()
        assert view.world_to_camera[1, 2] <= 1e-6, "views are upright"
    assert views[0].center[2] < 2 < views[-1].center[2]


def test_views_of_an_animated_camera(bpy, scene, capture, tmp_path):
    camera = scene.camera = new_camera(bpy, (0, -9, 3), (75, 0, 0))
    for frame, x in ((1, -4), (21, 4)):
        camera.location.x = x
        camera.keyframe_insert("location", frame=frame)
    scene.frame_end = 21
    scene.timeline_markers.new("first", frame=1).camera = camera
    scene.timeline_markers.new("second", frame=15).camera = new_camera(bpy, (9, 0, 3), (75, 0, 90))
    assert capture("--animation", "--views", "5", "--range", "1-5") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    scene = bpy.context.scene
    for frame, view in zip((1, 6, 11, 16, 21), views, strict=True):
        scene.frame_set(frame)
        np.testing.assert_allclose(view.center, scene.camera.matrix_world.translation, atol=1e-5)
    assert views[-1].center[0] == pytest.approx(9), "the marker's camera"


def test_views_along_a_curve(bpy, scene, capture, tmp_path, capfd):
    bpy.ops.curve.primitive_bezier_circle_add(radius=5, location=(0, 0, 1.7))
    bpy.context.object.name = "Way"
    assert capture("--curve", "Way", "--views", "6", "--range", "1-6") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    centers = np.array([view.center for view in views])
    np.testing.assert_allclose(np.hypot(*centers[:, :2].T), 5, atol=0.1)
    np.testing.assert_allclose(centers[:, 2], 1.7, atol=1e-5)
    assert capture("--curve", "Why", "--views", "6", "--range", "1-6") == 2
    assert "'Why'" in capfd.readouterr().err


def test_near_clipping_follows_the_size_of_the_curve(bpy, scene, capture, tmp_path):
    for radius, near in ((5, 0.1), (0.005, 2 * np.pi * 0.005 / 6 / 4)):
        bpy.ops.curve.primitive_bezier_circle_add(radius=radius, location=(0, 0, 1.7))
        bpy.context.object.name = f"Way {radius}"
        assert capture("--curve", f"Way {radius}", "--views", "6", "--range", "1-2", out=f"out {radius}") == 0
        assert read_camera_folder(tmp_path / f"out {radius}" / "cameras")[1] == pytest.approx(near, rel=0.01)


def test_views_above_see_the_selection(bpy, scene, capture, tmp_path):
    select(bpy, "Plane")
    bpy.context.scene.lodgs_capture.height = 20
    assert capture("--above", "--views", "10", "--range", "1-10") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    np.testing.assert_allclose([view.center[2] for view in views], 20, atol=1e-5)
    visible = [view.sees(np.array([[0.0, 0, 0]])).all() for view in views]
    assert all(visible), "from 20 m, each view sees the middle"
    assert len({tuple(view.world_to_camera[2, :3].round(3)) for view in views}) == 5


def test_dome_views_see_a_collection_instance(bpy, scene, capture, tmp_path):
    cubes = bpy.data.collections.new("Cubes")
    cubes.instance_offset = (0, 0, 1)
    for name in ("Plane", "Cube", "Cube.001"):
        obj = bpy.data.objects[name]
        scene.collection.objects.unlink(obj)
        if name == "Cube.001":
            cubes.objects.link(obj)
    outer, instance_object = bpy.data.collections.new("Outer"), bpy.data.objects.new("Shown", None)
    for obj, instance in ((bpy.data.objects.new("Inner", None), cubes), (instance_object, outer)):
        obj.instance_type, obj.instance_collection = "COLLECTION", instance
        obj.location.x = 10
    outer.objects.link(bpy.data.objects["Inner"])
    instance_object.scale = (2, 2, 2)
    scene.collection.objects.link(instance_object)
    assert capture("--around", "--views", "9", "--range", "1-9") == 0
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    corners = np.array([(x, y, z) for x in (28, 32) for y in (-2, 2) for z in (-2, 2)], float)
    for view in views:
        assert view.sees(corners).all()


@needs_trainer
def test_folder_with_another_scene_is_rejected(bpy, scene, capture, tmp_path, capfd):
    model = tmp_path / "out" / "sparse" / "0" / "points3D.bin"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"precious")
    assert capture("--around", "--views", "2") == 2
    assert "contains another scene" in capfd.readouterr().err
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == [model]


def test_capture_that_ended_in_its_first_view_continues(
    bpy, lodgs, scene, capture, tmp_path, capfd, monkeypatch
):
    module = lodgs("render.capture")
    with monkeypatch.context() as patch:
        patch.setattr(module, "write_camera", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert capture("--around", "--views", "2", "--range", "1-2") == 3
    (image,) = (tmp_path / "out" / "images").iterdir()
    assert capture("--around", "--views", "2", "--range", "1-2") == 0
    assert {file.stem for file in image.parent.iterdir()} == {"view_0001", "view_0002"}


def test_incomplete_images_are_noticed(lodgs, tmp_path):
    path, is_complete = tmp_path / "a.png", lodgs("render.written_images").is_complete_image
    lodgs("training.scenes.images").write_png(path, np.zeros((12, 16, 3), np.uint8))
    assert is_complete(path, (16, 12)) and not is_complete(path, (12, 16))
    path.write_bytes(path.read_bytes()[:-5])
    assert not is_complete(path, (16, 12))
    path.write_bytes(b"")
    assert not is_complete(path, (16, 12))


def test_existing_views_are_not_rendered_again(bpy, scene, capture, tmp_path, capfd):
    assert capture("--around", "--views", "4", "--range", "2-3") == 0
    out = tmp_path / "out"
    assert {file.stem for file in (out / "images").iterdir()} == {"view_0002", "view_0003"}
    dates = {file: file.stat().st_mtime_ns for file in out.rglob("*.*")}
    (out / "cameras" / "view_0003.json").unlink()  # as if Blender had been killed before writing it
    capfd.readouterr()
    assert capture("--around", "--views", "4", "--range", "1-9") == 0
    lines = capfd.readouterr().err.splitlines()
    assert sum(line.startswith("warning: Without a denoiser, 1 sample leaves noise") for line in lines) == 1
    assert [line for line in lines if line.startswith("View")] == [
        "View 1 of 4",
        "View 3 of 4",
        "View 4 of 4",
    ]
    for file, date in dates.items():
        if "0002" in file.name:
            assert file.stat().st_mtime_ns == date
    assert sorted(file.name for file in out.rglob("*") if file.is_file()) == sorted(
        f"view_000{number}.{suffix}" for number in (1, 2, 3, 4) for suffix in ("exr", "json", "png")
    )
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    assert capture("--around", "--views", "4", "--range", "1-4") == 0, "all views exist"
    assert "Workbench needs a GPU" in capfd.readouterr().err
    for count in ("5", "3"):
        assert capture("--around", "--views", count, "--range", "1-5") == 2
        assert "contains other views" in capfd.readouterr().err


def test_only_views_are_written_without_borders_and_file_outputs(bpy, lodgs, scene, capture, tmp_path):
    compat = lodgs("compat")
    tree = compat.compositor_tree(scene)
    layers, store = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeOutputFile")
    if hasattr(store, "base_path"):
        store.base_path = str(tmp_path / "stored")
        tree.links.new(layers.outputs["Image"], store.inputs[0])
    else:
        store.directory = str(tmp_path / "stored")
        store.file_output_items.new("RGBA", "Image")
        tree.links.new(layers.outputs["Image"], store.inputs["Image"])
    tree.links.new(layers.outputs["Image"], compat.compositor_output(tree))
    scene.render.use_border = scene.render.use_crop_to_border = True
    scene.render.border_max_x = 0.5
    scene.render.resolution_percentage = 37
    assert capture("--around", "--views", "2", "--range", "1-2") == 0
    assert not (tmp_path / "stored").exists()
    for file in (tmp_path / "out" / "images").iterdir():
        assert image_size(file) == (64, 48)


def test_transparent_film_gives_images_with_alpha(bpy, scene, capture, tmp_path):
    scene.render.film_transparent = True
    bpy.data.objects.remove(bpy.data.objects["Plane"])
    assert capture("--around", "--views", "2", "--range", "1-2") == 0
    image = bpy.data.images.load(str(tmp_path / "out" / "images" / "view_0001.png"))
    assert image.depth == 32 and {0, 1} <= set(np.array(image.pixels[:])[3::4])


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (lambda bpy: None, ["--cameras"], "has 0 camera(s)"),
        (lambda bpy: None, ["--animation"], "has no camera"),
        (lambda bpy: setattr(bpy.context.scene, "camera", new_camera(bpy, (0, -9, 3), (75, 0, 0))),
         ["--animation"], "does not move"),
        (lambda bpy: [new_camera(bpy, (0, -9, 3), (75, 0, 0), type=kind) for kind in ("ORTHO", "PERSP")],
         ["--cameras"], "is ortho"),
        (lambda bpy: [new_camera(bpy, (0, -9, 3), (75, 0, 0), type=kind) for kind in ("PANO", "PERSP")],
         ["--cameras"], "is pano"),
        (lambda bpy: [bpy.data.objects.remove(obj) for obj in list(bpy.data.objects)], ["--around"],
         "the Blender scene is empty"),
        (lambda bpy: setattr(bpy.context.scene.render, "engine", "LODGS"), ["--around"], "only splats"),
        (lambda bpy: setattr(bpy.context.view_layer, "use", False), ["--around"], "none of its view layers"),
        (lambda bpy: None, ["--around", "--views", "1"], "views = 1 is invalid"),
        (lambda bpy: None, ["--around", "--range", "0-3"], "FIRST-LAST"),
        (lambda bpy: None, ["--around", "--range", "5-3"], "FIRST-LAST"),
        (lambda bpy: None, ["--around", "--cameras"], "not allowed with"),
        (lambda bpy: None, ["--around", "--size", "0x5"], "not WIDTHxHEIGHT"),
    ],
)  # fmt: skip
def test_wrong_options_are_reported(bpy, scene, capture, tmp_path, capfd, change, arguments, message):
    change(bpy)
    bpy.context.view_layer.update()
    assert capture("--range", "1-2", *arguments) == 2
    errors = capfd.readouterr().err
    assert message in errors and "Traceback" not in errors
    assert not (tmp_path / "out").exists()


def test_unsupported_cameras_are_left_out(bpy, scene, capture, tmp_path, capfd):
    """One orthographic, mirrored or sheared camera among many does not stop a capture."""
    for angle in (-20, 0, 20):
        new_camera(bpy, (angle / 10, -9, 3), (75, 0, 0))
    new_camera(bpy, (0, -9, 3), (75, 0, 0), type="ORTHO").name = "Flat"
    new_camera(bpy, (0, -9, 3), (75, 0, 0)).name = "Mirror"
    bpy.data.objects["Mirror"].scale = (-1, 1, 1)
    sheared, rig = new_camera(bpy, (0, -9, 3), (75, 20, 0)), bpy.data.objects.new("Rig", None)
    scene.collection.objects.link(rig)
    sheared.name, sheared.parent, rig.scale, rig.rotation_euler = "Sheared", rig, (2, 1, 1), (0, 0, 0.4)
    assert capture("--cameras", "--range", "1-9") == 0
    errors = capfd.readouterr().err
    for name, reason in (("Flat", "is ortho"), ("Mirror", "mirrors"), ("Sheared", "shears")):
        (line,) = [line for line in errors.splitlines() if f"'{name}'" in line]
        assert line.startswith("warning: ") and reason in line and "left out" in line
    assert len(list((tmp_path / "out" / "images").iterdir())) == 3


def test_frames_of_unsupported_cameras_are_left_out(bpy, scene, capture, tmp_path, capfd):
    """Markers switch to an orthographic camera in the middle of the range."""
    moving = new_camera(bpy, (0, -9, 3), (75, 0, 0))
    flat = new_camera(bpy, (0, -9, 3), (75, 0, 0), type="ORTHO")
    flat.name = "Flat"
    for frame, x in ((1, -1), (6, 1)):
        moving.location.x = x
        moving.keyframe_insert("location", frame=frame)
    scene.camera, scene.frame_start, scene.frame_end = moving, 1, 6
    for frame, camera in ((1, moving), (3, flat), (5, moving)):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    assert capture("--animation", "--views", "6", "--range", "1-9") == 0
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "left out" in line]
    assert line.startswith("warning: ") and "Frames 3, 4 are left out" in line and "'Flat' is ortho" in line
    assert len(list((tmp_path / "out" / "images").iterdir())) == 4


def test_folder_that_is_not_writable(bpy, scene, capture, tmp_path, capfd):
    (tmp_path / "out").write_text("a file")
    assert capture("--around", "--views", "2", "--range", "1-2") == 2
    assert str(tmp_path / "out") in capfd.readouterr().err


def test_compositor_without_an_output_is_reported(bpy, scene, capture, tmp_path, capfd):
    if not hasattr(scene, "compositing_node_group"):
        pytest.skip("in this Blender, a compositor tree without an output leaves the image unchanged")
    scene.compositing_node_group = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
    assert capture("--around", "--views", "2", "--range", "1-2") == 2
    assert "connect the compositor's output" in capfd.readouterr().err
    assert not [*(tmp_path / "out").glob("cameras/*")]


@needs_trainer
def test_capture_beside_a_georeferenced_scene_has_the_original_place(bpy, lodgs, scene, capture, tmp_path):
    """Expected values: the original point of a position is rotation⁻¹ (position - location) + origin."""
    from mathutils import Matrix

    importing, origin = lodgs("data.importing"), np.array([500_000.0, 4_200_000.0, 300.0])
    with importing.new_scene(bpy.context, "survey") as root:
        root.lodgs.meta = json.dumps({"origin": origin.tolist()})
    rotation_matrix = Matrix.Rotation(radians(30), 4, "Z") @ Matrix.Rotation(radians(-90), 4, "X")
    root.matrix_basis = Matrix.Translation((5, -3, 2)) @ rotation_matrix
    rotation, location = np.array(rotation_matrix)[:3, :3], np.array([5, -3, 2])
    cameras = [new_camera(bpy, (x, -9, 3), (75, 0, 0)) for x in (0, 1, 2)]
    positions = [np.array(camera.location) for camera in cameras]
    assert capture("--cameras", "--range", "1-1") == 0
    assert capture("--cameras") == 0, "the first view is recognised"
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    for view, position in zip(views, positions, strict=True):
        expected = rotation.T @ (position - location) + origin
        np.testing.assert_allclose(view.center, expected, rtol=0, atol=1e-5)
    points, _, _ = read_points(tmp_path / "out" / "sparse" / "0")
    in_blender = (points - origin) @ rotation.T + location
    on_ground = np.abs(in_blender[:, 2]) < 1e-3
    on_cubes = (in_blender[:, 2] > 0) & (np.abs(in_blender[:, :2] - (1.25, 0.75)) < 2.3).all(axis=1)
    is_sky = np.linalg.norm(in_blender, axis=1) > 20
    assert 0.9 <= (on_ground | on_cubes).mean() < 1 and (on_ground | on_cubes | is_sky).all()

    bpy.context.scene.lodgs_capture.folder = str(tmp_path / "out")
    assert bpy.ops.lodgs.import_capture() == {"FINISHED"}
    imported = lodgs("data.roots").active_root(bpy.context)
    assert lodgs("data.metadata").origin_of(imported).any()
    bpy.context.view_layer.update()
    for view, position in zip(lodgs("data.photographs").views(imported), positions, strict=True):
        np.testing.assert_allclose(view.matrix_world.translation, position, atol=1e-4)


def test_capture_beside_a_scaled_georeferenced_scene_keeps_the_place(
    bpy, lodgs, scene, capture, tmp_path, capfd
):
    with lodgs("data.importing").new_scene(bpy.context, "survey") as root:
        root.lodgs.meta = json.dumps({"origin": [5e5, 4e6, 0]})
    root.scale = (2, 2, 2)
    for x in (0, 1):
        new_camera(bpy, (x, -9, 3), (75, 0, 0))
    assert capture("--cameras", "--range", "1-2") == 0
    assert "warning: The views have Blender's coordinates" in capfd.readouterr().err
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    np.testing.assert_allclose([view.center for view in views], [(0, -9, 3), (1, -9, 3)], atol=1e-5)


def test_nothing_is_rendered_without_a_trainer(bpy, scene, capture, tmp_path, capfd, monkeypatch):
    monkeypatch.delenv("LODGS_TRAINER_PYTHON", raising=False)
    assert capture("--around", "--views", "2") == 2
    assert "not installed" in capfd.readouterr().err and not (tmp_path / "out").exists()


@needs_trainer
def test_operator_captures_the_current_scene(bpy, lodgs, scene, blender, tmp_path):
    settings, background_capture = scene.lodgs_capture, lodgs("runs.background_capture")
    with pytest.raises(RuntimeError, match="not saved"):
        bpy.ops.lodgs.capture_scene()
    settings.folder, settings.views, settings.view_width = str(tmp_path / "out"), 4, 64
    scene.render.resolution_x, scene.render.resolution_y = 400, 300
    objects = len(bpy.data.objects)
    assert bpy.ops.lodgs.capture_scene() == {"FINISHED"}
    work = background_capture.current
    assert (work.message, work.fraction, work.problem) == ("Captured", 1.0, "")
    assert bpy.ops.lodgs.capture_scene() == {"FINISHED"}
    assert background_capture.current.message == "Kept the views in the folder"
    assert len(bpy.data.objects) == objects and not bpy.data.filepath, "the open file is unchanged"
    assert not (tmp_path / "out" / "capture.blend").exists()
    assert bpy.ops.lodgs.import_capture() == {"FINISHED"}
    (root,) = [obj for obj in scene.objects if obj.lodgs.is_root]
    assert len(root.lodgs.cameras.objects) == 4
    assert [tuple(cam.data.lodgs.width for cam in root.lodgs.cameras.objects)] == [(64,) * 4]


@needs_trainer
def test_python_drivers_run_if_they_are_enabled(bpy, lodgs, scene, blender, tmp_path, monkeypatch):
    preferences = bpy.context.preferences.filepaths
    monkeypatch.setattr(preferences, "use_scripts_auto_execute", True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.mesh.primitive_cube_add()
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    for name in "ab":
        new_camera(bpy, (0, -9, 3), (75, 0, 0)).name = name
    driver = bpy.data.objects["b"].driver_add("location", 0).driver
    driver.expression = "sum([1, 2]) / 2"  # not a simple expression
    settings = scene.lodgs_capture
    settings.folder, settings.views_from, settings.view_width = str(tmp_path / "out"), "CAMERAS", 64
    bpy.context.view_layer.update()
    assert bpy.ops.lodgs.capture_scene() == {"FINISHED"}
    views, _ = read_camera_folder(tmp_path / "out" / "cameras")
    assert [view.center[0] for view in views] == pytest.approx([0, 1.5], abs=1e-5)


def test_crash_of_blender_is_reported(bpy, lodgs, fake, scene, blender, tmp_path):
    fake()
    blender.write_text("#!/bin/sh\nkill -SEGV $$\n")
    scene.lodgs_capture.folder = str(tmp_path / "out")
    with pytest.raises(RuntimeError, match="EEVEE and Workbench need a graphics card"):
        bpy.ops.lodgs.capture_scene()
    blender.write_text("#!/bin/sh\necho 'error: The disk is full.' >&2\nexit 2\n")
    with pytest.raises(RuntimeError, match="The disk is full"):
        bpy.ops.lodgs.capture_scene()


def test_cancelled_capture_is_reported(bpy, lodgs, fake, scene, blender, hanging, tmp_path):
    fake()
    hanging(blender, "View 2 of 30", sys.executable, Path(__file__).parents[1] / "as_blender.py")
    background_capture = lodgs("runs.background_capture")
    settings = scene.lodgs_capture
    settings.folder, settings.views, settings.view_width = str(tmp_path / "out"), 30, 64
    work = background_capture.start(bpy.context)
    with pytest.raises(RuntimeError, match="already running"):
        bpy.ops.lodgs.capture_scene()
    end = time.monotonic() + 200
    assert work.message == "View 1 of 30"
    while work.step() and not work.message.startswith("View 2"):
        assert time.monotonic() < end
        time.sleep(0.02)
    assert bpy.ops.lodgs.cancel_capture() == {"FINISHED"}
    while work.step():
        time.sleep(0.02)
    assert work.message == "Stopped after 1 of 30 views" and not work.problem
    for kind in ("cameras", "images", "depths"):
        assert len(list((tmp_path / "out" / kind).iterdir())) == 1
    settings.views = 20  # other views
    with pytest.raises(RuntimeError, match="contains other views"):
        bpy.ops.lodgs.capture_scene()
    settings.views_from = "CAMERAS"
    with pytest.raises(RuntimeError, match="has 0 camera"):
        bpy.ops.lodgs.capture_scene()
