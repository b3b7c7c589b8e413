"""Import of COLMAP scenes, compared with projections by COLMAP's and by Blender's cameras."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.training.scenes.walls import write_walls
from training.scenes.colmap import read_scene
from training.scenes.images import write_png
from training.scenes.lenses import make_intrinsics
from training.scenes.write_colmap import write_model


@pytest.fixture
def mini(shared_scenes) -> Path:
    return shared_scenes / "variants" / "mini_saharov"


def count_data(bpy) -> dict[str, int]:
    names = [
        "objects", "cameras", "images", "pointclouds", "meshes", "collections", "materials", "node_groups"
    ]  # fmt: skip
    return {name: len(getattr(bpy.data, name)) for name in names}


def test_cameras_project_points_as_colmap(bpy, lodgs, mini):
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    scene = read_scene(mini)
    root = lodgs("data.importing").import_colmap(bpy.context, mini)
    root.scale, root.location = (2, 2, 2), (1, 2, 3)
    bpy.context.view_layer.update()
    for camera in scene.cameras[::10]:
        lodgs("data.photographs").match_render(bpy.context.scene, camera)
        obj = bpy.data.objects[camera.name]
        inside = 0
        for point in scene.points[::197].astype(np.float64):
            x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            projected = world_to_camera_view(
                bpy.context.scene, obj, root.lodgs.axes.matrix_world @ Vector(point)
            )
            if z > 0 and 0 < u < camera.width and 0 < v < camera.height:
                inside += 1
                assert projected.x * camera.width == pytest.approx(u, abs=0.01)
                assert (1 - projected.y) * camera.height == pytest.approx(v, abs=0.01)
        assert inside > 10


def test_shifted_and_stretched_pixels(bpy, lodgs):
    """Shifted principal points and unequal focal lengths, compared with Blender's projection matrix."""
    from training.scenes.cameras import Camera

    for width, height in ((640, 480), (480, 640)):
        camera = Camera("a", width, height, 500.0, 550.0, 300.0, 260.0, np.eye(4))
        obj = lodgs("data.photographs").new_camera(camera, 1.0, 0.01, photograph=False)
        bpy.context.scene.collection.objects.link(obj)
        lodgs("data.photographs").match_render(bpy.context.scene, camera)
        bpy.context.view_layer.update()
        render = bpy.context.scene.render
        projection = np.array(
            obj.calc_matrix_camera(
                bpy.context.evaluated_depsgraph_get(), x=width, y=height,
                scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y,
            )
        )  # fmt: skip
        point = np.array([0.3, -0.2, 2.0])
        x, y, _, w = projection @ np.append(point * [1, -1, -1], 1)
        u, v = (x / w + 1) / 2 * width, (1 - y / w) / 2 * height
        assert u == pytest.approx(500 * 0.15 + 300, abs=1e-3)
        assert v == pytest.approx(550 * -0.1 + 260, abs=1e-3)


def test_operator_imports_cameras_photos_and_points_upright(bpy, mini):
    scene = read_scene(mini)
    assert bpy.ops.lodgs.import_colmap(directory=str(mini)) == {"FINISHED"}
    (root,) = [o for o in bpy.data.objects if o.lodgs.is_root]
    bpy.context.view_layer.update()

    cameras = [o for o in root.children_recursive if o.type == "CAMERA"]
    assert sorted(o.name for o in cameras) == [c.name for c in scene.cameras]
    photos = [o.data.background_images[0].image for o in cameras]
    assert all(Path(photo.filepath).is_file() for photo in photos)
    up = np.mean([np.array(o.matrix_world)[:3, 1] for o in cameras], axis=0)
    assert up[2] > 0.9 * np.linalg.norm(up)

    (cloud,) = [o for o in root.children_recursive if o.type == "POINTCLOUD"]
    positions = np.empty(len(cloud.data.points) * 3, np.float32)
    cloud.data.attributes["position"].data.foreach_get("vector", positions)
    assert np.array_equal(positions.reshape(-1, 3), scene.points)
    code = scene.point_colors[5] / 255
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    assert cloud.data.attributes["display_color"].data[5].color[:3] == pytest.approx(linear, abs=1e-6)

    assert bpy.context.scene.camera in cameras
    assert (bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y) == (366, 553)
    assert Path(root.lodgs.scene_folder) == mini
    centers = np.mean([c.center for c in scene.cameras], axis=0)
    assert tuple(root.lodgs.camera_center) == pytest.approx(centers, abs=1e-5)


def test_look_through_cycles_through_views_by_name(bpy, lodgs, shared_scenes):
    """It wraps around, starts at the selected view, and sets the size of renders."""
    scene = read_scene(shared_scenes / "variants" / "multicam_subfolders")
    lodgs("data.importing").import_colmap(bpy.context, scene.folder, photographs=False)
    sizes = {camera.name: (camera.width, camera.height) for camera in scene.cameras}
    names = sorted(sizes)
    assert len(set(sizes.values())) > 1
    render = bpy.context.scene.render

    def look(step):
        assert bpy.ops.lodgs.look_through(step=step) == {"FINISHED"}
        assert (render.resolution_x, render.resolution_y) == sizes[bpy.context.scene.camera.name]
        return bpy.context.scene.camera.name

    assert [look(1) for _ in names] == names[1:] + names[:1]
    assert [look(-1), look(0)] == [names[-1]] * 2
    bpy.context.view_layer.objects.active = bpy.data.objects[names[2]]
    assert look(0) == names[2]
    bpy.context.scene.camera = None
    bpy.context.view_layer.objects.active = None
    assert look(0) == names[0]


def test_first_level_hides_points(bpy, lodgs, mini):
    root = lodgs("data.importing").import_colmap(bpy.context, mini)
    points, cameras = root.lodgs.points, root.lodgs.cameras
    assert points.type == "POINTCLOUD" and len(cameras.objects) == 32
    level = lodgs("training.splats.levels").Level(
        1,
        lodgs("training.splats.gaussians").Splats(
            *(np.zeros((4, n), np.float32) for n in (3, 4, 3)),
            np.zeros(4, np.float32),
            np.zeros((4, 1, 3), np.float32),
        ),
        0.1,
    )
    obj = lodgs("data.scenes").set_level(root, level)
    bpy.context.view_layer.update()
    assert obj.visible_get() and not points.visible_get()
    points.hide_viewport = False
    lodgs("data.scenes").set_level(root, level)
    assert not points.hide_viewport  # the user's setting is kept


def test_training_uses_the_model_and_photos_of_the_import(bpy, lodgs, mini, tmp_path):
    scene = read_scene(mini)
    root = lodgs("data.importing").import_colmap(bpy.context, mini)
    job = lodgs("runs.job_settings").make_job(root, tmp_path, {})
    assert (job.model, job.images) == ("", "")
    root = lodgs("data.importing").import_colmap(
        bpy.context, mini, model=scene.model, images=str(scene.images_folder), photographs=False
    )
    job = lodgs("runs.job_settings").make_job(root, tmp_path, {})
    assert (Path(job.model), Path(job.images)) == (scene.model, scene.images_folder)


def test_existing_camera_stays_active(bpy, lodgs, mini):
    camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    size = bpy.context.scene.render.resolution_x
    lodgs("data.importing").import_colmap(bpy.context, mini, upright=False, photographs=False)
    assert bpy.context.scene.camera == camera and bpy.context.scene.render.resolution_x == size
    assert not bpy.data.images


@pytest.mark.parametrize(
    "name",
    ["multicam_subfolders", "names_unicode_spaces", "missing_images", "empty_points3D", "flat_sparse",
     "distorted_simple_radial"],
)  # fmt: skip
def test_irregular_scenes_import(bpy, lodgs, shared_scenes, name):
    folder = shared_scenes / "variants" / name
    scene, messages = read_scene(folder), []
    root = lodgs("data.importing").import_colmap(bpy.context, folder, warn=messages.append)
    assert len([o for o in root.children_recursive if o.type == "CAMERA"]) == len(scene.cameras) > 0
    assert bool([o for o in root.children_recursive if o.type == "POINTCLOUD"]) == bool(len(scene.points))
    assert all(message in messages for message in scene.warnings)
    views = lodgs("data.photographs").views(root)
    assert bool(scene.distorted) == any(view.data.lodgs.distorted for view in views)


def test_failed_import_leaves_no_data(bpy, lodgs, tmp_path, mini, monkeypatch):
    before = count_data(bpy)
    with pytest.raises(RuntimeError, match="no COLMAP model"):
        bpy.ops.lodgs.import_colmap(directory=str(tmp_path))
    assert count_data(bpy) == before

    def fail(*args, **kwargs):
        raise lodgs("training.errors").LodgsError("No room.", "Make some.")

    monkeypatch.setattr(lodgs("data.objects"), "new_points", fail)
    with pytest.raises(RuntimeError, match=r"No room\. \nMake some\."):
        bpy.ops.lodgs.import_colmap(directory=str(mini))
    assert count_data(bpy) == before
    assert bpy.context.scene.camera is None


def test_undo_removes_the_import(bpy, mini):
    bpy.ops.ed.undo_push(message="before")
    before = count_data(bpy)
    bpy.ops.lodgs.import_colmap("EXEC_DEFAULT", True, directory=str(mini))  # True: one undo step, as by hand
    assert count_data(bpy)["cameras"] > before["cameras"]
    bpy.ops.ed.undo()
    assert count_data(bpy) == before


def test_export_of_another_program_is_imported(bpy, lodgs, tmp_path):
    """Cameras have the matrices of nerfstudio's file, and the folder becomes a COLMAP scene."""
    poses = [np.eye(4), np.eye(4)]
    poses[1][:3, 3] = 1, 2, 3
    frames = []
    for number, pose in enumerate(poses):
        write_png(tmp_path / f"{number}.png", np.zeros((30, 40, 3), np.uint8))
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    messages = []
    root = lodgs("data.importing").import_colmap(bpy.context, tmp_path, upright=False, warn=messages.append)
    assert "Training creates them from the photos" in messages[0]  # points
    bpy.context.view_layer.update()
    for number, pose in enumerate(poses):
        camera = next(obj for obj in root.lodgs.cameras.objects if obj.name == f"{number}.png")
        np.testing.assert_allclose(camera.matrix_world, pose, atol=1e-5)  # both look along -z
        assert camera.data.angle_x == pytest.approx(1.0, abs=1e-4)
    assert len(read_scene(tmp_path).cameras) == 2


def test_long_photo_names_are_supported_or_reported(bpy, lodgs, tmp_path):
    """One name exceeds Blender's limit; the other exceeds the file system's, so its photo is missing."""
    long, longer = f"{'a' * 150}/{'b' * 146}.png", "c" * 300 + ".png"
    write_png(tmp_path / "one.png", np.zeros((30, 40, 3), np.uint8))
    for name in (long, "d.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).hardlink_to(tmp_path / "one.png")
    (tmp_path / "one.png").unlink()
    lens = make_intrinsics("PINHOLE", 40, 30, np.array([40.0, 40, 20, 15]))
    poses = [(name, np.eye(4)) for name in (long, longer, "d.png")]
    write_model(tmp_path / "sparse" / "0", [lens] * 3, poses, np.ones((4, 3)), np.zeros((4, 3), np.uint8))
    messages = []
    root = lodgs("data.importing").import_colmap(bpy.context, tmp_path, warn=messages.append)
    views = lodgs("data.photographs").views(root)
    assert len(views) == 2 and sum("ccc" in message for message in messages) == 1
    for view in views:
        lodgs("data.photographs").use_view(bpy.context, view)


def test_damaged_export_is_rejected(bpy, lodgs, tmp_path):
    (tmp_path / "transforms.json").write_text("{")
    before = count_data(bpy)
    with pytest.raises(RuntimeError, match=r"transforms\.json is not valid"):
        bpy.ops.lodgs.import_colmap(directory=str(tmp_path))
    assert count_data(bpy) == before and [path.name for path in tmp_path.iterdir()] == ["transforms.json"]


def test_scene_without_points_shows_cameras_then_triangulated_points(bpy, lodgs, tmp_path):
    """Blender reads the points from the trainer's cache, as it has no pycolmap."""
    folder, messages = write_walls(tmp_path / "walls"), []
    import_colmap = lodgs("data.importing").import_colmap
    root = import_colmap(bpy.context, folder, warn=messages.append)
    assert len(lodgs("data.photographs").views(root)) == 6 and root.lodgs.points is None
    (message,) = messages
    assert "has no points" in message and "Training creates them from the photos." in message
    triangulate = lodgs("training.scenes.triangulate")
    scene = read_scene(folder)
    cached = folder / triangulate.CACHE_FOLDER / triangulate._digest(scene, 0.0)
    lens = make_intrinsics("PINHOLE", 320, 240, np.array([300.0, 300, 160, 120]))
    poses = [(camera.name, camera.world_to_camera) for camera in scene.cameras]
    points = np.random.default_rng(0).normal(size=(50, 3))
    write_model(cached / "sparse", [lens] * 6, poses, points, np.full((50, 3), 99, np.uint8))
    (cached / "summary.json").write_text('{"message": "Triangulated 50 points.", "warnings": []}')
    messages.clear()
    root = import_colmap(bpy.context, folder, warn=messages.append)
    assert messages == [] and len(root.lodgs.points.data.points) == 50


@pytest.mark.parametrize("model", ["sparse", "sparse/0"])
def test_scene_of_a_chosen_model_has_the_name_of_its_folder(bpy, lodgs, tmp_path, model):
    write_walls(tmp_path / "walls")
    root = lodgs("data.importing").import_colmap(bpy.context, tmp_path / "walls" / model, warn=lambda _: None)
    assert root.name == "walls" and len(lodgs("data.photographs").views(root)) == 6


def _drop(bpy, path):
    """Drop a file into a 3D viewport, as a window does."""
    area = next(area for area in bpy.context.screen.areas if area.type == "VIEW_3D")
    with bpy.context.temp_override(area=area):
        return bpy.ops.wm.drop_import_file(
            "INVOKE_DEFAULT", directory=f"{path.parent}{os.sep}", files=[{"name": path.name}]
        )


@pytest.mark.parametrize("name", ["sparse/0/cameras.txt", "sparse/0/extra.bin", "transforms.json"])
def test_dropped_file_imports_its_scene(bpy, tmp_path, name):
    write_walls(tmp_path)
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 90}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    (tmp_path / "sparse/0/extra.bin").touch()
    _drop(bpy, tmp_path / name)
    (root,) = (obj for obj in bpy.data.objects if obj.lodgs.is_root)
    assert root.lodgs.scene_folder == str(tmp_path)
    assert root.lodgs.training.model == ""


def test_dropped_file_selects_its_model(bpy, tmp_path):
    write_walls(tmp_path)
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    _drop(bpy, tmp_path / "sparse/1/images.txt")
    (root,) = (obj for obj in bpy.data.objects if obj.lodgs.is_root)
    assert root.lodgs.scene_folder == str(tmp_path)
    assert root.lodgs.training.model == str(tmp_path / "sparse/1")


def test_dropped_file_of_no_scene_is_rejected(bpy, tmp_path):
    write_walls(tmp_path / "scene")  # scenes in subfolders do not count
    (tmp_path / "notes.txt").write_text("notes")
    with pytest.raises(RuntimeError, match="neither") as error:
        bpy.ops.lodgs.drop_photo_scene(filepath=str(tmp_path / "notes.txt"))
    assert max(map(len, str(error.value).splitlines())) <= 190, "Windows cut off long lines."
