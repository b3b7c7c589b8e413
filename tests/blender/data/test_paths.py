"""File paths of scenes stay valid when the .blend is saved in another folder."""

import os
import shutil
from pathlib import Path

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


@pytest.mark.parametrize("place", ["beside the scene", "in another folder"])
def test_project_can_be_moved(bpy, lodgs, tmp_path, place):
    """A .blend beside its scene needs nothing else; elsewhere, Make Paths Relative is enough."""
    project, moved = tmp_path / "project", tmp_path / "moved"
    shutil.copytree("examples/lantern_garden", project / "scene")
    blend = Path("scene.blend" if place == "beside the scene" else "blend/scene.blend")
    (project / blend).parent.mkdir(exist_ok=True)
    root = lodgs("data.importing").import_colmap(bpy.context, str(project / "scene"))
    root.lodgs.training.output = "/elsewhere"
    bpy.ops.wm.save_as_mainfile(filepath=str(project / blend))
    if blend.parent.name:
        assert os.path.isabs(root.lodgs.scene_folder)
        bpy.ops.file.make_paths_relative()
        bpy.ops.wm.save_mainfile()
    name = root.name
    project.rename(moved)
    bpy.ops.wm.open_mainfile(filepath=str(moved / blend))
    root = bpy.data.objects[name]
    job = lodgs("runs.job_settings").make_job(root, tmp_path / "runs", {})
    assert Path(job.scene).resolve() == (moved / "scene").resolve()
    view = lodgs("data.photographs").views(root)[0]
    assert Path(bpy.path.abspath(view.data.lodgs.photograph)).is_file()
    assert root.lodgs.training.output == "/elsewhere"
