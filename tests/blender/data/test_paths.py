"""File paths of scenes stay valid when the .blend is saved in another folder."""

import os

import pytest


@pytest.fixture
def saved(bpy, lodgs, tmp_path):
    root = lodgs("data.importing").import_colmap(bpy.context, "examples/lantern_walk", photographs=False)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a" / "file.blend"))
    root.lodgs.training.run, root.lodgs.training.output = "//runs/one", "/elsewhere"
    bpy.context.scene.lodgs_render.holdout = "//depth/####.exr"
    return root


def told(bpy, root):
    run, holdout = root.lodgs.training.run, bpy.context.scene.lodgs_render.holdout
    return [os.path.normpath(bpy.path.abspath(path)) for path in (run, holdout)]


def test_paths_stay_valid_after_saving_in_another_folder(bpy, saved, tmp_path):
    before, name = told(bpy, saved), saved.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    assert told(bpy, saved) == before and saved.lodgs.training.run.startswith("//")
    assert saved.lodgs.training.output == "/elsewhere"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "file.blend"))
    assert told(bpy, bpy.data.objects[name]) == before


def test_saved_copy_leaves_the_open_file_unchanged(bpy, saved, tmp_path):
    before, name, run = told(bpy, saved), saved.name, saved.lodgs.training.run
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "copy.blend"), copy=True)
    assert saved.lodgs.training.run == run and told(bpy, saved) == before
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "copy.blend"))
    assert told(bpy, bpy.data.objects[name]) == before
