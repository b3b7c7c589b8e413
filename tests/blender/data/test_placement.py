"""Placement of scenes: artists move the root; operators set ground and scale on its child, the axes."""

import re
from pathlib import Path

import numpy as np
import pytest

from training.editing.placement import transform_bundle
from training.lod.rules.chunks import member_columns
from training.splats.bundle import read_bundle, write_bundle
from training.splats.formats import open_as_ply
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder
from training.splats.levels import Bundle, Level
from training.splats.similarity import Similarity

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


def random_splats(count: int, seed: int) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 2, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-2, 0.5, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0, 2, count).astype(np.float32),
        sh=rng.normal(0, 0.5, (count, 16, 3)).astype(np.float32),
    )


def lodge_bundle() -> Bundle:
    """Return a bundle of two levels with chunks. Facts and tables contain lengths and positions."""
    rng = np.random.default_rng(5)
    levels = [Level(1, random_splats(40, 1), {"d_l": 4.0}), Level(2, random_splats(90, 2), {"d_l": 0.0})]
    for level in levels:
        level.splats.extras |= member_columns(rng.random((3, len(level.splats))) < 0.5)
    table = {name: rng.uniform(1, 3, 3).astype(np.float32) for name in ("x", "y", "z", "radius")}
    meta = {"camera_center": [0.0, 0.5, -4.0], "view": [[0.0, 0, -4], [0.0, 0, 0]], "median_depth": 4.0}
    return Bundle("lodge", levels, "chunks", meta=meta, tables={"chunks": table})


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "in.ply", lodge_bundle())
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    bpy.context.view_layer.update()
    return root


def level_matrix(root) -> np.ndarray:
    return np.array(root.lodgs.levels[-1].object.matrix_world, np.float64)


def select(bpy, *objects):
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[-1]


@pytest.mark.parametrize("tool", ["translate", "rotate", "resize"])
def test_tools_do_not_move_single_levels(bpy, root, tool):
    """Blender's Apply would change the positions of splats, but neither their scales nor their rotations."""
    level = root.lodgs.levels[-1].object
    select(bpy, level)
    getattr(bpy.ops.transform, tool)(value=2.0 if tool == "rotate" else (2.0, 2.0, 2.0))
    bpy.ops.object.transform_apply()
    positions = [point.co for point in level.data.points]
    assert np.array(positions) == pytest.approx(lodge_bundle().levels[-1].splats.means)
    assert np.array(level.matrix_basis) == pytest.approx(np.eye(4))


def select_empties(bpy, root, locations):
    """Select new empties at world locations and the root, which is active."""
    marks = [bpy.data.objects.new("mark", None) for _ in locations]
    for obj, location in zip(marks, locations, strict=True):
        obj.location = location
        bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    select(bpy, *marks, root)
    return marks


@pytest.mark.parametrize("source", ["splats", "colmap"])
def test_root_starts_without_a_transform_and_can_be_cleared(bpy, lodgs, root, source):
    if source == "colmap":
        root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    assert root.rotation_mode == "XYZ" and np.array_equal(np.array(root.matrix_basis), np.eye(4))
    bpy.context.view_layer.update()
    part = root.lodgs.points or root.lodgs.levels[-1].object
    upright = np.array(part.matrix_world)
    assert abs(upright[:3, :3] - np.eye(3)).max() > 0.1
    root.location, root.rotation_euler, root.scale = (1, 2, 3), (0, 0, 0.5), (2, 2, 2)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(part.matrix_world, np.array(root.matrix_world) @ upright, atol=1e-6)
    select(bpy, root.lodgs.axes, root)
    for operator in (
        bpy.ops.object.rotation_clear,
        bpy.ops.object.location_clear,
        bpy.ops.object.scale_clear,
    ):
        operator()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(part.matrix_world, upright, atol=1e-6)


def test_applying_the_roots_transform_keeps_the_placement(bpy, lodgs, root):
    root.location, root.rotation_euler, root.scale = (1, 2, 3), (0.1, 0.2, 0.5), (2, 2, 2)
    bpy.context.view_layer.update()
    before = level_matrix(root)
    select(bpy, root)
    bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(level_matrix(root), before, atol=1e-6)
    np.testing.assert_allclose(lodgs("data.placement").placement_of(root).matrix, before, atol=1e-5)


def test_duplicated_hierarchy_has_its_own_axes(bpy, lodgs, root):
    levels = [item.object for item in root.lodgs.levels]
    root.lodgs.mode = "SELECTIVE"  # both levels are visible
    bpy.context.view_layer.update()
    select(bpy, *levels, root.lodgs.axes, root)
    bpy.ops.object.duplicate()
    copy = bpy.context.view_layer.objects.active
    assert copy != root and copy.lodgs.axes.parent == copy and copy.lodgs.axes != root.lodgs.axes
    assert copy.lodgs.levels[0].object.parent == copy.lodgs.axes
    copy.location = (9, 0, 0)
    bpy.context.view_layer.update()
    placement_of = lodgs("data.placement").placement_of
    np.testing.assert_allclose(placement_of(copy).translation - placement_of(root).translation, (9, 0, 0))


def test_ground_through_three_empties_is_at_zero(bpy, root):
    root.location, root.rotation_euler = (1, 1, 1), (0, 0, 0.7)
    locations = np.array([[0, 0, 1.0], [2, 0, 1.5], [0, 2, 0.8]])
    marks = select_empties(bpy, root, locations)
    before, root_matrix = level_matrix(root), np.array(root.matrix_basis)
    local = (np.linalg.inv(before) @ np.column_stack([locations, np.ones(3)]).T)[:3].T
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.lodgs.set_ground() == {"FINISHED"}
    bpy.context.view_layer.update()
    after = level_matrix(root)
    moved = local @ after[:3, :3].T + after[:3, 3]
    np.testing.assert_allclose(moved[:, 2], 0, atol=1e-5)
    np.testing.assert_allclose(moved.mean(axis=0)[:2], locations.mean(axis=0)[:2], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0), axis=1),
                               np.linalg.norm(np.diff(locations, axis=0), axis=1), atol=1e-5)  # fmt: skip
    np.testing.assert_array_equal(np.array(root.matrix_basis), root_matrix)
    assert [tuple(mark.location) for mark in marks] == [tuple(np.float32(location)) for location in locations]
    up = after[:3, :3] @ np.linalg.inv(before[:3, :3]) @ [0, 0, 1]
    assert up[2] > 0.9
    bpy.ops.lodgs.set_ground(flip=True)
    bpy.context.view_layer.update()
    flipped = level_matrix(root)[:3, :3] @ np.linalg.inv(after[:3, :3]) @ [0, 0, 1]
    assert flipped[2] < -0.9


@pytest.mark.parametrize("operator", ["set_ground", "find_clutter"])
def test_transform_that_is_not_finite_is_rejected(bpy, root, operator):
    root.location = (np.nan, 0, 0)
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match=r"it has numbers that are not finite .*\s+Clear it"):
        getattr(bpy.ops.lodgs, operator)()


def test_ground_fits_points_selected_in_edit_mode(bpy, lodgs):
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    bpy.context.view_layer.update()
    cloud = root.lodgs.points
    select(bpy, cloud)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.pointcloud.select_all(action="DESELECT")
    with pytest.raises(RuntimeError, match="three selected points or more, not 0"):
        bpy.ops.lodgs.set_ground()
    positions = np.empty((len(cloud.data.points), 3), np.float32)
    cloud.data.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
    selection = np.zeros(len(positions), bool)
    selection[[10, 200, 500, 900]] = True
    cloud.data.attributes[".selection"].data.foreach_set("value", selection)
    assert bpy.context.mode == "EDIT_POINTCLOUD"  # also after the error
    assert bpy.ops.lodgs.set_ground() == {"FINISHED"}
    assert bpy.context.mode == "OBJECT"
    bpy.context.view_layer.update()
    matrix = np.array(cloud.matrix_world)
    moved = positions @ matrix[:3, :3].T + matrix[:3, 3]
    heights = moved[selection][:, 2]
    assert abs(heights.mean()) < 1e-5
    assert (
        np.square(heights).sum()
        < np.square(np.linalg.svd(moved[selection] - moved[selection].mean(0))[1][2]) + 1e-6
    )


def test_ground_is_detected(bpy, lodgs, capfd):
    """The ground of the example is z = 0 in scene coordinates. The root is rotated and moved."""
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.rotation_euler, root.location = (0.2, -0.1, 1.0), (0, 0, 5)
    bpy.context.view_layer.update()
    up = lodgs("data.placement").placement_of(root).rotation[:, 2]
    bpy.ops.lodgs.set_ground(by="DETECT")
    rotated = re.search(r"rotated by ([\d.]+)°", capfd.readouterr().out)
    assert rotated and float(rotated[1]) == pytest.approx(np.degrees(np.arccos(up[2])), abs=0.6)
    bpy.context.view_layer.update()
    placement = lodgs("data.placement").placement_of(root)
    np.testing.assert_allclose(placement.rotation[2], (0, 0, 1), atol=0.01)  # z is up in the scene
    assert abs(placement.translation[2]) < 0.05


def test_scale_follows_a_length_between_two_empties(bpy, lodgs):
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    bpy.ops.lodgs.set_ground(by="DETECT")
    bpy.context.view_layer.update()
    view = root.lodgs.cameras.objects[0]
    before, near = np.array(root.lodgs.points.matrix_world), view.data.clip_start
    select_empties(bpy, root, [(1, 0, 0), (1, 2, 0)])
    assert bpy.ops.lodgs.set_scale(length=5.0) == {"FINISHED"}
    bpy.context.view_layer.update()
    after = np.array(root.lodgs.points.matrix_world)
    np.testing.assert_allclose(after, np.diag([2.5, 2.5, 2.5, 1]) @ before, atol=1e-5)
    assert view.data.clip_start == pytest.approx(2.5 * near)
    assert tuple(root.scale) == (1, 1, 1)


@pytest.mark.parametrize(
    "locations,message",
    [([(0, 0, 0)], "not 1"), ([(1, 1, 1)] * 2, "same position"), ([(0, 0, 0)] * 3, "not 3")],
)
def test_selection_without_a_length_is_rejected(bpy, root, locations, message):
    select_empties(bpy, root, locations)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.lodgs.set_scale(length=1.0)


def test_stretched_root_is_rejected(bpy, lodgs, root, tmp_path):
    root.scale = (1, 1, 2)
    bpy.context.view_layer.update()
    for operation in (
        lambda: bpy.ops.lodgs.set_ground(by="DETECT"),
        lambda: bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "no.ply"), placed=True),
    ):
        with pytest.raises(RuntimeError, match="stretched"):
            operation()
    assert not (tmp_path / "no.ply").exists()


def test_setting_the_ground_is_undone(bpy, root):
    name = root.name
    select_empties(bpy, root, [(0, 0, 0), (2, 0, 1), (0, 2, 0)])
    bpy.ops.ed.undo_push(message="start")
    before = level_matrix(root)
    bpy.ops.lodgs.set_ground()
    bpy.ops.ed.undo_push(message="ground")
    bpy.context.view_layer.update()
    assert not np.allclose(level_matrix(root), before)
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(level_matrix(bpy.data.objects[name]), before, atol=1e-6)


def place_root(bpy, root):
    root.location, root.rotation_euler, root.scale = (1, -2, 3), (0.4, -0.2, 0.9), (2.5, 2.5, 2.5)
    bpy.context.view_layer.update()


def test_bundle_exported_as_placed_keeps_its_place(bpy, lodgs, root, tmp_path):
    place_root(bpy, root)
    matrix = level_matrix(root)
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"), placed=True)
    exported = read_bundle(tmp_path / "out.ply")
    placement = lodgs("data.placement").placement_of(root)
    expected = transform_bundle(lodge_bundle(), Similarity.from_matrix(placement.matrix))
    assert exported.meta["up_rotation"] == np.eye(3).tolist()
    np.testing.assert_allclose(exported.meta["camera_center"], expected.meta["camera_center"])
    for exported_level, level in zip(exported.levels, expected.levels, strict=True):
        assert exported_level.facts == pytest.approx(level.facts, rel=1e-12)  # last bits depend on the CPU
    for column in ("x", "radius"):
        np.testing.assert_allclose(
            exported.tables["chunks"][column], expected.tables["chunks"][column], rtol=1e-6
        )
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply")
    bpy.context.view_layer.update()
    np.testing.assert_allclose(level_matrix(reimported), np.eye(4), atol=1e-6)
    for exported_level, original in zip(exported.levels, lodge_bundle().levels, strict=True):
        np.testing.assert_allclose(
            exported_level.splats.means, original.splats.means @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5
        )
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "plain.ply"))
    unplaced = read_bundle(tmp_path / "plain.ply")
    np.testing.assert_allclose(unplaced.levels[1].splats.means, exported.levels[1].splats.means)


def test_plain_files_exported_as_placed_stay_upright(bpy, lodgs, root, tmp_path):
    place_root(bpy, root)
    matrix, means = level_matrix(root), lodge_bundle().levels[1].splats.means
    names = "a.ply", "a.compressed.ply", "a.glb"
    for name in names:
        bpy.ops.lodgs.export_plain(filepath=str(tmp_path / name), source="LEVEL", level=2, placed=True)
    for name in names:
        reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / name)
        bpy.context.view_layer.update()
        np.testing.assert_allclose(level_matrix(reimported), np.eye(4), atol=1e-6)
    with open_as_ply(tmp_path / "a.glb") as ply:
        placed = read_bundle(ply)
    np.testing.assert_array_equal(placed.up_rotation, np.eye(3))
    np.testing.assert_allclose(
        placed.levels[0].splats.means, means @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5
    )


def test_plain_files_and_folders_are_exported_as_placed(bpy, lodgs, root, tmp_path):
    place_root(bpy, root)
    placement = lodgs("data.placement").placement_of(root)
    expected = transform_bundle(lodge_bundle(), Similarity.from_matrix(placement.matrix)).levels[1].splats
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "p.ply"), source="LEVEL", level=2, placed=True)
    bpy.ops.lodgs.export_folder(directory=str(tmp_path / "f"), placed=True)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 2
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "s.ply"), source="SHOWN", placed=True)
    for exported in (
        read_bundle(tmp_path / "p.ply").levels[0].splats,
        read_bundle(tmp_path / "s.ply").levels[0].splats,
        read_folder(tmp_path / "f").levels[1].splats,
    ):
        for name in ("means", "quats", "log_scales", "sh"):
            np.testing.assert_allclose(getattr(exported, name), getattr(expected, name), atol=1e-5)


def test_export_command_exports_as_placed(bpy, lodgs, root, tmp_path):
    place_root(bpy, root)
    matrix = level_matrix(root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"), check_existing=False)
    out = tmp_path / "out.ply"
    assert lodgs("commands").main(["export", str(tmp_path / "scene.blend"), str(out), "--placed"]) == 0
    means = lodge_bundle().levels[1].splats.means @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(read_bundle(out).levels[1].splats.means, means, atol=1e-5)


def test_frame_needs_no_window(bpy, root):
    assert bpy.ops.lodgs.frame_scene() == {"FINISHED"}


@pytest.mark.parametrize("hidden_by", ["other scene", "excluded", "collection", "objects"])
def test_export_of_a_reopened_hidden_scene_is_placed_and_cropped(bpy, lodgs, tmp_path, hidden_by):
    """Blender does not evaluate hidden objects after it has opened a file."""
    from mathutils import Matrix

    bundle = Bundle(
        "made",
        [Level(1, random_splats(80, 0), {"s_min": 0.1}), Level(2, random_splats(99, 1), {"s_min": 0.0})],
        "bands",
    )
    write_bundle(tmp_path / "in.ply", bundle)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply")
    parent = bpy.data.objects.new("parent", None)
    lodgs("data.roots").collection_of(root).objects.link(parent)
    root.parent, parent.location, root.location = parent, (10, 0, 0), (0, 5, 0)
    bpy.context.view_layer.update()
    place = Matrix.Translation((10, 5, 0)) @ Matrix.Diagonal((0.5, 9, 9, 1))
    crop = lodgs("data.crops").new_crop(root, "BOX", place)
    bpy.context.view_layer.update()
    read_levels = lodgs("data.scenes").read_levels
    before = [level.splats.means for level in read_levels(root, placed=True).levels]
    assert 0 < len(before[1]) < 99 and 7 < before[1][:, 0].mean() < 13
    collection = lodgs("data.roots").collection_of(root)
    if hidden_by == "other scene":
        bpy.context.window.scene = bpy.data.scenes.new("other")
    elif hidden_by == "excluded":
        bpy.context.view_layer.layer_collection.children[collection.name].exclude = True
    elif hidden_by == "collection":
        collection.hide_viewport = True
    else:
        root.hide_viewport = crop.hide_viewport = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
    after = [level.splats.means for level in read_levels(bpy.data.objects["in"], placed=True).levels]
    for means, expected in zip(after, before, strict=True):
        np.testing.assert_allclose(means, expected, atol=1e-4)


def test_ground_and_subject_are_those_of_all_levels_that_add_up(bpy, lodgs, tmp_path):
    levels = [Level(1, random_splats(200, 1)), Level(2, random_splats(50, 2))]
    levels[0].splats.means[:, 0] += 100
    for level in levels:
        level.splats.opacity_logits[:] = 3
    write_bundle(tmp_path / "a.ply", Bundle("", levels, cumulative=True))
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "a.ply")
    assert len(lodgs("data.ground").ground_points(root)) == 250
    assert lodgs("data.cleanup_tests").subject_of(root).center[0] > 90
