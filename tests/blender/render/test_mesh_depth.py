"""Depth of the meshes: folder of its files, and scenes without meshes."""

import stat
from types import SimpleNamespace

import pytest

from tests.blender.fake_trainer import splats
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level


def test_depth_of_an_unsaved_file_is_in_a_private_folder(bpy, lodgs, monkeypatch, tmp_path):
    """This also holds if Blender has no temporary folder."""
    mesh_depth = lodgs("render.mesh_depth")
    scene = bpy.context.scene
    monkeypatch.setattr(mesh_depth.tempfile, "tempdir", str(tmp_path))
    fake_bpy = SimpleNamespace(app=SimpleNamespace(tempdir=""), data=bpy.data, path=bpy.path)
    monkeypatch.setattr(mesh_depth, "bpy", fake_bpy)
    mesh_depth._temporary_folder.cache_clear()
    pattern = mesh_depth.depth_file_pattern(scene)
    (folder,) = tmp_path.iterdir()
    assert pattern.is_relative_to(folder) and pattern == mesh_depth.depth_file_pattern(scene)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    mesh_depth._temporary_folder.cache_clear()


def test_meshes_below_the_root_of_splats_have_depth(bpy, lodgs):
    root = bpy.data.objects.new("root", None)
    root.lodgs.is_root = True
    mesh = bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh"))
    mesh.parent = root
    has_depth = lodgs("render.mesh_depth")._has_depth
    assert has_depth(mesh) and not has_depth(root)


def test_disabled_cycles_is_reported(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "splats.ply", Bundle("", [Level(1, splats(10))]))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "splats.ply")
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    assert bpy.ops.preferences.addon_disable(module="cycles") == {"FINISHED"}
    try:
        for operator in ("combine_with_meshes", "render_mesh_depth"):
            with pytest.raises(RuntimeError, match="Cannot render meshes: Cycles is disabled"):
                getattr(bpy.ops.lodgs, operator)()
    finally:
        assert bpy.ops.preferences.addon_enable(module="cycles") == {"FINISHED"}


def test_scene_without_meshes_has_no_depth(bpy, lodgs, tmp_path):
    write_bundle(tmp_path / "splats.ply", Bundle("", [Level(1, splats(10))]))
    lodgs("data.importing").import_splats(bpy.context, tmp_path / "splats.ply")
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "garden.blend"))
    with pytest.raises(RuntimeError, match="Cannot render mesh depth: the scene 'Scene' has no meshes"):
        bpy.ops.lodgs.render_mesh_depth()
    assert bpy.context.scene.lodgs_render.holdout == "" and len(bpy.data.scenes) == 1
    assert not (tmp_path / "garden_depth").exists()
