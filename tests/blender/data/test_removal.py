"""Deleting a splat scene removes all of its data, and nothing of the user."""

from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from training.splats.levels import Bundle, Level

KINDS = ("objects", "collections", "pointclouds", "cameras", "images", "meshes", "scenes")


def data_names(bpy) -> dict[str, list[str]]:
    return {kind: sorted(data.name for data in getattr(bpy.data, kind)) for kind in KINDS}


@pytest.fixture
def root(bpy, lodgs):
    """The example's views and points with two levels, in a file with an object of the user."""
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
    garden = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"
    scenes = lodgs("data.scenes")
    root = lodgs("data.importing").import_colmap(bpy.context, garden)
    scenes.set_bundle_facts(root, Bundle("flod", [], "bands"))
    for number, s_min in ((1, 0.1), (2, 0.0)):
        scenes.set_level(root, Level(number, splats(number), {"s_min": s_min}))
    scenes.set_tables(root, {"any": {"x": np.float32([1, 2])}})
    root.location = (1, 2, 3)
    bpy.context.view_layer.update()
    lodgs("operators.clean_up").add_crop(bpy.context, root, "BOX")
    bpy.context.view_layer.objects.active = root
    bpy.context.view_layer.update()
    return root


def delete_objects(bpy, *names):
    """Delete objects of these names, or all visible ones, as the key X does."""
    for obj in bpy.context.view_layer.objects:
        obj.select_set(not names or obj.name in names)
    assert bpy.ops.object.delete("EXEC_DEFAULT", True) == {"FINISHED"}  # True: one undo step, as by hand
    bpy.context.view_layer.update()


def drivers(bpy):
    return [
        curve.driver
        for obj in bpy.data.objects
        for curve in (obj.animation_data.drivers if obj.animation_data else ())
    ]


def all_drivers_valid(bpy) -> bool:
    sources = [target.id for driver in drivers(bpy) for v in driver.variables for target in v.targets
               if v.type == "SINGLE_PROP"]  # fmt: skip
    return None not in sources and all(driver.is_valid for driver in drivers(bpy))


@pytest.mark.parametrize("selected", ["root", "all"])
def test_deleted_scene_leaves_no_data(bpy, lodgs, root, selected):
    removal = lodgs("data.removal")
    name, before = root.name, data_names(bpy)
    bpy.ops.ed.undo_push(message="before")
    delete_objects(bpy, *([name] if selected == "root" else []))
    assert drivers(bpy) and all_drivers_valid(bpy)
    assert bpy.app.timers.is_registered(removal.remove_deleted)  # background runs no timers
    removal.remove_deleted()
    bpy.context.view_layer.update()
    bpy.data.orphans_purge(do_recursive=True)  # Blender keeps unused data until the file is saved
    remaining = ["user object"] if selected == "root" else []
    assert data_names(bpy) == {kind: [] for kind in KINDS} | {"objects": remaining, "scenes": ["Scene"]}
    bpy.ops.ed.undo()
    assert data_names(bpy) == before and all_drivers_valid(bpy)
    assert bpy.data.objects[name].users_collection
    removal.remove_deleted()
    assert data_names(bpy) == before


def test_saving_removes_the_rest_of_a_deleted_scene(bpy, root, tmp_path):
    delete_objects(bpy, root.name)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert [obj.name for obj in bpy.data.objects] == ["user object"] and not bpy.data.pointclouds


def test_operator_removes_the_scene_and_undo_restores_it(bpy, root):
    name, before = root.name, data_names(bpy)
    bpy.context.view_layer.objects.active = root.lodgs.levels[0].object
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.lodgs.remove_scene("EXEC_DEFAULT", True) == {"FINISHED"}
    assert data_names(bpy)["objects"] == ["user object"] and not bpy.data.collections
    bpy.ops.ed.undo()
    assert data_names(bpy) == before and len(bpy.data.objects[name].lodgs.levels) == 2
    bpy.ops.ed.redo()
    assert data_names(bpy)["objects"] == ["user object"]
    assert not bpy.ops.lodgs.remove_scene.poll()


def test_children_and_copies_of_a_removed_scene_keep_their_place(bpy, root):
    user_object = bpy.data.objects["user object"]
    user_object.parent, user_object.location = root, (1, 0, 0)
    root.users_collection[0].objects.link(user_object)
    copy = root.lodgs.levels[1].object.copy()
    bpy.context.scene.collection.objects.link(copy)
    bpy.context.view_layer.update()
    matrices = [np.array(obj.matrix_world) for obj in (user_object, copy)]
    assert np.linalg.norm(matrices[0][:3, 3]) > 1
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert sorted(obj.name for obj in bpy.data.objects) == sorted([user_object.name, copy.name])
    assert bpy.data.collections[:] == [
        collection
        for collection in user_object.users_collection
        if collection != bpy.context.scene.collection
    ]
    for obj, matrix in zip((user_object, copy), matrices, strict=True):
        np.testing.assert_allclose(np.array(obj.matrix_world), matrix, atol=1e-5)
    assert len(copy.data.points) == 2 and all_drivers_valid(bpy)


def test_duplicate_root_is_removed_without_the_original(bpy, lodgs, root):
    before = data_names(bpy)
    for item in root.lodgs.levels:
        item.object.hide_viewport = False
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj == root)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.duplicate()
    copy = bpy.context.view_layer.objects.active
    assert copy.lodgs.is_root and copy.lodgs.itself == copy
    delete_objects(bpy, copy.name)
    lodgs("data.removal").remove_deleted()
    assert data_names(bpy)["objects"] == before["objects"]


def test_copy_of_a_root_alone_leaves_the_levels_to_the_original(bpy, lodgs, root):
    """The copy references the same levels, but has no crops."""
    crops = lodgs("data.crops").crops_of(root)
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj == root)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.duplicate()
    bpy.context.view_layer.update()
    followed_objects = lodgs("data.crops").followed_objects
    assert crops and all(followed_objects(item.object) == crops for item in root.lodgs.levels)
    assert len(root.lodgs.existing_levels) == 2 and not bpy.context.active_object.lodgs.existing_levels


def test_animated_cameras_are_removed_with_their_scene(bpy, lodgs, root):
    """Objects of the user are kept."""
    before = data_names(bpy)["objects"]
    assert bpy.ops.lodgs.camera_path() == {"FINISHED"} and bpy.ops.lodgs.turntable() == {"FINISHED"}
    added = set(data_names(bpy)["objects"]) - set(before)
    assert len(added) == 3
    lodgs("data.removal").remove(root)
    assert data_names(bpy)["objects"] == ["user object"] and bpy.context.scene.camera is None


def test_level_that_is_appended_alone_is_kept(bpy, lodgs, root, tmp_path):
    name, level = root.name, root.lodgs.levels[1].object.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=False) as (_, appended):
        appended.objects = [level]
    bpy.context.scene.collection.objects.link(appended.objects[0])
    for file in ("a.blend", "b.blend"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / file))  # removes deleted scenes
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / file))
        assert level in bpy.context.scene.objects and all_drivers_valid(bpy)
    objects, root = bpy.context.scene.collection.objects, bpy.data.objects[name]
    for change in (objects.link, objects.unlink):  # without a collection again, it is deleted
        change(root)
        lodgs("data.removal").remove_deleted()
    assert level not in bpy.data.objects
