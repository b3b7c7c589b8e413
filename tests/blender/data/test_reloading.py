"""Reload of splats after another program replaces their file."""

import os
from pathlib import Path

import numpy as np
import pytest

from training.scenes.cameras import Camera
from training.scenes.view_tables import make_view_tables
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply


def cube(count: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 3), -3, np.float32),
        opacity_logits=np.full(count, 2, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


@pytest.fixture
def path(tmp_path) -> Path:
    write_ply(tmp_path / "walk.ply", cube(50))
    return tmp_path / "walk.ply"


@pytest.fixture
def root(bpy, path):
    assert bpy.ops.lodgs.import_splats(filepath=str(path)) == {"FINISHED"}
    return next(obj for obj in bpy.data.objects if obj.lodgs.is_root)


def hide(lodgs, root, rows: slice) -> None:
    mask = np.zeros(50, bool)
    mask[rows] = True
    lodgs("data.cleaning").hide(root, {1: mask})


def positions(root) -> np.ndarray:
    cloud = root.lodgs.levels[0].object.data
    values = np.empty(3 * len(cloud.points), np.float32)
    cloud.attributes["position"].data.foreach_get("vector", values)
    return values.reshape(-1, 3)


def test_reload_keeps_placement_edits_and_material(bpy, lodgs, root, path):
    obj = root.lodgs.levels[0].object
    material = bpy.data.materials.new("glass")
    obj.data.materials.clear()
    obj.data.materials.append(material)
    obj.modifiers.new("mine", "NODES")
    root.location = 1, 2, 3
    hide(lodgs, root, slice(0, 7))
    newer = cube(50)
    newer.means[:] += np.float32(0.01)
    newer.means[:10] += np.float32(5)
    write_ply(path, newer)
    assert bpy.ops.lodgs.reload_splats() == {"FINISHED"}
    np.testing.assert_array_equal(positions(root), newer.means)
    assert root.lodgs.levels[0].object == obj and "mine" in obj.modifiers
    assert list(obj.data.materials) == [material] and tuple(root.location) == (1, 2, 3)
    expected = np.arange(50) < 7
    np.testing.assert_array_equal(lodgs("data.cleaning").hidden_mask(obj.data), expected)


@pytest.mark.parametrize("newer", [cube(60), cube(50, seed=1)], ids=["more", "others"])
def test_replaced_splats_lose_hiding_with_a_note(lodgs, root, path, newer):
    hide(lodgs, root, slice(0, 7))
    write_ply(path, newer)
    reloading = lodgs("data.reloading")
    notes = reloading.replace_splats(root, reloading.read_source(root)())
    assert notes == [
        f"Reloaded {len(newer)} splats (before: 50).",
        "7 hidden splats are shown again: the file has other splats.",
    ]
    assert not lodgs("data.cleaning").hidden_mask(root.lodgs.levels[0].object.data).any()


def test_deleted_splats_return_with_a_note(bpy, lodgs, root, path):
    hide(lodgs, root, slice(0, 7))
    bpy.ops.lodgs.delete_hidden_splats()
    reloading = lodgs("data.reloading")
    notes = reloading.replace_splats(root, reloading.read_source(root)())
    assert notes == [
        "Reloaded 50 splats (before: 43).",
        "7 splats that were deleted in Blender are in the file again.",
    ]


def test_levels_keep_their_objects(bpy, lodgs, tmp_path):
    path = tmp_path / "levels.ply"
    levels = [Level(number, cube(10 * number)) for number in (1, 2, 3)]
    write_bundle(path, Bundle("", levels))
    root = lodgs("data.importing").import_splats(bpy.context, path)
    root.lodgs.single_level = 2
    root.lodgs.levels[0].show = False
    objects = [item.object for item in root.lodgs.levels]
    write_bundle(path, Bundle("", [Level(number, cube(20 * number)) for number in (1, 2)]))
    bpy.ops.lodgs.reload_splats()
    items = root.lodgs.levels
    assert [(item.object, len(item.object.data.points)) for item in items] == [
        (objects[0], 20), (objects[1], 40)
    ]  # fmt: skip
    assert root.lodgs.single_level == 2 and not items[0].show


def test_linked_duplicates_keep_their_splats(bpy, root, path):
    duplicate = root.lodgs.levels[0].object.copy()
    bpy.context.scene.collection.objects.link(duplicate)
    write_ply(path, cube(60))
    assert bpy.ops.lodgs.reload_splats() == {"FINISHED"}
    assert len(duplicate.data.points) == 50 and len(root.lodgs.levels[0].object.data.points) == 60


def test_views_stay_held_out(bpy, lodgs, tmp_path):
    cameras = [Camera(name, 40, 30, 30.0, 30.0, 20.0, 15.0, np.eye(4)) for name in ("a", "b")]
    path = tmp_path / "views.ply"
    write_bundle(path, Bundle("", [Level(1, cube(5))], tables=make_view_tables(cameras, 0.1, {"b"})))
    root, photographs = lodgs("data.importing").import_splats(bpy.context, path), lodgs("data.photographs")
    assert bpy.ops.lodgs.reload_splats() == {"FINISHED"}
    assert [view.name for view in photographs.held_out(root)] == ["b"]


def wait_for_reload(reloading, root) -> None:
    for _ in range(4):
        reloading.check_files()
        watch = reloading.watch_of(root)
        if watch.reading is not None:
            watch.reading.exception()


def test_watched_file_is_reloaded_once_it_is_complete(bpy, lodgs, root, path):
    reloading = lodgs("data.reloading")
    write_ply(path, cube(60))
    assert reloading.check_files() == reloading.INTERVAL and reloading.watch_of(root) is None
    root.lodgs.source.watch = True
    reloading.check_files()
    assert reloading.watch_of(root).reading is None  # it may still be written
    wait_for_reload(reloading, root)
    assert len(positions(root)) == 60 and root.lodgs.source.watch
    assert reloading.watch_of(root).notes[0].endswith("Reloaded 60 splats (before: 50).")

    path.write_bytes(path.read_bytes()[:-100])
    wait_for_reload(reloading, root)
    assert len(positions(root)) == 60 and "walk.ply" in reloading.watch_of(root).problem
    write_ply(path, cube(70))
    wait_for_reload(reloading, root)
    assert len(positions(root)) == 70 and not reloading.watch_of(root).problem


def test_undone_reload_is_not_repeated(bpy, lodgs, root, path):
    reloading = lodgs("data.reloading")
    root.lodgs.source.watch = True
    bpy.ops.ed.undo_push(message="before")
    write_ply(path, cube(60))
    wait_for_reload(reloading, root)
    bpy.ops.ed.undo()
    root = next(obj for obj in bpy.data.objects if obj.lodgs.is_root)
    assert len(positions(root)) == 50
    wait_for_reload(reloading, root)
    assert len(positions(root)) == 50
    os.utime(path, ns=(1, 1))  # written again
    wait_for_reload(reloading, root)
    assert len(positions(root)) == 60


def test_missing_file_and_scene_without_file(bpy, lodgs, root, path):
    path.unlink()
    with pytest.raises(RuntimeError, match="walk"):
        bpy.ops.lodgs.reload_splats()
    assert len(positions(root)) == 50
    root.lodgs.source.file = ""
    with pytest.raises(RuntimeError, match="Cannot reload"):
        bpy.ops.lodgs.reload_splats()


def test_levels_of_another_rule_change_nothing_if_invalid(bpy, lodgs, root, path):
    splats = [Level(1, cube(10), {"s_min": 0.1}), Level(2, cube(20), {"s_min": 0.0})]
    meta = {"camera_center": [0.0, 0.0, 0.0], "focal_px": 500.0}
    write_bundle(path, Bundle("flod", splats, "bands", {}, {"gamma": -5.0}, meta=meta))
    with pytest.raises(RuntimeError):
        bpy.ops.lodgs.reload_splats()
    assert len(positions(root)) == 50 and len(root.lodgs.levels) == 1


def test_training_stops_watching(lodgs, root):
    root.lodgs.source.watch = True
    lodgs("data.scenes").prepare_refill(root, [1])
    assert not root.lodgs.source.watch
