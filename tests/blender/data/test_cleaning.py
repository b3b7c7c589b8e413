"""Crops and hiding act on every level, in viewports, selections and exports. Numpy is the reference."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.training.editing.test_cleaning import bundle_of, drawn_for_each_leaf
from tests.training.lod.tree.trees import random_leaves, tree_of
from training.editing.cleaning import find_floaters
from training.splats.bundle import read_bundle, write_bundle
from training.splats.ply import read_ply

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
NAMES = ["bands", "octree", "chunks", "decay"]


def transform(location, angles, scales):
    """Return a matrix (4, 4) that scales, rotates around x, y and z, and moves, like a Blender object's."""
    rotation = np.eye(3)
    for axis, angle in enumerate(angles):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i] = step[j, j] = np.cos(angle)
        step[i, j], step[j, i] = -np.sin(angle), np.sin(angle)
        rotation = step @ rotation
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation * scales, location
    return matrix


ROOT_SCALE = 1.5
ROOT_MATRIX = transform((2, -1, 3), (0.4, -0.3, 1.1), ROOT_SCALE)
"""Transform of the root of each scene."""


def scaled(size):
    return to_blender(np.diag([size, size, size, 1]))


def to_blender(matrix):
    from mathutils import Matrix

    return Matrix(np.asarray(matrix).tolist())


@pytest.fixture
def scene_of(bpy, lodgs, tmp_path):
    """``scene_of(bundle)``: import a bundle under a moved root; return the root and the bundle as read."""

    def make(bundle):
        write_bundle(tmp_path / "in.ply", bundle)
        root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply", upright=False)
        root.matrix_world = to_blender(ROOT_MATRIX)
        bpy.context.view_layer.update()
        return root, read_bundle(tmp_path / "in.ply")

    return make


def inside(matrix, means, sphere):
    """Return two masks (N,): means inside a crop with a world matrix, and means not close to its surface."""
    to_crop = np.linalg.inv(np.array(matrix, np.float64)) @ ROOT_MATRIX
    local = means.astype(np.float64) @ to_crop[:3, :3].T + to_crop[:3, 3]
    distances = np.linalg.norm(local, axis=1) if sphere else np.abs(local).max(axis=1)
    return distances <= 1, np.abs(distances - 1) > 1e-5


def shown_rows(bpy, lodgs, obj):
    """Return the rows of a level that its modifiers keep."""
    cloud = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    if not len(cloud.points):
        return np.zeros(0, np.int32)
    return np.sort(lodgs("attributes").read_attribute(cloud, "row"))


@pytest.fixture
def cropped(bpy, lodgs, scene_of):
    """``cropped(rule)``: return root and bundle of a scene with three crops, and its remaining splats."""

    def make(name):
        root, bundle = scene_of(bundle_of(name, np.random.default_rng(1)))
        crops, remaining = lodgs("data.crops"), {}
        matrices = [
            (transform((3, 0, 2), (0.2, 0.5, 0.9), (6, 5, 7)), "BOX", "INSIDE"),
            (transform((-4, -2, 5), (1, 0, 0), (4, 2, 3)), "SPHERE", "INSIDE"),
            (transform((2, -1, 3), (0, 1, 0), (2, 3, 2)), "SPHERE", "OUTSIDE"),
        ]
        for matrix, shape, keep in matrices:
            crops.new_crop(root, shape, to_blender(matrix)).lodgs_crop.keep = keep
        bpy.context.view_layer.update()
        for level in bundle.levels:
            masks = [inside(m, level.splats.means, shape == "SPHERE") for m, shape, _ in matrices]
            assert all(clear.all() for _, clear in masks)
            remaining[level.number] = (masks[0][0] | masks[1][0]) & ~masks[2][0]
        return root, bundle, remaining

    return make


@pytest.mark.parametrize("name", NAMES)
def test_crops_match_numpy_at_every_level(bpy, lodgs, cropped, name):
    root, bundle, remaining = cropped(name)
    root.lodgs.mode = "SINGLE"
    for item in root.lodgs.levels:
        root.lodgs.single_level = item.number
        bpy.context.view_layer.update()
        level = bundle.levels[item.number - 1]
        expected = level.splats.extras["row"][remaining[item.number]]
        np.testing.assert_array_equal(shown_rows(bpy, lodgs, item.object), np.sort(expected))
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = item.object.evaluated_get(depsgraph)
        assert lodgs("data.selection").only_lodgs_modifiers(evaluated, depsgraph)
        query = lodgs("data.selection").evaluated_query(evaluated, depsgraph)
        np.testing.assert_array_equal(query.weights(level.splats.means, {}) > 0, remaining[item.number])
    counts = lodgs("data.cleaning").count_remaining(root, depsgraph)
    assert counts == {number: (mask.sum(), len(mask)) for number, mask in remaining.items()}


@pytest.mark.parametrize("name", NAMES)
def test_export_matches_selection_by_distance(bpy, lodgs, cropped, tmp_path, name):
    root, _, remaining = cropped(name)
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    root.lodgs.camera_center = (1.0, -2.0, 0.5)
    bpy.context.view_layer.update()
    expected_rows = [shown_rows(bpy, lodgs, item.object) for item in root.lodgs.levels]
    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply")) == {"FINISHED"}

    exported = read_bundle(tmp_path / "out.ply")
    assert [len(level.splats) for level in exported.levels] == [mask.sum() for mask in remaining.values()]
    reimported = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    reimported.lodgs.mode, reimported.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    reimported.lodgs.camera_center = (1.0, -2.0, 0.5)
    bpy.context.view_layer.update()
    assert sum(map(len, expected_rows)) > 0
    for expected, item in zip(expected_rows, reimported.lodgs.levels, strict=True):
        np.testing.assert_array_equal(expected, shown_rows(bpy, lodgs, item.object))


@pytest.mark.parametrize("name", NAMES)
def test_viewport_draws_remaining_splats(bpy, lodgs, cropped, name):
    root, _, _ = cropped(name)
    cleaning = lodgs("data.cleaning")
    cleaning.hide(root, cleaning.find(root, cleaning.opacity_test(0.3)))
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    bpy.context.view_layer.update()
    resident, arrangement = lodgs("viewport.resident"), lodgs("viewport.arrangement")
    selection, depsgraph = lodgs("data.selection"), bpy.context.evaluated_depsgraph_get()
    for item in root.lodgs.levels:
        clouds = [item.object.data]
        pool = resident.PoolReader(clouds).advance(clouds).pool
        query = selection.evaluated_query(item.object.evaluated_get(depsgraph), depsgraph)
        count = len(item.object.data.points)
        placement = arrangement.Placement(0, count, np.eye(4).tobytes(), item.number, query, 0, "LEVELS")
        arranged = arrangement.arrange(pool, arrangement.Request((placement,), (0.0, 0.0, 1.0), 10**6))
        rows = lodgs("attributes").read_attribute(item.object.data, "row")[arranged.splats]
        np.testing.assert_array_equal(np.sort(rows), shown_rows(bpy, lodgs, item.object))


def test_modifiers_follow_changed_and_deleted_crops(bpy, lodgs, scene_of):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(2)))
    item, means = root.lodgs.levels[2], bundle.levels[2].splats.means
    root.lodgs.single_level = 3

    def check(obj, sphere, outside=False):
        bpy.context.view_layer.update()
        matrix = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world
        mask, clear = inside(matrix @ scaled(obj.empty_display_size), means, sphere)
        assert clear.all() and 0 < mask.sum() < len(mask)
        assert len(shown_rows(bpy, lodgs, item.object)) == (~mask if outside else mask).sum()

    bpy.ops.lodgs.add_crop(shape="BOX")
    crop = bpy.context.active_object
    check(crop, False)
    crop.location, crop.rotation_euler = (1, 2, 0), (0.1, 0.2, 0.3)
    check(crop, False)
    crop.empty_display_size = 0.7
    check(crop, False)
    crop.empty_display_type = "SPHERE"
    check(crop, True)
    crop.lodgs_crop.keep = "OUTSIDE"
    check(crop, True, True)
    for frame, x in ((1, -3.0), (11, 3.0)):
        crop.location.x = x
        crop.keyframe_insert("location", frame=frame)
    for frame in (1, 6, 11):
        bpy.context.scene.frame_set(frame)
        check(crop, True, True)
    crop.lodgs_crop.use = False
    bpy.context.view_layer.update()
    assert len(shown_rows(bpy, lodgs, item.object)) == len(means)
    crop.lodgs_crop.use = True

    bpy.ops.object.duplicate()
    duplicate = bpy.context.active_object
    assert duplicate != crop and duplicate.lodgs_crop.is_crop
    duplicate.animation_data_clear()
    duplicate.location, duplicate.lodgs_crop.keep, duplicate.scale = (4, 0, 0), "INSIDE", (6, 6, 6)
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()
    remaining = inside(duplicate.matrix_world @ scaled(0.7), means, True)[0]
    remaining &= ~inside(crop.matrix_world @ scaled(0.7), means, True)[0]
    assert len(shown_rows(bpy, lodgs, item.object)) == remaining.sum()

    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    check(crop, True, True)
    bpy.ops.lodgs.remove_crop(name=crop.name)
    bpy.context.view_layer.update()
    assert len(shown_rows(bpy, lodgs, item.object)) == len(means)
    assert lodgs("data.crops").modifier_of(item.object) is None
    assert not any(group.users for group in bpy.data.node_groups if group.name.startswith("LODGS Clean Up"))


def test_crop_of_a_child_scene_leaves_its_parent_scene_uncropped(bpy, lodgs, scene_of):
    house, garden = (scene_of(bundle_of("bands", np.random.default_rng(seed)))[0] for seed in (1, 2))
    garden.parent = house
    bpy.context.view_layer.update()
    crop = lodgs("operators.clean_up").add_crop(bpy.context, garden, "BOX")
    bpy.context.view_layer.update()
    crops = lodgs("data.crops")
    assert crops.crops_of(garden) == [crop] and crops.crops_of(house) == []
    assert crops.modifier_of(house.lodgs.levels[0].object) is None


def test_clean_up_tests_hide_matching_splats(bpy, lodgs, scene_of):
    bundle = bundle_of("bands", np.random.default_rng(3))
    planted = (np.float32([40, 0, 0]) + np.random.default_rng(0).normal(0, 0.01, (3, 3))).astype(np.float32)
    bundle.levels[1].splats.means[:3] = planted
    root, bundle = scene_of(bundle)

    bpy.context.scene.collection.objects.link(
        camera := bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    )
    camera.location = (1, 5, 2)
    bpy.context.view_layer.update()
    camera_center = (np.linalg.inv(ROOT_MATRIX) @ (*camera.location, 1))[:3]
    means = np.concatenate([level.splats.means for level in bundle.levels])

    def hidden_by(**options):
        bpy.ops.lodgs.show_hidden_splats()
        assert bpy.ops.lodgs.hide_splats(**options) == {"FINISHED"}
        return np.concatenate(
            [lodgs("data.cleaning").hidden_mask(item.object.data) for item in root.lodgs.levels]
        )

    log_scales = np.concatenate([level.splats.log_scales for level in bundle.levels])
    logits = np.concatenate([level.splats.opacity_logits for level in bundle.levels])
    np.testing.assert_array_equal(
        hidden_by(test="LARGE", size=0.4 * ROOT_SCALE), np.exp(log_scales).max(axis=1) > 0.4
    )
    np.testing.assert_array_equal(hidden_by(test="FAINT", opacity=0.2), 1 / (1 + np.exp(-logits)) < 0.2)
    distances = np.linalg.norm(means - camera_center, axis=1)
    np.testing.assert_array_equal(hidden_by(test="FAR", distance=9 * ROOT_SCALE), distances > 9)
    world = means @ ROOT_MATRIX[:3, :3].T + ROOT_MATRIX[:3, 3]
    depth = -(world - np.array(camera.location))[:, 2]
    x, y = np.abs(world - np.array(camera.location))[:, :2].T
    half_width = 18 / camera.data.lens * depth
    render = bpy.context.scene.render
    visible = (depth > 0) & (x <= half_width) & (y <= half_width * render.resolution_y / render.resolution_x)
    np.testing.assert_array_equal(hidden_by(test="UNSEEN", views=1), ~visible)
    floaters = hidden_by(test="FLOATERS", gap=3.0 * ROOT_SCALE, share=0.2)
    np.testing.assert_array_equal(floaters, find_floaters(means, 3.0, 0.002))
    first = len(bundle.levels[0].splats)
    assert floaters[first : first + 3].all() and floaters.sum() < 60


def test_hidden_splats_survive_undo_saving_and_export(bpy, lodgs, scene_of, tmp_path):
    root, bundle = scene_of(bundle_of("octree", np.random.default_rng(4)))
    cleaning, scenes = lodgs("data.cleaning"), lodgs("data.scenes")
    root.lodgs.single_level = 3
    name = root.name
    remaining = [np.exp(level.splats.log_scales).max(axis=1) <= 0.3 for level in bundle.levels]

    def current_root():
        return bpy.data.objects[name]

    def visible_counts():
        bpy.context.view_layer.update()
        return [len(shown_rows(bpy, lodgs, item.object)) for item in current_root().lodgs.levels]

    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.hide_splats("EXEC_DEFAULT", True, test="LARGE", size=0.3 * ROOT_SCALE)
    assert visible_counts() == [mask.sum() for mask in remaining]
    bpy.ops.lodgs.hide_splats("EXEC_DEFAULT", True, test="FAINT", opacity=0.3)
    counts_after_faint = visible_counts()
    bpy.ops.lodgs.delete_hidden_splats("EXEC_DEFAULT", True)
    assert (
        visible_counts()
        == counts_after_faint
        == [len(item.object.data.points) for item in current_root().lodgs.levels]
    )
    bpy.ops.ed.undo()
    assert visible_counts() == counts_after_faint
    bpy.ops.ed.undo()
    assert visible_counts() == [mask.sum() for mask in remaining]
    bpy.ops.ed.undo()
    assert visible_counts() == [len(mask) for mask in remaining]
    bpy.ops.ed.redo()
    assert visible_counts() == [mask.sum() for mask in remaining]

    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert visible_counts() == [mask.sum() for mask in remaining]
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    for level, original, mask in zip(
        read_bundle(tmp_path / "out.ply").levels, bundle.levels, remaining, strict=True
    ):
        for name_of_array in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            values = getattr(original.splats, name_of_array)[mask]
            np.testing.assert_array_equal(getattr(level.splats, name_of_array), values)
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "one.ply"), source="LEVEL", level=2)
    assert len(read_ply(tmp_path / "one.ply")) == remaining[0].sum() + remaining[1].sum()
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "shown.ply"), source="SHOWN")
    assert len(read_ply(tmp_path / "shown.ply")) == sum(mask.sum() for mask in remaining)

    scenes.set_level(current_root(), bundle.levels[1])  # the same splats
    assert visible_counts()[1] == remaining[1].sum() and not current_root().lodgs.levels[1].lost
    reordered = bundle.levels[1].splats.select(slice(None, None, -1))
    scenes.set_level(current_root(), replace(bundle.levels[1], splats=reordered))
    assert current_root().lodgs.levels[1].lost == (~remaining[1]).sum()
    assert visible_counts()[1] == len(remaining[1]) and visible_counts()[0] == remaining[0].sum()
    bpy.ops.lodgs.show_hidden_splats()
    assert visible_counts() == [len(mask) for mask in remaining] and not current_root().lodgs.levels[1].lost
    assert not any(cleaning.HIDDEN in item.object.data.attributes for item in current_root().lodgs.levels)


@pytest.mark.parametrize("keep", ["INSIDE", "ALL"])
def test_crops_are_around_the_subject_in_front_of_a_far_background(bpy, scene_of, keep):
    rng, bundle = np.random.default_rng(8), bundle_of("bands", np.random.default_rng(5))
    for level in bundle.levels:
        means = level.splats.means
        means[:] = rng.uniform(-1, 1, means.shape) + np.float32((2, 0, 0))
        means[::4] += np.float32((0, 40, 0))
    scene_of(bundle)
    bpy.ops.lodgs.add_crop(shape="BOX", keep=keep)
    bpy.context.view_layer.update()
    crop, (rotation, place) = bpy.context.active_object.matrix_world, np.split(ROOT_MATRIX[:3], [3], axis=1)
    center, half = np.array(crop.translation), np.array(crop.to_scale())
    np.testing.assert_allclose(center, rotation @ (2, 0, 0) + place[:, 0], atol=0.2 * ROOT_SCALE)
    share = (np.abs(means @ rotation.T + place[:, 0] - center) <= half).all(axis=1).mean()
    assert share > 0.7 if keep == "INSIDE" else (half < 1.2 * ROOT_SCALE).all()


def test_crops_apply_to_new_levels(bpy, lodgs, scene_of):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(5)))
    root.lodgs.single_level = 3
    bpy.ops.lodgs.add_crop(shape="SPHERE")
    new_level = bundle_of("bands", np.random.default_rng(6)).levels[2]
    lodgs("data.scenes").set_level(root, new_level)
    bpy.context.view_layer.update()
    crop = lodgs("data.crops").crops_of(root)[0]
    mask, _ = inside(crop.matrix_world, new_level.splats.means, True)
    expected = np.sort(new_level.splats.extras["row"][mask])
    np.testing.assert_array_equal(shown_rows(bpy, lodgs, root.lodgs.levels[2].object), expected)


def test_cleaned_tree_stays_a_tree(bpy, lodgs, scene_of, tmp_path):
    tree = tree_of(random_leaves(600, np.random.default_rng(7)))
    root, bundle = scene_of(tree)
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.6)
    remaining = 1 / (1 + np.exp(-bundle.levels[1].splats.opacity_logits)) >= 0.6
    hidden = [lodgs("data.cleaning").hidden_mask(item.object.data) for item in root.lodgs.levels]
    np.testing.assert_array_equal(hidden[1], ~remaining)
    assert 0 < hidden[0].sum() < hidden[1].sum()  # nodes remain while a leaf below them remains
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    exported = read_bundle(tmp_path / "out.ply")
    np.testing.assert_array_equal(exported.levels[1].splats.means, bundle.levels[1].splats.means[remaining])
    for focal in (1e6, 100.0, 10.0):
        means, count = drawn_for_each_leaf(exported, (1, 2, 3), focal)
        assert len(means) == remaining.sum() and (count == 1).all()
    bpy.ops.lodgs.delete_hidden_splats()
    for item, level in zip(root.lodgs.levels, exported.levels, strict=True):
        np.testing.assert_array_equal(
            lodgs("data.objects").read_splats(item.object).means, level.splats.means
        )


def test_empty_result_and_partial_tree_are_rejected(bpy, lodgs, scene_of, tmp_path):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(8)))
    crops = lodgs("data.crops")
    crops.new_crop(root, "BOX", to_blender(transform((900, 0, 0), (0, 0, 0), (1, 1, 1))))
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match="Cannot edit the splats: none remain"):
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    with pytest.raises(RuntimeError, match="Cannot edit the splats: none remain"):
        bpy.ops.lodgs.delete_hidden_splats()
    assert not (tmp_path / "out.ply").exists() and len(root.lodgs.levels[0].object.data.points) == 700

    write_bundle(tmp_path / "tree.ply", tree_of(random_leaves(3000, np.random.default_rng(9))))
    partial = lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply", budget=2000)
    assert lodgs("data.streams").file_of(partial)
    with pytest.raises(RuntimeError, match="lodgs edit"):
        bpy.ops.lodgs.delete_hidden_splats()


def test_selected_splats_are_hidden_and_matches_selected(bpy, lodgs, scene_of):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(10)))
    cleaning = lodgs("data.cleaning")
    bpy.ops.lodgs.hide_splats(test="LARGE", size=0.5 * ROOT_SCALE, action="SELECT")
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        expected = np.exp(level.splats.log_scales).max(axis=1) > 0.5
        np.testing.assert_array_equal(cleaning.selected_mask(item.object.data), expected)
        assert not cleaning.hidden_mask(item.object.data).any()
    bpy.ops.lodgs.hide_splats(test="SELECTED")
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        expected = np.exp(level.splats.log_scales).max(axis=1) > 0.5
        np.testing.assert_array_equal(cleaning.hidden_mask(item.object.data), expected)


def test_cameras_of_other_splat_scenes_are_not_used(bpy, lodgs, scene_of):
    """Their photos see other splats, and their poses are in the space of another scene."""
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(1)))
    lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    with pytest.raises(lodgs("training.errors").LodgsError, match="has no cameras"):
        lodgs("data.cleaning").cameras(bpy.context, root)
    camera = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    camera.data.lodgs.width, camera.location = 100, (3, 2, 1)  # a copy of a photo's camera
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    (view,) = lodgs("data.cleaning").cameras(bpy.context, root)
    np.testing.assert_allclose(ROOT_MATRIX @ (*view.center, 1), (3, 2, 1, 1), atol=1e-5)


def test_views_of_photographs_are_the_cameras(bpy, lodgs):
    from training.scenes.colmap import read_scene

    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN)
    root.matrix_world = to_blender(ROOT_MATRIX) @ root.matrix_world
    bpy.context.view_layer.update()
    cameras = lodgs("data.cleaning").cameras(bpy.context, root)
    for camera, expected in zip(cameras, read_scene(GARDEN).cameras, strict=True):
        np.testing.assert_allclose(camera.center, expected.center, atol=1e-4)
        np.testing.assert_allclose((camera.fx, camera.width), (expected.fx, expected.width), rtol=1e-4)


@pytest.mark.parametrize("shape", ["BOX", "SPHERE"])
def test_points_on_a_crop_face_are_inside(bpy, lodgs, scene_of, shape):
    """For a rotated crop, rounding moves such points to both sides of its face."""
    rng, bundle = np.random.default_rng(6), bundle_of("bands", np.random.default_rng(6))
    matrix = transform((3, -7, 11), (0.7, 0.4, -0.9), (2, 0.5, 3))
    to_scene = np.linalg.inv(ROOT_MATRIX) @ matrix
    for level in bundle.levels:
        local = rng.normal(size=(len(level.splats), 3))
        size = np.abs(local).max(axis=1) if shape == "BOX" else np.linalg.norm(local, axis=1)
        local *= (np.where(np.arange(len(local)) % 2, 1, 1.0001) / size)[:, None]
        level.splats.means[:] = local @ to_scene[:3, :3].T + to_scene[:3, 3]
    root, bundle = scene_of(bundle)
    lodgs("data.crops").new_crop(root, shape, to_blender(matrix))
    lodgs("data.selection").follow_crops(root)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    crops = lodgs("data.crops").evaluated_crops(root, depsgraph)
    root.lodgs.mode = "SINGLE"
    for level, item in zip(bundle.levels, root.lodgs.levels, strict=True):
        root.lodgs.single_level = item.number
        bpy.context.view_layer.update()
        on_face = np.arange(1, len(level.splats), 2)
        np.testing.assert_array_equal(shown_rows(bpy, lodgs, item.object), on_face)
        np.testing.assert_array_equal(np.flatnonzero(crops[0].contains(level.splats.means)), on_face)


def test_animated_crops_remove_nothing_while_they_keep_all(bpy, lodgs, scene_of, monkeypatch):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(9)))
    root.lodgs.mode, level = "SINGLE", root.lodgs.levels[2]
    root.lodgs.single_level = 3
    bpy.ops.lodgs.add_crop(shape="BOX")
    crop, crops = bpy.context.active_object, lodgs("data.crops")
    for frame, keep in ((1, "ALL"), (2, "INSIDE")):
        crop.lodgs_crop.keep = keep
        crop.keyframe_insert("lodgs_crop.keep", frame=frame)
    counts = []
    # as in renders, whose depsgraph keeps the modifiers of another frame
    monkeypatch.setattr(lodgs("data.selection"), "follow_crops", lambda root: None)
    for frame in (2, 1):
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = level.object.evaluated_get(depsgraph)
        cropped = crops.modifier_crops(evaluated, depsgraph, lambda modifier: True)
        assert len(cropped) == len(crops.evaluated_crops(root, depsgraph)) == frame - 1
        counts.append(len(shown_rows(bpy, lodgs, level.object)))
    assert counts[0] < counts[1] == len(bundle.levels[2].splats)


def test_crops_of_older_files_get_the_current_group(bpy, lodgs, scene_of):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(7)))
    bpy.ops.lodgs.add_crop(shape="BOX")
    crop, crops, version = bpy.context.active_object, lodgs("data.crops"), lodgs("nodes.building").VERSION
    levels = [item.object for item in root.lodgs.levels]
    bpy.context.view_layer.update()
    older = crops.modifier_of(levels[0]).node_group
    current, older[version] = older[version], older[version] - 1
    assert crops.is_outdated(root)
    crop.location.x += 0.1
    bpy.context.view_layer.update()
    assert not crops.is_outdated(root)
    assert {crops.modifier_of(obj).node_group[version] for obj in levels} == {current}


def test_levels_drop_references_before_undo(bpy, lodgs, scene_of):
    """Blender reuses data that is equal in two undo steps, with later references, which may be freed."""
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(1)))
    name, material, references = root.name, bpy.data.materials.new("Mine"), []
    crops, names = lodgs("data.crops"), [item.object.name for item in root.lodgs.levels]

    def data_of_levels():
        """Return the names of crops, camera object and materials that levels refer to."""
        subset = [obj for obj in bpy.data.objects if obj.lodgs_crop.is_crop or obj.name == "Camera Object"]
        users = bpy.data.user_map(subset=[*subset, *bpy.data.materials])
        levels = {bpy.data.objects[level] for level in names}
        return {data.name for data, objects in users.items() if objects & levels}

    def record(*_):
        references.append(data_of_levels())

    root.lodgs.camera_object = camera_object = bpy.data.objects.new("Camera Object", None)
    bpy.context.scene.collection.objects.link(camera_object)
    for level in names:
        bpy.data.objects[level].data.materials.append(material)
    root.lodgs.camera_choice = "OBJECT"
    bpy.ops.ed.undo_push(message="start")
    for keep in ("INSIDE", "ALL"):
        assert bpy.ops.lodgs.add_crop("EXEC_DEFAULT", True, shape="SPHERE", keep=keep) == {"FINISHED"}
        bpy.context.view_layer.update()
    before = data_of_levels()
    assert before >= {"Crop Sphere", "Region Sphere", "Camera Object"}
    for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
        handlers.append(record)
    try:
        bpy.ops.ed.undo()
        bpy.ops.ed.undo()
        assert crops.crops_of(bpy.data.objects[name]) == []
        bpy.ops.ed.redo()
        bpy.ops.ed.redo()
    finally:
        for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
            handlers.remove(record)
    assert len(references) == 4
    assert all(data <= {"Mine"} for data in references), references  # materials stay in their slots
    assert data_of_levels() == before


def test_hidden_views_keep_their_pose(bpy, lodgs):
    """Blender does not update hidden objects after the scene is scaled and moved."""
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    before = [camera.center for camera in lodgs("data.cleaning").cameras(bpy.context, root)]
    root.lodgs.cameras.hide_viewport = True
    root.scale, root.location = (3, 3, 3), (1, 2, 3)
    bpy.context.view_layer.update()
    after = [camera.center for camera in lodgs("data.cleaning").cameras(bpy.context, root)]
    np.testing.assert_allclose(after, before, atol=1e-4)
