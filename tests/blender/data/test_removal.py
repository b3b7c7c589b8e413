"""Splat scenes that are deleted leave nothing behind, and nothing of the artist's goes with them."""

from pathlib import Path

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from training.splats.levels import Bundle, Level

KINDS = ("objects", "collections", "pointclouds", "cameras", "images", "meshes", "scenes")


def everything(bpy) -> dict[str, list[str]]:
    return {kind: sorted(one.name for one in getattr(bpy.data, kind)) for kind in KINDS}


@pytest.fixture
def root(bpy, lodgs):
    """The example's views and points with two levels by distance, in a file with an object of its own."""
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("the artist's", None))
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


def press_x(bpy, *names):
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


def all_valid(bpy) -> bool:
    sources = [target.id for one in drivers(bpy) for v in one.variables for target in v.targets
               if v.type == "SINGLE_PROP"]  # fmt: skip
    return None not in sources and all(one.is_valid for one in drivers(bpy))


@pytest.mark.parametrize("selected", ["the root", "all that can be selected"])
def test_a_deleted_scene_leaves_nothing(bpy, lodgs, root, selected):
    removal = lodgs("data.removal")
    name, before = root.name, everything(bpy)
    bpy.ops.ed.undo_push(message="before")
    press_x(bpy, *([name] if selected == "the root" else []))
    assert drivers(bpy) and all_valid(bpy)
    assert bpy.app.timers.is_registered(removal.remove_deleted)  # background runs no timers
    removal.remove_deleted()
    bpy.context.view_layer.update()
    bpy.data.orphans_purge(
        do_recursive=True
    )  # what Blender itself deletes leaves its data until the file is saved
    kept = ["the artist's"] if selected == "the root" else []
    assert everything(bpy) == {kind: [] for kind in KINDS} | {"objects": kept, "scenes": ["Scene"]}
    bpy.ops.ed.undo()
    assert everything(bpy) == before and all_valid(bpy)
    assert bpy.data.objects[name].users_collection
    removal.remove_deleted()
    assert everything(bpy) == before


def test_a_file_is_never_saved_with_half_a_scene(bpy, root, tmp_path):
    press_x(bpy, root.name)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert [obj.name for obj in bpy.data.objects] == ["the artist's"] and not bpy.data.pointclouds


def test_the_operator_removes_and_undo_brings_back(bpy, root):
    name, before = root.name, everything(bpy)
    bpy.context.view_layer.objects.active = root.lodgs.levels[0].object
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.lodgs.remove_scene("EXEC_DEFAULT", True) == {"FINISHED"}
    assert everything(bpy)["objects"] == ["the artist's"] and not bpy.data.collections
    bpy.ops.ed.undo()
    assert everything(bpy) == before and len(bpy.data.objects[name].lodgs.levels) == 2
    bpy.ops.ed.redo()
    assert everything(bpy)["objects"] == ["the artist's"]
    assert not bpy.ops.lodgs.remove_scene.poll()


def test_children_of_a_removed_scene_stay(bpy, root):
    mine = bpy.data.objects["the artist's"]
    mine.parent, mine.location = root, (1, 0, 0)
    root.users_collection[0].objects.link(mine)
    copy = root.lodgs.levels[1].object.copy()
    bpy.context.scene.collection.objects.link(copy)
    bpy.context.view_layer.update()
    places = [np.array(obj.matrix_world) for obj in (mine, copy)]
    assert np.linalg.norm(places[0][:3, 3]) > 1
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert sorted(obj.name for obj in bpy.data.objects) == sorted([mine.name, copy.name])
    assert bpy.data.collections[:] == [
        part for part in mine.users_collection if part != bpy.context.scene.collection
    ]
    for obj, place in zip((mine, copy), places, strict=True):
        np.testing.assert_allclose(np.array(obj.matrix_world), place, atol=1e-5)
    assert len(copy.data.points) == 2 and all_valid(bpy)


def test_a_copy_of_a_scene_is_removed_for_itself(bpy, lodgs, root):
    before = everything(bpy)
    for item in root.lodgs.levels:
        item.object.hide_viewport = False
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj == root)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.duplicate()
    copy = bpy.context.view_layer.objects.active
    assert copy.lodgs.is_root and copy.lodgs.itself == copy
    press_x(bpy, copy.name)
    lodgs("data.removal").remove_deleted()
    left = everything(bpy)
    assert left["objects"] == before["objects"]


def test_a_root_of_an_older_file_holds_on_to_itself(lodgs, root):
    root.lodgs.itself = None
    lodgs("data.older_files").upgrade_scene(root)
    assert root.lodgs.itself == root


def test_animated_cameras_are_removed_with_their_scene(bpy, lodgs, root):
    """The artist's own things stay, and so does what moves about another scene."""
    there = everything(bpy)["objects"]
    assert bpy.ops.lodgs.camera_path() == {"FINISHED"} and bpy.ops.lodgs.turntable() == {"FINISHED"}
    added = set(everything(bpy)["objects"]) - set(there)
    assert len(added) == 3
    lodgs("data.removal").remove(root)
    assert everything(bpy)["objects"] == ["the artist's"] and bpy.context.scene.camera is None
