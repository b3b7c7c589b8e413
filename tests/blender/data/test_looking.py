"""The viewport's view of imported scenes, and imports that run out of memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from training.scenes.colmap import read_scene
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
KINDS = ("objects", "collections", "pointclouds", "cameras", "images", "meshes", "scenes")


def data_names(bpy) -> dict[str, list[str]]:
    return {kind: sorted(data.name for data in getattr(bpy.data, kind)) for kind in KINDS}


def ball(count: int, outliers: int) -> Splats:
    """Return splats within 2 of (10, 20, 30), and far outliers."""
    rng = np.random.default_rng(0)
    means = np.float32((10, 20, 30)) + rng.uniform(-1, 1, (count, 3))
    means[:outliers] = rng.uniform(1e3, 1e6, (outliers, 3))
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.zeros((count, 3), np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def test_framing_ignores_outliers(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball(900, 18))]))  # too few to estimate a view
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply", upright=False)
    root.scale, root.location = (2, 2, 2), (0, 0, 5)
    assert lodgs("data.photographs").photo_viewpoint(root) is None
    center, size = lodgs("data.photographs").central_bounds(root)
    np.testing.assert_allclose(center, (20, 40, 65), atol=0.3)
    assert size == pytest.approx(2 * 2 * 0.9 * 3**0.5, rel=0.1)
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    assert lodgs("data.photographs").central_bounds(parent) is None
    root.parent, parent.location, parent.scale = parent, (100, 0, 0), (3, 3, 3)
    bpy.context.view_layer.update()
    moved_center, moved_size = lodgs("data.photographs").central_bounds(root)
    np.testing.assert_allclose(moved_center, (160, 120, 195), atol=1)
    assert moved_size == pytest.approx(3 * size, rel=1e-5)


def test_framing_ignores_the_far_background(bpy, lodgs, tmp_path):
    """A cube of side 2 with a third of the splats on a distant circle, such as buildings around a square."""
    splats, angles = ball(900, 0), np.linspace(0, 2 * np.pi, 300)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(300)])
    splats.means[:300] = (10, 20, 30) + 50 * circle
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats)]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply", upright=False)
    center, size = lodgs("data.photographs").central_bounds(root)
    np.testing.assert_allclose(center, (10, 20, 30), atol=0.3)
    assert size == pytest.approx(2 * 0.9 * 3**0.5, rel=0.1)


def test_framing_ignores_cropped_and_hidden_splats(bpy, lodgs, tmp_path):
    from mathutils import Matrix

    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball(2000, 40))]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply", upright=False)
    bounds, cleaning = lodgs("data.photographs").central_bounds, lodgs("data.cleaning")
    corner = Matrix.Translation((9.5, 19.5, 29.5)) @ Matrix.Diagonal((0.5, 0.5, 0.5, 1))
    crop = lodgs("data.crops").new_crop(root, "BOX", corner)
    bpy.context.view_layer.update()
    center, size = bounds(root)
    np.testing.assert_allclose(center, (9.5, 19.5, 29.5), atol=0.1)
    assert size == pytest.approx(0.9 * 3**0.5, rel=0.1)
    means = ball(2000, 40).means
    cleaning.hide(root, {1: means[:, 0] < 9.5})
    np.testing.assert_allclose(bounds(root)[0], (9.75, 19.5, 29.5), atol=0.1)
    crop.location.x += 1e4
    bpy.context.view_layer.update()
    assert bounds(root)[1] == pytest.approx(2 * 0.9 * 3**0.5, rel=0.1), "all splats count if none remain"


def test_viewports_start_at_the_central_photo(bpy, lodgs):
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.location = (1, 2, 3)
    bpy.context.view_layer.update()
    position, target = lodgs("data.photographs").photo_viewpoint(root)
    scene = read_scene(GARDEN)
    central = min(scene.cameras, key=lambda camera: float(np.linalg.norm(camera.center - scene.center)))
    points = (central.world_to_camera[:3, :3] @ scene.points.T).T + central.world_to_camera[:3, 3]
    view = bpy.data.objects[central.name]
    np.testing.assert_allclose(position, view.matrix_world.translation, atol=1e-4)
    assert (target - position).length == pytest.approx(np.median(points[points[:, 2] > 0, 2]), rel=1e-4)
    direction = np.array(view.matrix_world)[:3, 2] * -1
    np.testing.assert_allclose((target - position).normalized(), direction, atol=1e-4)


def test_blocking_meshes_are_hidden_and_reported(bpy, lodgs):
    """Like the cube of a new file, which may enclose the camera or occlude the scene."""
    camera, target = lodgs("data.photographs").photo_viewpoint(
        lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    )
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    forward = target - camera
    side = forward.cross((0, 0, 1)).normalized()
    locations = {
        "around camera": camera, "in front": camera + 0.6 * forward, "behind": camera - forward.normalized(),
        "beyond": camera + 1.4 * forward, "beside": camera + 0.5 * forward + side,
    }  # fmt: skip
    for name, location in locations.items():
        bpy.ops.mesh.primitive_cube_add(location=location, size=0.4, rotation=(0.3, 0.2, 0.1))
        bpy.context.object.name = name
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    cubes = bpy.data.objects
    assert [name for name in locations if not cubes[name].visible_get()] == ["around camera", "in front"]
    assert not cubes["around camera"].hide_render and not cubes["around camera"].hide_viewport
    messages = []
    cubes["around camera"].hide_set(False)
    root = lodgs("data.roots").roots(bpy.context.scene)[0]
    lodgs("data.photographs").look_at_scene(bpy.context, root, messages.append)
    assert messages == ["Hid 'around camera', which blocks the view of the splats. Press Alt+H to show it."]


def test_plain_splats_open_upright_from_a_clear_view(bpy, lodgs, tmp_path):
    """A round garden, z up and far from the origin, with outliers. Its file names no up axis."""
    rng = np.random.default_rng(1)
    means = rng.uniform(-4, 4, (9000, 3)) * (1, 1, 0.1) + (0, 0, 0.4)
    means[:6000, 2] = 0
    means[np.hypot(*means[:, :2].T) > 4] *= (0.5, 0.5, 1)
    means = means.astype(np.float32) + np.float32((300, -200, 50))
    means[:200] += 1e4
    splats = replace(ball(9000, 0), means=means, log_scales=np.full((9000, 3), -3, np.float32))
    write_ply(tmp_path / "garden.ply", splats)
    messages = []
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "garden.ply", warn=messages.append)
    assert messages == [line for line in messages if line.startswith("200 splats are more than")] and messages
    bpy.context.view_layer.update()
    level = root.lodgs.levels[0].object
    np.testing.assert_allclose(level.matrix_world.to_3x3(), np.eye(3), atol=1e-6)
    camera, target = lodgs("data.photographs").photo_viewpoint(root)
    np.testing.assert_allclose(target, (300, -200, 50), atol=1)
    assert camera.z > target.z + 0.5 and 3 < (camera - target).length < 12


@pytest.mark.parametrize(("edited", "saved"), [(False, False), (False, True), (True, False)])
def test_unchanged_startup_objects_are_hidden(bpy, lodgs, tmp_path, edited, saved):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    if saved:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    if edited:
        bpy.data.objects["Cube"].location.x = 1
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball(2000, 40))]))
    bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.ply"))
    bpy.context.view_layer.update()
    visible = [bpy.data.objects[name].visible_get() for name in ("Cube", "Light", "Camera")]
    assert visible == ([True] * 3 if edited else [False, False, True])
    assert ("Startup Objects" in bpy.data.collections) != edited


def test_photo_camera_replaces_the_startup_camera(bpy, lodgs):
    """Training on the cameras of the file uses the photos of this scene only."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    (root,) = lodgs("data.roots").roots(bpy.context.scene)
    photos, viewpoints = lodgs("data.photographs").views(root), lodgs("data.viewpoints")
    assert bpy.context.scene.camera == photos[0] and not bpy.data.objects["Camera"].visible_get()
    root.lodgs.training.views_from = "CAMERAS"
    assert viewpoints.view_count(root.lodgs.training) == len(photos)
    bpy.ops.lodgs.import_colmap(directory=str(GARDEN), photographs=False)
    other = next(other for other in lodgs("data.roots").roots(bpy.context.scene) if other != root)
    assert viewpoints.view_count(root.lodgs.training) == len(photos)
    assert viewpoints.enabled_cameras(bpy.context.scene, other) == lodgs("data.photographs").views(other)
    loose = bpy.data.objects.new("loose", bpy.data.cameras.new("loose"))
    bpy.context.scene.collection.objects.link(loose)
    assert viewpoints.view_count(root.lodgs.training) == len(photos) + 1
    loose.hide_render = True
    assert viewpoints.view_count(root.lodgs.training) == len(photos)


@pytest.mark.parametrize("disabled", ["hide_render", "exclude"])
def test_cameras_of_a_disabled_collection_are_not_used(bpy, lodgs, disabled):
    outer, inner = (bpy.data.collections.new(name) for name in ("outer", "inner"))
    bpy.context.scene.collection.children.link(outer)
    outer.children.link(inner)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    inner.objects.link(camera)
    cameras, layer = lodgs("data.cameras"), bpy.context.view_layer.layer_collection.children["outer"]
    assert cameras.enabled_cameras(bpy.context.scene) == [camera]
    setattr(outer if disabled == "hide_render" else layer, disabled, True)
    assert cameras.enabled_cameras(bpy.context.scene) == []


@pytest.mark.parametrize("hidden", [False, True])
def test_views_of_hidden_cameras_of_a_reopened_file(bpy, lodgs, tmp_path, hidden):
    """Blender evaluates no hidden cameras except the active one."""
    collection, target = bpy.data.collections.new("cameras"), bpy.data.objects.new("target", None)
    bpy.context.scene.collection.children.link(collection)
    bpy.context.scene.collection.objects.link(target)
    for number in range(3):
        camera = bpy.data.objects.new(f"camera {number}", bpy.data.cameras.new("camera"))
        collection.objects.link(camera)
        camera.location = (5 + number, 1, 2)
        camera.constraints.new("TRACK_TO").target = target
    bpy.context.scene.camera, bpy.context.scene.lodgs_capture.views_from = camera, "CAMERAS"
    bpy.context.view_layer.update()
    expected = [np.array(camera.matrix_world.inverted())[2] for camera in collection.objects]
    collection.hide_viewport = hidden
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
    views = lodgs("data.viewpoints").capture_views(bpy.context, 64, 48)
    for (view, _), backward in zip(views, expected, strict=True):
        np.testing.assert_allclose(view.world_to_camera[2], -backward, atol=1e-5)
    assert bpy.context.scene.camera.name == "camera 2"


def test_invalid_control_changes_nothing(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "b.ply", Bundle("mine", [Level(1, ball(5, 0))]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    invalid = Bundle("flod", [], "bands", controls={"gamma": -1.0}, meta={"a": 1})
    before = {name: getattr(root.lodgs, name) for name in ("method", "rule", "cumulative", "meta", "mode")}
    with pytest.raises(lodgs("training.errors").LodgsError, match="gamma = -1"):
        lodgs("data.scenes").set_bundle_facts(root, invalid)
    assert {name: getattr(root.lodgs, name) for name in before} == before


@pytest.mark.parametrize("fails_at", [1, 4])
@pytest.mark.parametrize("operation", ["splats", "colmap", "level"])
def test_out_of_memory_leaves_no_data(bpy, lodgs, monkeypatch, tmp_path, operation, fails_at):
    """Memory runs out at the first or a later array."""
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball(5, 0))]))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    before = data_names(bpy)
    objects, written = lodgs("data.objects"), []
    write = objects.write_attribute

    def write_or_fail(*arguments):
        written.append(arguments)
        if len(written) >= min(fails_at, 2 if operation == "colmap" else fails_at):
            raise MemoryError
        write(*arguments)

    monkeypatch.setattr(objects, "write_attribute", write_or_fail)
    if operation == "level":
        with pytest.raises(MemoryError):
            lodgs("data.scenes").set_level(root, Level(2, ball(7, 0)))
    else:
        path = {"directory": str(GARDEN)} if operation == "colmap" else {"filepath": str(tmp_path / "b.ply")}
        with pytest.raises(RuntimeError, match="Out of memory"):
            getattr(bpy.ops.lodgs, f"import_{operation}")(**path)
    assert data_names(bpy) == before
    assert [item.number for item in root.lodgs.levels] == [1] and bpy.context.scene.camera is None
