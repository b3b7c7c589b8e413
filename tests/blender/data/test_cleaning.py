"""Crops and hiding act on every level, shown, chosen and exported: against numpy, splat by splat."""

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


def placed(location, angles, scales):
    """(4, 4): scaled, turned around x, y and z, moved, as Blender has it."""
    turn = np.eye(3)
    for axis, angle in enumerate(angles):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        about = np.eye(3)
        about[one, one] = about[other, other] = np.cos(angle)
        about[one, other], about[other, one] = -np.sin(angle), np.sin(angle)
        turn = about @ turn
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * scales, location
    return matrix


UNIT = 1.5
PLACE = placed((2, -1, 3), (0.4, -0.3, 1.1), UNIT)


def scaled(size):
    return blender(np.diag([size, size, size, 1]))


def blender(matrix):
    from mathutils import Matrix

    return Matrix(np.asarray(matrix).tolist())


@pytest.fixture
def scene_of(bpy, lodgs, tmp_path):
    """``scene_of(bundle)``: the bundle imported, its root placed anywhere; and the bundle as it was read."""

    def make(bundle):
        write_bundle(tmp_path / "in.ply", bundle)
        root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "in.ply", upright=False)
        root.matrix_world = blender(PLACE)
        bpy.context.view_layer.update()
        return root, read_bundle(tmp_path / "in.ply")

    return make


def inside(matrix, means, sphere):
    """(N,) bool: places in what a matrix of the world makes of a box or a sphere, and how clearly."""
    own = np.linalg.inv(np.array(matrix, np.float64)) @ PLACE
    local = means.astype(np.float64) @ own[:3, :3].T + own[:3, 3]
    away = np.linalg.norm(local, axis=1) if sphere else np.abs(local).max(axis=1)
    return away <= 1, np.abs(away - 1) > 1e-5


def shown_rows(bpy, lodgs, obj):
    """Return the rows of a level that its modifiers keep."""
    cloud = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    if not len(cloud.points):
        return np.zeros(0, np.int32)
    return np.sort(lodgs("attributes").read_attribute(cloud, "row"))


def rows_of(splats):
    return np.sort(splats.extras["row"])


@pytest.fixture
def cropped(bpy, lodgs, scene_of):
    """``cropped(name)``: a scene of that rule with three crops, and what numpy leaves of each level."""

    def make(name):
        root, bundle = scene_of(bundle_of(name, np.random.default_rng(1)))
        crops, stay = lodgs("data.crops"), {}
        matrices = [
            (placed((3, 0, 2), (0.2, 0.5, 0.9), (6, 5, 7)), "BOX", "INSIDE"),
            (placed((-4, -2, 5), (1, 0, 0), (4, 2, 3)), "SPHERE", "INSIDE"),
            (placed((2, -1, 3), (0, 1, 0), (2, 3, 2)), "SPHERE", "OUTSIDE"),
        ]
        for matrix, shape, keep in matrices:
            crops.new_crop(root, shape, blender(matrix)).lodgs_crop.keep = keep
        bpy.context.view_layer.update()
        for level in bundle.levels:
            held = [inside(m, level.splats.means, shape == "SPHERE") for m, shape, _ in matrices]
            assert all(clear.all() for _, clear in held)
            stay[level.number] = (held[0][0] | held[1][0]) & ~held[2][0]
        return root, bundle, stay

    return make


@pytest.mark.parametrize("name", NAMES)
def test_crops_match_numpy_at_every_level(bpy, lodgs, cropped, name):
    root, bundle, stay = cropped(name)
    root.lodgs.mode = "SINGLE"
    for item in root.lodgs.levels:
        root.lodgs.single_level = item.number
        bpy.context.view_layer.update()
        level = bundle.levels[item.number - 1]
        wanted = level.splats.extras["row"][stay[item.number]]
        np.testing.assert_array_equal(shown_rows(bpy, lodgs, item.object), np.sort(wanted))
        depsgraph = bpy.context.evaluated_depsgraph_get()
        evaluated = item.object.evaluated_get(depsgraph)
        assert lodgs("data.selection").only_lodgs_modifiers(evaluated, depsgraph)
        choice = lodgs("data.selection").evaluated_query(evaluated, depsgraph)
        np.testing.assert_array_equal(choice.weights(level.splats.means, {}) > 0, stay[item.number])
    counts = lodgs("data.cleaning").count_remaining(root, depsgraph)
    assert counts == {number: (mask.sum(), len(mask)) for number, mask in stay.items()}


@pytest.mark.parametrize("name", NAMES)
def test_export_matches_selection_by_distance(bpy, lodgs, cropped, tmp_path, name):
    root, _, stay = cropped(name)
    root.lodgs.mode, root.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    root.lodgs.camera_center = (1.0, -2.0, 0.5)
    bpy.context.view_layer.update()
    there = [shown_rows(bpy, lodgs, item.object) for item in root.lodgs.levels]
    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply")) == {"FINISHED"}

    exported = read_bundle(tmp_path / "out.ply")
    assert [len(level.splats) for level in exported.levels] == [mask.sum() for mask in stay.values()]
    again = lodgs("data.importing").import_splats(bpy.context, tmp_path / "out.ply", upright=False)
    again.lodgs.mode, again.lodgs.camera_choice = "SELECTIVE", "TRAINING"
    again.lodgs.camera_center = (1.0, -2.0, 0.5)
    bpy.context.view_layer.update()
    assert sum(map(len, there)) > 0
    for one, item in zip(there, again.lodgs.levels, strict=True):
        np.testing.assert_array_equal(one, shown_rows(bpy, lodgs, item.object))


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
        pool = resident.read_pool([item.object.data]).pool
        choice = selection.evaluated_query(item.object.evaluated_get(depsgraph), depsgraph)
        count = len(item.object.data.points)
        placement = arrangement.Placement(0, count, np.eye(4).tobytes(), item.number, choice, 0, "LEVELS")
        found = arrangement.arrange(pool, arrangement.Request((placement,), (0.0, 0.0, 1.0), 10**6))
        rows = lodgs("attributes").read_attribute(item.object.data, "row")[found.splats]
        np.testing.assert_array_equal(np.sort(rows), shown_rows(bpy, lodgs, item.object))


def test_modifiers_follow_changed_and_deleted_crops(bpy, lodgs, scene_of):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(2)))
    item, means = root.lodgs.levels[2], bundle.levels[2].splats.means
    root.lodgs.single_level = 3

    def check(obj, sphere, outside=False):
        bpy.context.view_layer.update()
        matrix = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world
        held, clear = inside(matrix @ scaled(obj.empty_display_size), means, sphere)
        assert clear.all() and 0 < held.sum() < len(held)
        assert len(shown_rows(bpy, lodgs, item.object)) == (~held if outside else held).sum()

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
    other = bpy.context.active_object
    assert other != crop and other.lodgs_crop.is_crop
    other.animation_data_clear()
    other.location, other.lodgs_crop.keep, other.scale = (4, 0, 0), "INSIDE", (6, 6, 6)
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()
    both = inside(other.matrix_world @ scaled(0.7), means, True)[0]
    both &= ~inside(crop.matrix_world @ scaled(0.7), means, True)[0]
    assert len(shown_rows(bpy, lodgs, item.object)) == both.sum()

    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    check(crop, True, True)
    bpy.ops.lodgs.remove_crop(name=crop.name)
    bpy.context.view_layer.update()
    assert len(shown_rows(bpy, lodgs, item.object)) == len(means)
    assert lodgs("data.crops").modifier_of(item.object) is None
    assert not [group for group in bpy.data.node_groups if group.name.startswith("LODGS Clean Up")]


def test_each_test_hides_its_splats(bpy, lodgs, scene_of):
    bundle = bundle_of("bands", np.random.default_rng(3))
    planted = (np.float32([40, 0, 0]) + np.random.default_rng(0).normal(0, 0.01, (3, 3))).astype(np.float32)
    bundle.levels[1].splats.means[:3] = planted
    root, bundle = scene_of(bundle)
    unit = UNIT
    bpy.context.scene.collection.objects.link(eye := bpy.data.objects.new("eye", bpy.data.cameras.new("eye")))
    eye.location = (1, 5, 2)
    bpy.context.view_layer.update()
    place = (np.linalg.inv(PLACE) @ (*eye.location, 1))[:3]
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
        hidden_by(test="LARGE", size=0.4 * unit), np.exp(log_scales).max(axis=1) > 0.4
    )
    np.testing.assert_array_equal(hidden_by(test="FAINT", opacity=0.2), 1 / (1 + np.exp(-logits)) < 0.2)
    away = np.linalg.norm(means - place, axis=1)
    np.testing.assert_array_equal(hidden_by(test="FAR", distance=9 * unit), away > 9)
    world = means @ PLACE[:3, :3].T + PLACE[:3, 3]
    before = -(world - np.array(eye.location))[:, 2]
    x, y = np.abs(world - np.array(eye.location))[:, :2].T
    half = 18 / eye.data.lens * before
    render = bpy.context.scene.render
    seen = (before > 0) & (x <= half) & (y <= half * render.resolution_y / render.resolution_x)
    np.testing.assert_array_equal(hidden_by(test="UNSEEN", views=1), ~seen)
    found = hidden_by(test="FLOATERS", gap=3.0 * unit, share=0.2)
    np.testing.assert_array_equal(found, find_floaters(means, 3.0, 0.002))
    first = len(bundle.levels[0].splats)
    assert found[first : first + 3].all() and found.sum() < 60


def test_hidden_splats_are_saved_undone_exported_and_lost_with_their_level(bpy, lodgs, scene_of, tmp_path):
    root, bundle = scene_of(bundle_of("octree", np.random.default_rng(4)))
    cleaning, scenes = lodgs("data.cleaning"), lodgs("data.scenes")
    root.lodgs.single_level = 3
    name = root.name
    stays = [np.exp(level.splats.log_scales).max(axis=1) <= 0.3 for level in bundle.levels]

    def root_now():
        return bpy.data.objects[name]

    def left():
        bpy.context.view_layer.update()
        return [len(shown_rows(bpy, lodgs, item.object)) for item in root_now().lodgs.levels]

    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.hide_splats("EXEC_DEFAULT", True, test="LARGE", size=0.3 * UNIT)
    assert left() == [stay.sum() for stay in stays]
    bpy.ops.lodgs.hide_splats("EXEC_DEFAULT", True, test="FAINT", opacity=0.3)
    fainter = left()
    bpy.ops.lodgs.delete_left_out("EXEC_DEFAULT", True)
    assert left() == fainter == [len(item.object.data.points) for item in root_now().lodgs.levels]
    bpy.ops.ed.undo()
    assert left() == fainter
    bpy.ops.ed.undo()
    assert left() == [stay.sum() for stay in stays]
    bpy.ops.ed.undo()
    assert left() == [len(stay) for stay in stays]
    bpy.ops.ed.redo()
    assert left() == [stay.sum() for stay in stays]

    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert left() == [stay.sum() for stay in stays]
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    for level, before, stay in zip(
        read_bundle(tmp_path / "out.ply").levels, bundle.levels, stays, strict=True
    ):
        for part in ("means", "quats", "log_scales", "opacity_logits", "sh"):
            np.testing.assert_array_equal(getattr(level.splats, part), getattr(before.splats, part)[stay])
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "one.ply"), source="LEVEL", level=2)
    assert len(read_ply(tmp_path / "one.ply")) == stays[0].sum() + stays[1].sum()
    bpy.ops.lodgs.export_plain(filepath=str(tmp_path / "shown.ply"), source="SHOWN")
    assert len(read_ply(tmp_path / "shown.ply")) == sum(stay.sum() for stay in stays)

    scenes.set_level(root_now(), bundle.levels[1])  # the same splats
    assert left()[1] == stays[1].sum() and not root_now().lodgs.levels[1].lost
    reordered = bundle.levels[1].splats.select(slice(None, None, -1))
    scenes.set_level(root_now(), replace(bundle.levels[1], splats=reordered))
    assert root_now().lodgs.levels[1].lost == (~stays[1]).sum()
    assert left()[1] == len(stays[1]) and left()[0] == stays[0].sum()
    bpy.ops.lodgs.show_hidden_splats()
    assert left() == [len(stay) for stay in stays] and not root_now().lodgs.levels[1].lost
    assert not any(cleaning.HIDDEN in item.object.data.attributes for item in root_now().lodgs.levels)


def test_crops_apply_to_new_levels(bpy, lodgs, scene_of):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(5)))
    root.lodgs.single_level = 3
    bpy.ops.lodgs.add_crop(shape="SPHERE")
    fresh = bundle_of("bands", np.random.default_rng(6)).levels[2]
    lodgs("data.scenes").set_level(root, fresh)
    bpy.context.view_layer.update()
    crop = lodgs("data.crops").crops_of(root)[0]
    held, _ = inside(crop.matrix_world, fresh.splats.means, True)
    wanted = np.sort(fresh.splats.extras["row"][held])
    np.testing.assert_array_equal(shown_rows(bpy, lodgs, root.lodgs.levels[2].object), wanted)


def test_cleaned_tree_stays_a_tree(bpy, lodgs, scene_of, tmp_path):
    tree = tree_of(random_leaves(600, np.random.default_rng(7)))
    root, bundle = scene_of(tree)
    bpy.ops.lodgs.hide_splats(test="FAINT", opacity=0.6)
    stays = 1 / (1 + np.exp(-bundle.levels[1].splats.opacity_logits)) >= 0.6
    hidden = [lodgs("data.cleaning").hidden_mask(item.object.data) for item in root.lodgs.levels]
    np.testing.assert_array_equal(hidden[1], ~stays)
    assert 0 < hidden[0].sum() < hidden[1].sum()  # nodes stand as long as anything does below them
    bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    found = read_bundle(tmp_path / "out.ply")
    np.testing.assert_array_equal(found.levels[1].splats.means, bundle.levels[1].splats.means[stays])
    for focal in (1e6, 100.0, 10.0):
        means, count = drawn_for_each_leaf(found, (1, 2, 3), focal)
        assert len(means) == stays.sum() and (count == 1).all()
    bpy.ops.lodgs.delete_left_out()
    for item, level in zip(root.lodgs.levels, found.levels, strict=True):
        np.testing.assert_array_equal(
            lodgs("data.objects").read_splats(item.object).means, level.splats.means
        )


def test_empty_result_and_partial_tree_are_rejected(bpy, lodgs, scene_of, tmp_path):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(8)))
    crops = lodgs("data.crops")
    crops.new_crop(root, "BOX", blender(placed((900, 0, 0), (0, 0, 0), (1, 1, 1))))
    bpy.context.view_layer.update()
    with pytest.raises(RuntimeError, match="No splats remain"):
        bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "out.ply"))
    with pytest.raises(RuntimeError, match="No splats remain"):
        bpy.ops.lodgs.delete_left_out()
    assert not (tmp_path / "out.ply").exists() and len(root.lodgs.levels[0].object.data.points) == 700

    write_bundle(tmp_path / "tree.ply", tree_of(random_leaves(3000, np.random.default_rng(9))))
    part = lodgs("data.importing").import_splats(bpy.context, tmp_path / "tree.ply", budget=2000)
    assert lodgs("data.streams").file_of(part)
    with pytest.raises(RuntimeError, match="lodgs edit"):
        bpy.ops.lodgs.delete_left_out()


def test_selected_splats_are_hidden_and_matches_selected(bpy, lodgs, scene_of):
    root, bundle = scene_of(bundle_of("bands", np.random.default_rng(10)))
    cleaning = lodgs("data.cleaning")
    bpy.ops.lodgs.hide_splats(test="LARGE", size=0.5 * UNIT, action="SELECT")
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        wanted = np.exp(level.splats.log_scales).max(axis=1) > 0.5
        np.testing.assert_array_equal(cleaning.selected_mask(item.object.data), wanted)
        assert not cleaning.hidden_mask(item.object.data).any()
    bpy.ops.lodgs.hide_splats(test="SELECTED")
    for item, level in zip(root.lodgs.levels, bundle.levels, strict=True):
        wanted = np.exp(level.splats.log_scales).max(axis=1) > 0.5
        np.testing.assert_array_equal(cleaning.hidden_mask(item.object.data), wanted)


def test_views_of_photographs_are_the_cameras(bpy, lodgs):
    from training.scenes.colmap import read_scene

    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN)
    root.matrix_world = blender(PLACE) @ root.matrix_world
    bpy.context.view_layer.update()
    found = lodgs("data.cleaning").cameras(bpy.context, root)
    for one, other in zip(found, read_scene(GARDEN).cameras, strict=True):
        np.testing.assert_allclose(one.center, other.center, atol=1e-4)
        np.testing.assert_allclose((one.fx, one.width), (other.fx, other.width), rtol=1e-4)


@pytest.mark.parametrize("shape", ["BOX", "SPHERE"])
def test_points_on_a_crop_face_are_inside(bpy, lodgs, scene_of, shape):
    """However the crop is turned: rounding puts such places on both sides of its face."""
    rng, bundle = np.random.default_rng(6), bundle_of("bands", np.random.default_rng(6))
    matrix = placed((3, -7, 11), (0.7, 0.4, -0.9), (2, 0.5, 3))
    own = np.linalg.inv(PLACE) @ matrix
    for level in bundle.levels:
        local = rng.normal(size=(len(level.splats), 3))
        size = np.abs(local).max(axis=1) if shape == "BOX" else np.linalg.norm(local, axis=1)
        local *= (np.where(np.arange(len(local)) % 2, 1, 1.0001) / size)[:, None]
        level.splats.means[:] = local @ own[:3, :3].T + own[:3, 3]
    root, bundle = scene_of(bundle)
    lodgs("data.crops").new_crop(root, shape, blender(matrix))
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


def test_crops_of_older_files_get_the_current_group(bpy, lodgs, scene_of):
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(7)))
    bpy.ops.lodgs.add_crop(shape="BOX")
    crop, crops, version = bpy.context.active_object, lodgs("data.crops"), lodgs("nodes.building").VERSION
    levels = [item.object for item in root.lodgs.levels]
    bpy.context.view_layer.update()
    older = crops.modifier_of(levels[0]).node_group
    now, older[version] = older[version], older[version] - 1
    assert crops.outdated(root)
    crop.location.x += 0.1
    bpy.context.view_layer.update()
    assert not crops.outdated(root)
    assert {crops.modifier_of(obj).node_group[version] for obj in levels} == {now}


def test_levels_drop_references_before_undo(bpy, lodgs, scene_of):
    """Blender keeps what two steps hold alike, with what it was given since, which may be gone."""
    root, _ = scene_of(bundle_of("bands", np.random.default_rng(1)))
    name, material, seen = root.name, bpy.data.materials.new("Mine"), []
    crops, names = lodgs("data.crops"), [item.object.name for item in root.lodgs.levels]

    def pointed_at():
        mine = [obj for obj in bpy.data.objects if obj.lodgs_crop.is_crop or obj.name == "Eye"]
        users = bpy.data.user_map(subset=[*mine, *bpy.data.materials])
        levels = {bpy.data.objects[each] for each in names}
        return {key.name for key, found in users.items() if found & levels}

    def look(*_):
        seen.append(pointed_at())

    root.lodgs.camera_object = eye = bpy.data.objects.new("Eye", None)
    bpy.context.scene.collection.objects.link(eye)
    for each in names:
        bpy.data.objects[each].data.materials.append(material)
    root.lodgs.camera_choice = "OBJECT"
    bpy.ops.ed.undo_push(message="start")
    for keep in ("INSIDE", "ALL"):
        assert bpy.ops.lodgs.add_crop("EXEC_DEFAULT", True, shape="SPHERE", keep=keep) == {"FINISHED"}
        bpy.context.view_layer.update()
    there = pointed_at()
    assert there >= {"Crop Sphere", "Region Sphere", "Eye"}
    for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
        handlers.append(look)
    try:
        bpy.ops.ed.undo()
        bpy.ops.ed.undo()
        assert crops.crops_of(bpy.data.objects[name]) == []
        bpy.ops.ed.redo()
        bpy.ops.ed.redo()
    finally:
        for handlers in (bpy.app.handlers.undo_pre, bpy.app.handlers.redo_pre):
            handlers.remove(look)
    assert len(seen) == 4 and all(each <= {"Mine"} for each in seen), seen  # a level's own, in its slot
    assert pointed_at() == there


def test_hidden_views_keep_their_pose(bpy, lodgs):
    """Blender does not follow hidden objects: the scene was made larger meanwhile."""
    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    before = [camera.center for camera in lodgs("data.cleaning").cameras(bpy.context, root)]
    root.lodgs.cameras.hide_viewport = True
    root.scale, root.location = (3, 3, 3), (1, 2, 3)
    bpy.context.view_layer.update()
    after = [camera.center for camera in lodgs("data.cleaning").cameras(bpy.context, root)]
    np.testing.assert_allclose(after, before, atol=1e-4)
