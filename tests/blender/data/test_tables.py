"""Tables of bundles in Blender: import, display, export, and removal with their scene."""

import json
import shutil

import numpy as np
import pytest

from tests.blender.fake_trainer import splats
from training.lod.rules.chunks import member_columns
from training.splats.bundle import read_bundle, write_bundle
from training.splats.level_folder import read_folder, write_folder
from training.splats.levels import Bundle, Level

CHUNKS = {
    "x": np.float32([0.1, 7, -3]), "y": np.float32([1, 2, 3]), "z": np.float32([0, 0, 1 / 3]),
    "radius": np.float32([4, 5.5, 1e-3]),
}  # fmt: skip
OTHER = {"position": np.arange(4, dtype="u1"), ".hidden": np.float64([1 / 3, 2, -1, 0]),
         "sharp_face": np.array([1, 2, 3, 2**32 - 1], "u4"), "n": np.arange(4, dtype="i2")}  # fmt: skip


def level(number, count, d_l):
    gaussians = splats(count)
    gaussians.extras |= member_columns(np.random.default_rng(number).random((3, count)) < 0.5)
    return Level(number, gaussians, {"d_l": d_l})


@pytest.fixture
def bundle():
    levels = [level(1, 30, 8.0), level(2, 90, 0.0)]
    return Bundle("lodge", levels, "chunks", tables={"chunks": CHUNKS, "other": OTHER})


@pytest.fixture
def file(bundle, tmp_path):
    write_bundle(tmp_path / "town.ply", bundle)
    return tmp_path / "town.ply"


@pytest.fixture
def root(bpy, lodgs, file):
    return lodgs("data.importing").import_splats(bpy.context, file)


def check_tables(tables, expected):
    assert tables.keys() == expected.keys()
    for name, table in expected.items():
        assert tables[name].keys() == table.keys()
        for column, values in table.items():
            np.testing.assert_array_equal(tables[name][column], values)
            assert tables[name][column].dtype == values.dtype


def export_bytes(bpy, root, path):
    bpy.context.view_layer.objects.active = root
    assert bpy.ops.lodgs.export_bundle(filepath=str(path)) == {"FINISHED"}
    return path.read_bytes()


def data_names(bpy):
    kinds = ("objects", "collections", "meshes", "pointclouds")
    return {kind: sorted(data.name for data in getattr(bpy.data, kind)) for kind in kinds}


def test_tables_round_trip_is_bit_exact(bpy, root, file, tmp_path):
    assert export_bytes(bpy, root, tmp_path / "out.ply") == file.read_bytes()
    name = root.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert export_bytes(bpy, bpy.data.objects[name], tmp_path / "out.ply") == file.read_bytes()


def test_folder_keeps_tables(bpy, bundle, root, tmp_path):
    write_folder(tmp_path / "levels", bundle)
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "levels")) == {"FINISHED"}
    bpy.context.view_layer.objects.active = root
    assert bpy.ops.lodgs.export_folder(directory=str(tmp_path / "exported")) == {"FINISHED"}
    exported = read_folder(tmp_path / "exported")
    check_tables(exported.tables, bundle.tables)
    for level, expected in zip(exported.levels, bundle.levels, strict=True):
        np.testing.assert_array_equal(level.splats.extras["chunks_0"], expected.splats.extras["chunks_0"])


def test_chunks_are_spheres_that_cannot_be_selected(bpy, root):
    item = root.lodgs.tables["chunks"]
    (levels,) = root.users_collection
    assert item.collection in levels.children[:] and item.collection.hide_viewport
    spheres = [obj for obj in item.collection.objects if obj.type == "EMPTY"]
    assert [obj.name for obj in spheres] == [f"town chunk {number:02}" for number in range(3)]
    for number, sphere in enumerate(spheres):
        assert sphere.parent == root.lodgs.axes
        assert sphere.location[:] == tuple(CHUNKS[axis][number] for axis in "xyz")
        assert (sphere.empty_display_type, sphere.hide_select) == ("SPHERE", True)
        assert sphere.empty_display_size == CHUNKS["radius"][number]
    assert not any(obj.visible_get() for obj in item.collection.objects)
    item.collection.hide_viewport = False
    bpy.context.view_layer.update()
    assert [obj.visible_get() for obj in item.collection.objects] == [False, True, True, True]
    assert all(
        (root.lodgs.axes.matrix_world @ obj.location - obj.matrix_world.translation).length < 1e-6
        for obj in spheres
    )
    assert [obj.type for obj in root.lodgs.tables["other"].collection.objects] == ["MESH"]


def test_two_scenes_of_one_file_have_separate_tables(bpy, lodgs, root, file, tmp_path):
    scenes = lodgs("data.scenes")
    other = lodgs("data.importing").import_splats(bpy.context, file)
    scenes.set_tables(other, {"chunks": {name: values[::-1] for name, values in CHUNKS.items()}})
    assert export_bytes(bpy, root, tmp_path / "out.ply") == file.read_bytes()
    for scene_root in (root, other):
        modifiers = [lodgs("data.selection").rule_modifier(item.object) for item in scene_root.lodgs.levels]
        tables = [lodgs("compat").get_input(modifier, "chunks_table") for modifier in modifiers]
        assert tables == [scene_root.lodgs.tables["chunks"].object] * 2
    assert other.lodgs.tables["chunks"].object != root.lodgs.tables["chunks"].object
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}  # removes the root that was exported last
    assert len(lodgs("data.roots").roots(bpy.context.scene)) == 1


def test_appended_scene_keeps_tables(bpy, root, file, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "a.blend")) as (_, library):
        library.collections = ["town"]
    bpy.context.scene.collection.children.link(library.collections[0])
    bpy.context.view_layer.update()
    assert export_bytes(bpy, bpy.data.objects["town"], tmp_path / "out.ply") == file.read_bytes()


def test_undo_and_redo_restore_tables(bpy, file, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.lodgs.import_splats("EXEC_DEFAULT", True, filepath=str(file)) == {"FINISHED"}
    before = data_names(bpy)
    bpy.ops.ed.undo()
    assert not any(data_names(bpy).values())
    bpy.ops.ed.redo()
    assert data_names(bpy) == before
    assert export_bytes(bpy, bpy.data.objects["town"], tmp_path / "out.ply") == file.read_bytes()


def test_tables_are_removed_with_their_scene(bpy, root):
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}
    assert not any(data_names(bpy).values())


def test_removing_a_duplicate_root_keeps_the_scene(bpy, lodgs, root):
    before = data_names(bpy)
    bpy.ops.object.select_all(action="DESELECT")
    root.select_set(True)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.duplicate()
    assert bpy.context.view_layer.objects.active != root
    assert bpy.ops.lodgs.remove_scene() == {"FINISHED"}
    assert data_names(bpy) == before


def test_deleted_tables_are_not_exported(bpy, lodgs, root):
    bpy.data.objects.remove(root.lodgs.tables["other"].object)
    root.lodgs.tables["chunks"].collection.objects.unlink(root.lodgs.tables["chunks"].object)
    bpy.context.view_layer.update()
    assert lodgs("data.scenes").read_levels(root).tables == {}
    lodgs("data.scenes").set_tables(root, {})
    assert not root.lodgs.tables
    assert not any("chunk" in name for names in data_names(bpy).values() for name in names)


def test_new_training_has_no_tables(lodgs, root):
    lodgs("data.scenes").prepare_refill(root, [1])
    assert not root.lodgs.tables and lodgs("data.scenes").read_levels(root).tables == {}


def test_tables_of_earlier_versions_load(bpy, lodgs, tmp_path):
    """Early scenes of LODGE have no chunks: neither tables nor columns, and one control."""
    levels = [Level(1, splats(30), {"d_l": 1.5}), Level(2, splats(90), {"d_l": 0.0})]
    bundle = Bundle("lodge", levels, "chunks", controls={"distance_scale": 2.0})
    write_bundle(tmp_path / "old.ply", bundle)
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "old.ply")
    root.lodgs.initial_controls = json.dumps({"distance_scale": 2.0})
    root.lodgs.mode, root.lodgs.camera_choice, root.lodgs.camera_center = "SELECTIVE", "TRAINING", (0, 0, 0)
    for item in root.lodgs.levels:
        lodgs("data.selection").rule_modifier(item.object).node_group["lodgs_version"] = 101
    lodgs("data.older_files").upgrade_scene(root)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for item, is_visible in zip(root.lodgs.levels, (lambda d: d >= 0.75, lambda d: d < 0.75), strict=True):
        count = len(item.object.evaluated_get(depsgraph).data.points)
        distances = np.linalg.norm(levels[item.number - 1].splats.means, axis=1)
        assert count == is_visible(distances).sum()
    assert lodgs("data.scenes").read_levels(root).controls == {"distance_scale": 2.0}


@pytest.mark.one_blender
def test_finished_run_adds_chunks_and_the_next_run_removes_them(bpy, lodgs, fake, tmp_path):
    scenes, watch = lodgs("data.scenes"), lodgs("runs.watch")
    with lodgs("data.importing").new_scene(bpy.context, "town") as root:
        root.lodgs.scene_folder = str(tmp_path / "scene")
    fake("chunks")
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    assert watch.watch_of(root).problem == ""
    trained = read_bundle(tmp_path / "run" / "bundle.ply")
    assert trained.tables and trained.levels[0].splats.extras
    bundle = scenes.read_levels(root)
    check_tables(bundle.tables, trained.tables)
    for level, expected in zip(bundle.levels, trained.levels, strict=True):
        np.testing.assert_array_equal(level.splats.extras["chunks_0"], expected.splats.extras["chunks_0"])
    fake()
    shutil.rmtree(tmp_path / "run")
    assert bpy.ops.lodgs.train(folder=str(tmp_path / "run")) == {"FINISHED"}
    assert not root.lodgs.tables and not bpy.data.meshes
